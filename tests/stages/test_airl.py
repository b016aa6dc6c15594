"""Phase 1 with either generator: compiled against not, what it averages, what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.data.catalogue import load_demonstrations
from represent_jax.envs import make_env
from represent_jax.errors import UsageError
from represent_jax.methods.config import make_problem
from represent_jax.methods.pipeline import transitions_of
from represent_jax.methods.presets import make_config
from represent_jax.stages import airl, discriminator

SMOKE = make_config("smoke", "half_cheetah")


@pytest.fixture(scope="module")
def problem():
    env = make_env("half_cheetah", "mujoco")
    test = load_demonstrations("half_cheetah_test")
    return make_problem(SMOKE, env, load_demonstrations("half_cheetah"), test)


def _run(problem, config, num_steps):
    demonstrations = transitions_of(problem.demonstrations)[0]
    init = jax.jit(lambda key: airl.init(key, problem.env, demonstrations, config))
    train = jax.jit(lambda state: airl.train(state, problem.env, demonstrations, config, num_steps))
    return train(init(jax.random.PRNGKey(0)))


@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_either_generator_counts_its_steps_and_hands_on_a_policy(problem, agent):
    config = dataclasses.replace(SMOKE.airl, agent=agent)
    state, metrics = _run(problem, config, 3)
    _, settings = airl.generator(config)
    warmup = settings.warmup_env_steps if agent == "sac" else 0
    assert int(state.agent.env_steps) == warmup + 3 * settings.env_steps_per_step
    assert all(bool(jnp.isfinite(value)) for value in metrics.values())
    output = airl.finish(state)
    obs = jnp.zeros((5, problem.env.observation_size))
    action = airl.act(output.policy, obs, jax.random.PRNGKey(1), config, problem.env.action_size)
    assert action.shape == (5, problem.env.action_size)
    assert airl.reward(output.reward, obs, action, obs, config).shape == (5,)


def test_states_alone_are_imitated_from_a_random_policy(problem):
    config = SMOKE.airl
    shown = transitions_of(problem.demonstrations)[0]
    states = shown._replace(action_t=None)

    def start(demonstrations, config):
        key = jax.random.PRNGKey(0)
        return jax.jit(lambda: airl.init(key, problem.env, demonstrations, config).average)()

    random = start(shown, dataclasses.replace(config, cloning_updates=0))
    for a, b in zip(*map(jax.tree.leaves, (start(states, config), random)), strict=True):
        np.testing.assert_array_equal(a, b)
    state = jax.jit(lambda key: airl.init(key, problem.env, states, config))(jax.random.PRNGKey(0))
    train = jax.jit(lambda state: airl.train(state, problem.env, states, config, 2))
    _, metrics = train(state)
    assert all(bool(jnp.isfinite(value)) for value in metrics.values())


@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_the_generator_is_paid_the_bounded_f_less_log_pi_that_sac_has_anyway(problem, agent):
    still = dataclasses.replace(SMOKE.airl.discriminator, learning_rate=1e-12, weight_decay=0.0)
    config = dataclasses.replace(
        SMOKE.airl,
        agent=agent,
        cloning_updates=0,
        discriminator=still,
        reward_scale=0.5,
        reward_clip=2.0,
    )
    demonstrations = transitions_of(problem.demonstrations)[0]

    @jax.jit
    def paid(f):
        state = airl.init(jax.random.PRNGKey(0), problem.env, demonstrations, config)
        params = state.discriminator.params
        constant = params._replace(g=_always(f, params.g), h=_always(0.0, params.h))
        state = state.replace(discriminator=state.discriminator.replace(params=constant))
        return airl.step(state, problem.env, demonstrations, config)[1]["batch_reward"]

    log_pi = 0.0 if agent == "sac" else config.discriminator.log_prob_clip
    for sign in (1.0, -1.0):
        found = sign * float(paid(sign * 50.0))
        assert 0.5 * (2.0 - log_pi) - 1e-5 <= found <= 0.5 * (2.0 + log_pi) + 1e-5


def _always(value, params):
    """Parameters of a network that returns the value, whatever it sees."""

    def leaf(path, x):
        return jnp.full_like(x, value if path[-1].key == "bias" and x.shape == (1,) else 0.0)

    return jax.tree_util.tree_map_with_path(leaf, params)


@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_the_discriminator_learns_to_prefer_what_was_demonstrated(problem, agent):
    quick = dataclasses.replace(SMOKE.airl.discriminator, learning_rate=3e-3)
    config = dataclasses.replace(SMOKE.airl, agent=agent, discriminator=quick, cloning_updates=0)
    shown = transitions_of(problem.demonstrations)[0]
    # Where no policy ever is.
    far = shown._replace(obs_t=shown.obs_t + 30.0, next_obs_t=shown.next_obs_t + 30.0)

    @jax.jit
    def preference(key):
        state = airl.init(key, problem.env, far, config)
        after, _ = airl.train(state, problem.env, far, config, 5)

        def prefers(params):
            f = [discriminator.advantage(params, rows, quick) for rows in (far, shown)]
            return jnp.mean(f[0]) - jnp.mean(f[1])

        return prefers(state.discriminator.params), prefers(after.discriminator.params)

    before, after = preference(jax.random.PRNGKey(0))
    assert after > before + 0.1 and after > 0.0


@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_the_policy_handed_on_is_the_average(problem, agent):
    config = dataclasses.replace(SMOKE.airl, agent=agent, policy_average_rate=0.25)
    # A step of PPO is of more environment steps than one of SAC, and enters by as much more.
    rate = 1.0 - 0.75 ** (airl.generator(config)[1].env_steps_per_step / 64)
    demonstrations = transitions_of(problem.demonstrations)[0]

    @jax.jit
    def one_step(key):
        before = airl.init(key, problem.env, demonstrations, config)
        after, _ = airl.step(before, problem.env, demonstrations, config)
        return before, after

    before, after = one_step(jax.random.PRNGKey(0))
    expected = jax.tree.map(
        lambda old, new: (1.0 - rate) * old + rate * new,
        before.average,
        after.agent.learner.policy_params,
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6),
        airl.finish(after).policy.policy,
        expected,
    )


@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_a_generator_that_does_not_learn_stays_the_clone(problem, agent):
    config = dataclasses.replace(SMOKE.airl, agent=agent, learn_policy=False)
    demonstrations = transitions_of(problem.demonstrations)[0]
    init = jax.jit(lambda key: airl.init(key, problem.env, demonstrations, config))
    train = jax.jit(lambda state: airl.train(state, problem.env, demonstrations, config, 3))
    before = init(jax.random.PRNGKey(0))
    after, _ = train(before)
    for a, b in zip(*map(jax.tree.leaves, (before.average, after.average)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)
    moved = [
        not np.array_equal(a, b)
        for a, b in zip(
            *(jax.tree.leaves(state.discriminator.params.g) for state in (before, after)),
            strict=True,
        )
    ]
    assert any(moved)


def test_noise_levels_are_those_of_ssrr(problem):
    demonstrations = transitions_of(problem.demonstrations)[0]
    sac = dataclasses.replace(SMOKE.airl.sac, num_envs=10, buffer_capacity=400)
    config = dataclasses.replace(SMOKE.airl, sac=sac)
    init = jax.jit(lambda key: airl.init(key, problem.env, demonstrations, config))
    state = init(jax.random.PRNGKey(0))
    levels = state.agent.env_state.info["noise_level"]
    np.testing.assert_allclose(levels, airl.TRAINING_NOISE_LEVELS)


@pytest.mark.parametrize(
    "num_envs, expected",
    [
        (1, [0.0]),
        (2, [0.0, 0.25]),
        (4, [0.0, 0.0, 0.1, 0.25]),
        (12, [*airl.TRAINING_NOISE_LEVELS, 0.0, 0.0]),
    ],
)
def test_any_number_of_environments_has_clean_and_noisy_ones(num_envs, expected):
    np.testing.assert_allclose(airl.training_noise_levels(num_envs), expected)


def test_bad_settings_are_named():
    with pytest.raises(UsageError, match="env_steps"):
        airl.AirlConfig(env_steps=0)
    with pytest.raises(UsageError, match="agent"):
        airl.AirlConfig(agent="td3")
    with pytest.raises(UsageError, match="policy_average_rate"):
        airl.AirlConfig(policy_average_rate=0.0)
    with pytest.raises(UsageError, match="cloning_updates"):
        airl.AirlConfig(cloning_updates=0, learn_policy=False)
    normalizing = dataclasses.replace(SMOKE.airl.sac, normalize_observations=True)
    with pytest.raises(UsageError, match=r"^sac\.normalize_observations"):
        airl.AirlConfig(sac=normalizing)
    wide = dataclasses.replace(SMOKE.airl.sac, hidden_sizes=(16, 16))
    with pytest.raises(UsageError, match=r"policies\.sac\.hidden_sizes"):
        dataclasses.replace(SMOKE, airl=dataclasses.replace(SMOKE.airl, sac=wide))
    sac = dataclasses.replace(SMOKE.policies.sac, normalize_observations=True)
    with pytest.raises(UsageError, match=r"^policies\.sac\.normalize_observations"):
        dataclasses.replace(SMOKE, policies=dataclasses.replace(SMOKE.policies, sac=sac))
    with pytest.raises(UsageError, match=r"^reward_clip: expected positive, found -10"):
        airl.AirlConfig(reward_clip=-10.0)
