"""MSRD: its loss in closed form, what R^0 is updated with, how rewards divide, a short training."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from represent_jax.data.catalogue import load_demonstrations
from represent_jax.envs import make_env
from represent_jax.errors import UsageError
from represent_jax.methods.config import make_problem
from represent_jax.methods.pipeline import transitions_of
from represent_jax.methods.population import member_of, stack
from represent_jax.methods.presets import make_config
from represent_jax.stages import msrd
from represent_jax.stages.discriminator import Rows
from represent_jax.stages.evaluation import pearson
from represent_jax.types import Transition

SMOKE = make_config("smoke", "half_cheetah")
CONFIG = msrd.MsrdConfig(
    env_steps=160,
    cloning_updates=300,
    hidden_sizes=(8,),
    batch_size=8,
    updates_per_step=2,
    policy_average_rate=0.25,
    sac=SMOKE.airl.sac,
)
ALPHA = 0.7
SHOWN_ACTIONS = (0.5, -0.5)


def _transition(rng, shape, obs_dim=2):
    return Transition(
        obs_t=rng.normal(size=(*shape, obs_dim)).astype(np.float32),
        action_t=np.zeros((*shape, 1), np.float32),
        next_obs_t=rng.normal(size=(*shape, obs_dim)).astype(np.float32),
        reward_t=np.zeros(shape, np.float32),
        discount_t=(rng.random(shape) < 0.7).astype(np.float32),
        noise_level_t=np.zeros(shape, np.float32),
    )


def _rows(shape):
    rng = np.random.default_rng(0)
    log_probs = rng.uniform(-1.0, 1.0, (2, *shape)).astype(np.float32)
    return Rows(_transition(rng, shape), _transition(rng, shape), *log_probs)


@functools.cache
def _state(hidden_sizes=(8,)):
    config = dataclasses.replace(CONFIG, hidden_sizes=hidden_sizes)
    shown = _transition(np.random.default_rng(1), (2, 64))
    shown = shown._replace(obs_t=2.0 * shown.obs_t + 1.0)
    return jax.jit(lambda key: msrd.init_rewards(key, shown, config))(jax.random.PRNGKey(10))


def _of_strategy(rewards, i):
    own = member_of((rewards.strategies, rewards.shaping), i)
    return rewards._replace(strategies=own[0], shaping=own[1])


def _numpy_network(network, own, obs):
    x = np.clip((np.asarray(obs) - np.asarray(own.mean)) / np.asarray(own.std), -5.0, 5.0)
    layers = network["params"]
    for i in range(len(layers)):
        layer = layers[f"hidden_{i}"]
        x = x @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"])
        if i + 1 < len(layers):
            x = np.maximum(x, 0.0)
    return x[..., 0]


def _assert_close(found, expected):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), found, expected
    )


def test_without_demonstrated_actions_log_pi_is_left_out_of_both_halves():
    rows = _rows((2, 2, 16))
    states = rows._replace(expert=rows.expert._replace(action_t=None), log_prob_expert=None)
    zero = np.zeros((2, 2, 16), np.float32)
    zeros = rows._replace(log_prob_expert=zero, log_prob_policy=zero)
    state = _state()
    key = jax.random.PRNGKey(3)
    update = jax.jit(lambda rows: msrd.update_rewards(state, rows, key, CONFIG)[0])
    _assert_close(update(states), update(zeros))


# Linear networks have the same gradient everywhere, so that the penalty has a closed form.
@pytest.mark.parametrize(("hidden_sizes", "penalty"), [((8,), 0.0), ((), 0.5)])
def test_loss_in_closed_form(hidden_sizes, penalty):
    config = dataclasses.replace(
        CONFIG, hidden_sizes=hidden_sizes, gradient_penalty=penalty, strategy_weight=ALPHA
    )
    own = _of_strategy(_state(hidden_sizes).rewards, 1)
    rows = _rows((16,))
    loss = jax.jit(lambda own, rows: msrd.loss(own, rows, jax.random.PRNGKey(3), config))
    found, metrics = loss(own, rows)

    f, task, strategy = [], [], []
    for batch in (rows.expert, rows.policy):
        task.append(_numpy_network(own.task, own, batch.next_obs_t))
        strategy.append(_numpy_network(own.strategies, own, batch.next_obs_t))
        h, next_h = (
            _numpy_network(own.shaping, own, obs) for obs in (batch.obs_t, batch.next_obs_t)
        )
        f.append(task[-1] + ALPHA * strategy[-1] + 0.99 * batch.discount_t * next_h - h)
    log_d = -np.log1p(np.exp(-(f[0] - rows.log_prob_expert)))
    log_not_d = -np.log1p(np.exp(f[1] - rows.log_prob_policy))
    expected = -np.mean(np.concatenate([log_d, log_not_d]))
    np.testing.assert_allclose(metrics["discriminator_loss"], expected, rtol=1e-5)
    # MSRD's sums over 64 rows.
    expected += 64 * 0.01 * np.mean(np.square(strategy)) + 64 * 0.0001 * np.mean(np.square(task))
    if penalty:
        kernels = (n["params"]["hidden_0"]["kernel"] for n in (own.task, own.strategies))
        r0, r_own = (np.asarray(kernel)[:, 0] for kernel in kernels)
        h = np.asarray(own.shaping["params"]["hidden_0"]["kernel"])[:, 0]
        slope = r0 + ALPHA * r_own + 0.99 * np.asarray(rows.policy.discount_t)[:, None] * h
        expected += penalty * (np.mean(np.sum(slope**2, axis=-1)) + np.sum(h**2))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_task_reward_makes_one_step_along_the_gradients_of_all_strategies_and_updates():
    config = dataclasses.replace(CONFIG, learning_rate=0.05, updates_per_step=3)
    state, rows, key = _state(), _rows((2, 3, 8)), jax.random.PRNGKey(4)
    found, _ = jax.jit(lambda *args: msrd.update_rewards(*args, config))(state, rows, key)
    _, task_optimizer, optimizer = msrd._networks(config)

    @jax.jit
    def update(own, opt, batch, key):
        grads = jax.grad(lambda own: msrd.loss(own, batch, key, config)[0])(own)
        nets = (own.strategies, own.shaping)
        updates, opt = optimizer.update((grads.strategies, grads.shaping), opt, nets)
        nets = optax.apply_updates(nets, updates)
        return own._replace(strategies=nets[0], shaping=nets[1]), opt, grads.task

    keys = jax.random.split(key, (3, 2))
    task_grads = []
    for i in range(2):
        own = _of_strategy(state.rewards, i)
        opt = jax.jit(optimizer.init)((own.strategies, own.shaping))
        for j in range(3):
            batch = jax.tree.map(lambda x, i=i, j=j: x[i, j], rows)
            own, opt, grads = update(own, opt, batch, keys[j, i])
            task_grads.append(grads)
        _assert_close(_of_strategy(found.rewards, i)[1:3], own[1:3])
    total = jax.tree.map(lambda *grads: sum(grads) / 3, *task_grads)
    # Adam's first moment is a tenth of the gradient of its first step.
    _assert_close(found.task_opt[0].mu, jax.tree.map(lambda grad: 0.1 * grad, total))
    assert int(found.task_opt[0].count) == 1
    updates, _ = jax.jit(task_optimizer.update)(total, state.task_opt, state.rewards.task)
    _assert_close(found.rewards.task, jax.tree.map(jnp.add, state.rewards.task, updates))


def test_task_reward_sees_its_entries_and_strategies_see_all():
    config = dataclasses.replace(CONFIG, task_entries=(1,))
    shown = _transition(np.random.default_rng(1), (2, 64))
    rewards = msrd.init_rewards(jax.random.PRNGKey(10), shown, config).rewards
    obs = jnp.asarray(shown.obs_t[0])

    def seen(strategy):
        slopes = jax.grad(
            lambda obs: jnp.sum(msrd.reward(rewards, None, None, obs, config, strategy))
        )(obs)
        return np.any(np.asarray(slopes) != 0.0, axis=0)

    assert seen(None).tolist() == [False, True]
    assert seen(0).tolist() == [True, True]
    method = make_config("smoke", "half_cheetah", "msrd")
    method = dataclasses.replace(method, msrd=dataclasses.replace(method.msrd, task_entries=(17,)))
    with pytest.raises(UsageError, match=r"msrd.task_entries.*size 17.*\(17,\)"):
        method.check_against(17)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("task_entries", (-1,)), ("hidden_sizes", (0,)), ("reward_scale", 0.0)),
        *(("weight_decay", -1.0), ("strategy_weight", -1.0), ("shaping_discount", 7.0)),
    ],
)
def test_settings_that_cannot_be_are_named(field, value):
    with pytest.raises(UsageError, match=f"^{field}: expected"):
        dataclasses.replace(CONFIG, **{field: value})


def test_shared_feature_goes_to_the_task_and_the_other_to_the_strategies():
    """Experts of both strategies are at x = 1; one is at y = 1, the other at y = -1."""
    config = dataclasses.replace(
        CONFIG,
        batch_size=64,
        learning_rate=3e-3,
        task_learning_rate=3e-3,
        gradient_penalty=0.1,
    )

    rows = _rows((300, 2, 4, 64))
    centre = np.array([[1.0, 1.0], [1.0, -1.0]], np.float32)[:, None, None]
    expert = rows.expert._replace(next_obs_t=centre + 0.5 * rows.expert.next_obs_t)
    rows = Rows(expert, rows.policy, *np.zeros((2, 300, 2, 4, 64), np.float32))

    @jax.jit
    def train(state, rows):
        def body(state, inputs):
            return msrd.update_rewards(state, *inputs, config)

        return jax.lax.scan(body, state, (rows, jax.random.split(jax.random.PRNGKey(0), 300)))

    state, metrics = train(_state(), rows)
    assert float(metrics["accuracy_expert"][-100:].mean()) > 0.7
    unseen = jax.random.uniform(jax.random.PRNGKey(1), (500, 2), minval=-1.5, maxval=1.5)

    def agreement(learned):
        return np.array([float(pearson(unseen[:, i], learned)) for i in (0, 1)])

    def learned(strategy):
        return msrd.reward(state.rewards, unseen, None, unseen, config, strategy)

    task = learned(None)
    own = [learned(i) - task for i in (0, 1)]
    assert agreement(task)[0] > 0.8 > 0.3 > abs(agreement(task)[1])
    assert agreement(own[0])[1] > 0.8 > 0.5 > abs(agreement(own[0])[0])
    assert -agreement(own[1])[1] > 0.8 > 0.5 > abs(agreement(own[1])[0])


def test_reward_is_task_plus_weighted_strategy_of_the_next_state():
    config = dataclasses.replace(CONFIG, strategy_weight=ALPHA)
    rewards = _state().rewards
    obs = jax.random.normal(jax.random.PRNGKey(1), (7, 2))
    own = _of_strategy(rewards, 1)
    task = _numpy_network(own.task, own, obs)
    np.testing.assert_allclose(
        msrd.reward(rewards, -obs, None, obs, config), task, rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(
        msrd.reward(rewards, -obs, None, obs, config, strategy=1),
        task + ALPHA * _numpy_network(own.strategies, own, obs),
        rtol=1e-5,
        atol=1e-6,
    )


def test_update_is_the_same_without_jit():
    config = dataclasses.replace(CONFIG, hidden_sizes=(), gradient_penalty=0.0)
    state, rows, key = _state(()), _rows((2, 2, 8)), jax.random.PRNGKey(5)
    compiled, _ = jax.jit(lambda *args: msrd.update_rewards(*args, config))(state, rows, key)
    with jax.disable_jit():
        plain, _ = msrd.update_rewards(state, rows, key, config)
    _assert_close(plain, compiled)


@pytest.fixture(scope="module")
def problem():
    env = make_env("half_cheetah", "mujoco")
    test = load_demonstrations("half_cheetah_test")
    return make_problem(SMOKE, env, load_demonstrations("half_cheetah"), test)


@pytest.fixture(scope="module")
def demonstrations(problem):
    """Demonstrated states, with actions that a small clone learns within few updates."""
    shown = stack(transitions_of(problem.demonstrations))
    action = jnp.broadcast_to(jnp.array(SHOWN_ACTIONS)[:, None, None], shown.action_t.shape)
    return shown._replace(action_t=action)


@pytest.fixture(scope="module")
def started(problem, demonstrations):
    init = jax.jit(lambda key: msrd.init(key, problem.env, demonstrations, CONFIG))
    return init(jax.random.PRNGKey(0))


def test_generators_start_as_clones_of_their_own_demonstrations(problem, demonstrations, started):
    policies = msrd.finish(started).policies
    for i, expected in enumerate(SHOWN_ACTIONS):
        policy, obs = member_of(policies, i), demonstrations.obs_t[i]
        size = problem.env.action_size
        mode = msrd.act(policy, obs, jax.random.PRNGKey(0), CONFIG, size, deterministic=True)
        assert mode.shape == (len(obs), size)
        assert abs(float(jnp.mean(mode)) - expected) < 0.25


def test_training_counts_its_steps_bounds_rewards_and_hands_on_averages(
    problem, demonstrations, started
):
    config = dataclasses.replace(CONFIG, reward_scale=2.0, reward_clip=1e-3)
    train = jax.jit(lambda state: msrd.train(state, problem.env, demonstrations, config, 2))
    # Far apart, so that the bounded reward of a generator tells whose it is.
    rewards = started.learned.rewards
    last_layer = rewards.strategies["params"]["hidden_1"]
    last_layer = {**last_layer, "bias": jnp.array([[50.0], [-50.0]])}
    strategies = {"params": {**rewards.strategies["params"], "hidden_1": last_layer}}
    learned = started.learned.replace(rewards=rewards._replace(strategies=strategies))
    started = started.replace(learned=learned)
    after, metrics = train(started)
    settings = config.sac
    env_steps = settings.warmup_env_steps + 2 * settings.env_steps_per_step
    assert int(after.agents.env_steps) == env_steps
    assert int(after.learned.task_opt[0].count) == 2
    assert all(value.shape == (2,) for value in metrics.values())
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves((after, metrics)))
    np.testing.assert_allclose(metrics["batch_reward"], [2e-3, -2e-3], rtol=1e-3)

    # An average that starts at zero has only the two generators in it, which are close by.
    nothing = jax.tree.map(jnp.zeros_like, started.averages)
    from_zero, _ = train(started.replace(averages=nothing))
    last = after.agents.learner.policy_params
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a / (1.0 - 0.75**2), b, atol=1e-3),
        from_zero.averages,
        last,
    )
    _assert_close(
        msrd.finish(after).policies.policy,
        jax.tree.map(lambda a, b: 0.75**2 * a + b, started.averages, from_zero.averages),
    )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("env_steps", 0),
        ("batch_size", 0),
        ("task_learning_rate", 0.0),
        ("strategy_l2", -1.0),
        ("cloning_updates", -1),
        ("cloning_noise", -0.1),
        ("policy_average_rate", 0.0),
    ],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(UsageError, match=field):
        msrd.MsrdConfig(**{field: value})


def test_clones_do_not_normalise_observations():
    normalizing = dataclasses.replace(CONFIG.sac, normalize_observations=True)
    with pytest.raises(UsageError, match=r"^sac\.normalize_observations"):
        msrd.MsrdConfig(sac=normalizing)
    assert msrd.MsrdConfig(sac=normalizing, cloning_updates=0).sac is normalizing
