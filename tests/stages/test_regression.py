"""Phase 3: each term of Eq. 2 in closed form, and a synthetic problem with a known answer."""

import dataclasses

import batches
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.errors import UsageError
from represent_jax.stages import decomposition, evaluation, regression
from represent_jax.stages.regression import RegressionData
from represent_jax.stages.regression_config import RegressionConfig

CONFIG = RegressionConfig(
    num_updates=300,
    num_snippets=32,
    states_per_snippet=8,
    num_demonstration_states=32,
    min_snippet_steps=5,
    max_snippet_steps=20,
    hidden_sizes=(16, 16),
    learning_rate=3e-3,
    kernel_scale=0.1,
    l2=0.0,
)


def test_ssrr_loss_of_constant_rewards_is_the_squared_error():
    snippets = regression.Snippets(
        inputs=jnp.zeros((2, 4, 1)), share=jnp.array([0.5, 0.25]), target=jnp.array([1.0, 0.0])
    )
    rho = jnp.array([[0.5] * 4, [2.0] * 4])
    expected = np.mean([(10 * 0.5 * (0.5 - 1.0)) ** 2, (10 * 0.25 * 2.0) ** 2])
    np.testing.assert_allclose(regression.ssrr_loss(rho, snippets, 10.0), expected, rtol=1e-6)


def test_ssrr_loss_is_unbiased_by_the_sampling_of_states():
    rewards = jax.random.normal(jax.random.PRNGKey(0), (20_000, 16)) + 0.7
    snippets = regression.Snippets(
        inputs=jnp.zeros(()), share=jnp.full(20_000, 0.1), target=jnp.full(20_000, 0.7)
    )
    assert abs(float(regression.ssrr_loss(rewards, snippets, 10.0))) < 0.01


def test_snippets_never_leave_the_running_steps_and_count_the_nominal_horizon():
    horizon, lengths = 40, np.array([3, 12, 40])
    obs = np.tile(np.arange(horizon + 1.0)[None, :, None], (3, 1, 1))
    snippets = regression.sample_snippets(
        jax.random.PRNGKey(0),
        batches.make(obs, lengths),
        jnp.array([0.1, 0.2, 0.3]),
        dataclasses.replace(CONFIG, num_snippets=500),
    )
    owner = jnp.searchsorted(jnp.array([0.1, 0.2, 0.3]), snippets.target)
    last = jnp.asarray(lengths)[owner]
    # The input is the state after the step: 1 to length.
    assert bool(jnp.all(snippets.inputs[..., 0] >= 1.0))
    assert bool(jnp.all(snippets.inputs[..., 0] <= last[:, None]))
    steps = snippets.share * horizon
    assert bool(jnp.all(steps <= jnp.minimum(last, CONFIG.max_snippet_steps) + 1e-4))
    assert bool(jnp.all(steps >= jnp.minimum(last, CONFIG.min_snippet_steps) - 1e-4))


@pytest.mark.parametrize(
    ("reading", "expected"),
    [
        ("log_ratio", (0.2 - 1.0 - np.log(0.7)) ** 2 + (0.5 - 0.8 - np.log(0.7)) ** 2),
        (
            "flair",
            (np.exp(0.2) - 0.7 * np.exp(1.0)) ** 2 + (np.exp(0.5) - 0.7 * np.exp(0.8)) ** 2,
        ),
        ("literal", (np.exp(1.0) - np.exp(0.2)) ** 2 + (np.exp(0.8) - np.exp(0.5)) ** 2),
    ],
)
def test_discrimination_readings(reading, expected):
    utility = jnp.array([[1.0, 0.2], [0.5, 0.8]])
    config = dataclasses.replace(CONFIG, discrimination=reading)
    np.testing.assert_allclose(regression.discrimination_loss(utility, config), expected, rtol=1e-5)


def test_discrimination_pushes_only_the_other_strategies_down():
    utility = jnp.array([[1.0, 1.0], [1.0, 1.0]])
    grads = jax.grad(lambda u: regression.discrimination_loss(u, CONFIG))(utility)
    np.testing.assert_allclose(jnp.diagonal(grads), 0.0)
    assert float(grads[0, 1]) > 0.0 and float(grads[1, 0]) > 0.0


def _linear(seed):
    """Linear heads of two strategies that see three entries, and what Eq. 2 is computed from."""
    config = dataclasses.replace(
        CONFIG,
        hidden_sizes=(),
        l2=0.3,
        strategy_l2=0.2,
        lambda_ssrr=0.7,
        lambda_reg=0.5,
        lambda_bcd=0.4,
        strategy_weight=0.6,
        return_scale=10.0,
    )
    random = np.random.default_rng(seed)
    rewards = decomposition.draw(*jax.random.split(jax.random.PRNGKey(seed)), 3, 1, 2, config)
    rewards = jax.tree.map(lambda x: jnp.asarray(random.normal(size=x.shape[1:])), rewards)
    snippets = regression.Snippets(
        inputs=jnp.asarray(random.normal(size=(2, 5, 4, 3))),
        share=jnp.asarray(random.uniform(size=(2, 5))),
        target=jnp.asarray(random.uniform(size=(2, 5))),
    )
    return config, rewards, snippets, jnp.asarray(random.normal(size=(2, 7, 3)))


def test_the_loss_is_eq_2():
    config, rewards, snippets, shown = _linear(0)
    log_units = jnp.array([0.03, -0.03])
    task, own = (jax.tree.map(np.asarray, one["params"]["Dense_0"]) for one in rewards[:2])
    unit = 40 / 10.0

    def rho_task(states):
        return unit * (states @ task["kernel"][:, 0] + task["bias"])

    def rho_own(i, states):
        return unit * (states @ own["kernel"][i, :, 0] + own["bias"][i])

    ssrr, reg = [], 0.0
    utility = np.zeros((2, 2))
    units = np.asarray(regression.units_of(log_units))
    for i in range(2):
        rho = (rho_task(snippets.inputs[i]) + 0.6 * rho_own(i, snippets.inputs[i])) / units[i]
        errors = [np.mean(half, axis=1) - snippets.target[i] for half in (rho[:, :2], rho[:, 2:])]
        ssrr.append(np.mean(np.prod(errors, axis=0) * np.square(10.0 * snippets.share[i])))
        reg += np.mean(np.square(rho_own(i, snippets.inputs[i])))
        for m in range(2):
            reg += 0.5 * np.mean(np.square(rho_own(i, shown[m])))  # Of all demonstrated states.
            utility[i, m] = np.mean(rho_task(shown[m]) + 0.6 * rho_own(i, shown[m]))
    bcd = regression.discrimination_loss(jnp.asarray(utility), config)
    l2 = 0.3 * np.square(task["kernel"]).sum() + 0.2 * np.square(own["kernel"]).sum()
    total, metrics = regression.loss(rewards, log_units, snippets, shown, 40, config)
    for name, expected in (
        ("ssrr_loss", np.mean(ssrr)),
        ("reg_loss", reg),
        ("bcd_loss", bcd),
        ("l2_loss", l2),
    ):
        np.testing.assert_allclose(metrics[name], expected, rtol=1e-4, err_msg=name)
    expected = 0.7 * np.sum(ssrr) + 0.5 * reg + 0.4 * bcd + l2
    np.testing.assert_allclose(total, expected, rtol=1e-4)


def test_discrimination_and_the_penalty_of_strategies_leave_the_task_alone():
    config, rewards, snippets, shown = _linear(1)
    config = dataclasses.replace(config, lambda_ssrr=0.0, l2=0.0)
    grads = jax.grad(lambda r: regression.loss(r, None, snippets, shown, 40, config)[0])(rewards)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(grads.task))
    assert any(np.any(leaf) for leaf in jax.tree.leaves(grads.strategies))


def test_known_reward_is_recovered_and_decomposed():
    """Two strategies in different places; the curve knows a shared feature, x, and nothing else."""
    key = jax.random.PRNGKey(0)
    horizon, num = 40, 60
    levels = jnp.linspace(1.0, 0.0, num)
    data = []
    for strategy, place in enumerate((-1.0, 1.0)):
        noise = 0.3 * jax.random.normal(jax.random.fold_in(key, strategy), (num, horizon + 1, 2))
        centre = jnp.stack([levels, jnp.full(num, place)], axis=-1)
        data.append(batches.make(centre[:, None] + noise))
    noisy = jax.tree.map(lambda *x: jnp.stack(x), *data)
    demonstrations = jax.tree.map(lambda x: x[:, :4], noisy)
    problem = RegressionData(noisy, jnp.stack([levels, levels]), demonstrations)
    state = regression.init(jax.random.PRNGKey(1), 2, 1, 2, CONFIG)
    state, metrics = jax.jit(
        lambda state: regression.train(state, problem, CONFIG, CONFIG.num_updates)
    )(state)
    assert float(metrics["strategy_reward_own"]) > float(metrics["strategy_reward_others"])
    unseen = jax.random.uniform(jax.random.PRNGKey(2), (200, 2), minval=-1.0, maxval=1.0)
    for strategy in (None, 0, 1):
        learned = decomposition.reward(state.rewards, unseen, None, unseen, CONFIG, strategy)
        assert float(evaluation.pearson(unseen[:, 0], learned)) > 0.9


def test_units_are_positive_and_their_geometric_mean_is_one():
    units = regression.units_of(jnp.array([[0.3, -0.1, 0.05], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(jnp.prod(units, axis=-1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(units[1], 1.0)
    assert (units > 0.0).all() and (jnp.diff(units[0]) != 0.0).all()


def test_a_strategy_that_is_twice_as_good_gets_twice_the_unit():
    """Each curve runs from 0 to 1 by itself; where both went, they contradict each other."""
    config = dataclasses.replace(CONFIG, num_updates=800, lambda_reg=1.0)
    key, horizon, num = jax.random.PRNGKey(0), 40, 60
    levels = jnp.linspace(1.0, 0.0, num)
    data = []
    for strategy, best in enumerate((1.0, 2.0)):
        noise = 0.1 * jax.random.normal(jax.random.fold_in(key, strategy), (num, horizon + 1, 2))
        centre = jnp.stack([best * levels, jnp.zeros(num)], axis=-1)
        data.append(batches.make(centre[:, None] + noise))
    noisy = jax.tree.map(lambda *x: jnp.stack(x), *data)
    problem = RegressionData(noisy, jnp.stack([levels, levels]), noisy)
    state = regression.init(jax.random.PRNGKey(1), 2, 1, 2, config)
    train = jax.jit(lambda state: regression.train(state, problem, config, config.num_updates)[0])
    first, second = np.mean(regression.units_of(train(state).log_units), axis=0)
    assert second / first == pytest.approx(2.0, rel=0.15)
    apart = dataclasses.replace(config, learn_units=False)
    assert regression.init(jax.random.PRNGKey(1), 2, 1, 2, apart).log_units is None


def test_step_is_the_same_without_jit():
    obs = np.random.default_rng(0).normal(size=(1, 3, 21, 2))
    noisy = jax.tree.map(lambda x: x[None], batches.make(obs[0]))
    problem = RegressionData(noisy, jnp.ones((1, 3)), noisy)
    state = regression.init(jax.random.PRNGKey(0), 2, 1, 1, CONFIG)
    compiled, _ = jax.jit(lambda state: regression.step(state, problem, CONFIG))(state)
    with jax.disable_jit():
        plain, _ = regression.step(state, problem, CONFIG)
    for a, b in zip(jax.tree.leaves(compiled), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_bad_settings_are_named():
    with pytest.raises(UsageError, match=r"discrimination.*log_ratio"):
        RegressionConfig(discrimination="unknown")
    with pytest.raises(UsageError, match="states_per_snippet"):
        RegressionConfig(states_per_snippet=3)
    with pytest.raises(UsageError, match="num_demonstration_states: expected at least 1"):
        RegressionConfig(num_demonstration_states=0)
    with pytest.raises(UsageError, match="strategy_weight: expected >= 0, found nan"):
        RegressionConfig(strategy_weight=float("nan"))
    with pytest.raises(UsageError, match="hidden_sizes: expected each at least 1"):
        RegressionConfig(hidden_sizes=(128, 0))
    with pytest.raises(UsageError, match="max_snippet_steps"):
        RegressionConfig(min_snippet_steps=50, max_snippet_steps=40)
