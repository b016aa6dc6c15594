"""Learned rewards in Gymnasium: the run's own values, and never those of a reset's observation."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import represent_jax as rj
from represent_jax.errors import RepresentError, UsageError

OBS_DIM, ACTION_DIM = 17, 6


class Counter(gymnasium.Env):
    """Observations count up from the number of the episode times 100; ends after four steps."""

    def __init__(self, bound=1.0):
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS_DIM,))
        self.action_space = gymnasium.spaces.Box(-bound, bound, (ACTION_DIM,))
        self.episode = self.steps = 0

    def _obs(self):
        return np.full(OBS_DIM, 0.01 * self.steps + self.episode, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.steps = self.episode + 1, 0
        return self._obs(), {}

    def step(self, action):
        self.steps += 1
        return self._obs(), float(self.steps), False, self.steps == 4, {}


def obs_at(episode, steps):
    return np.full(OBS_DIM, 0.01 * steps + episode, np.float32)


@pytest.fixture(scope="module")
def reward(half_cheetah_run):
    """The run's rewards of single transitions."""
    loaded = rj.load_reward(half_cheetah_run)

    def one(obs, action, next_obs, target="task"):
        return float(loaded(obs, np.asarray(action, np.float32), next_obs, target=target))

    return one


def test_it_pays_the_learned_reward_and_keeps_the_true_one(half_cheetah_run, reward):
    env = rj.gymnasium.LearnedReward(Counter(bound=2.0), half_cheetah_run, "strategy_2", scale=3.0)
    env.reset(seed=0)
    for step in range(4):
        action = np.linspace(-2.0, 4.0, ACTION_DIM, dtype=np.float32)
        obs, paid, terminated, truncated, info = env.step(action)
        unit = np.clip(action / 2.0, -1.0, 1.0)
        expected = 3.0 * reward(obs_at(1, step), unit, obs_at(1, step + 1), "strategy_2")
        assert paid == pytest.approx(expected, rel=1e-5)
        assert info["true_reward"] == step + 1
        assert (terminated, truncated) == (False, step == 3)
        np.testing.assert_array_equal(obs, obs_at(1, step + 1))
    env.reset()
    _, paid, *_ = env.step(np.zeros(ACTION_DIM))
    expected = reward(obs_at(2, 0), np.zeros(ACTION_DIM), obs_at(2, 1), "strategy_2")
    assert paid == pytest.approx(3.0 * expected, rel=1e-5)


def make_vector(mode, **options):
    return SyncVectorEnv([Counter, Counter], autoreset_mode=mode, **options)


@pytest.mark.parametrize("copy", [True, False])
def test_vector_that_resets_in_the_same_step(half_cheetah_run, reward, copy):
    """Ten steps of episodes of four: the last is paid for its own final observation."""
    envs = rj.gymnasium.LearnedRewardVector(
        make_vector(AutoresetMode.SAME_STEP, copy=copy), half_cheetah_run
    )
    actions = np.full((2, ACTION_DIM), [[0.5], [-0.5]], np.float32)
    envs.reset(seed=0)
    for step in range(10):
        episode, start = 1 + step // 4, step % 4
        _, rewards, _, truncated, infos = envs.step(actions)
        for i in range(2):
            expected = reward(obs_at(episode, start), actions[i], obs_at(episode, start + 1))
            assert rewards[i] == pytest.approx(expected, rel=1e-5)
        np.testing.assert_array_equal(infos["true_reward"], start + 1)
        assert infos["_true_reward"].all()
        assert truncated.all() == (start == 3)


def test_vector_that_resets_in_the_next_step(half_cheetah_run, reward):
    """The step that resets is no transition: it pays nothing."""
    envs = rj.gymnasium.LearnedRewardVector(make_vector(AutoresetMode.NEXT_STEP), half_cheetah_run)
    actions = np.full((2, ACTION_DIM), 0.5, np.float32)
    envs.reset(seed=0)
    for step in range(10):
        episode, start = 1 + step // 5, step % 5
        _, rewards, _, _, infos = envs.step(actions)
        if start == 4:
            np.testing.assert_array_equal(rewards, 0.0)
            assert not infos["_true_reward"].any()
            continue
        expected = reward(obs_at(episode, start), actions[0], obs_at(episode, start + 1))
        np.testing.assert_allclose(rewards, expected, rtol=1e-5)
        assert infos["_true_reward"].all()


def test_vector_that_its_user_resets(half_cheetah_run, reward):
    envs = rj.gymnasium.LearnedRewardVector(make_vector(AutoresetMode.DISABLED), half_cheetah_run)
    actions = np.zeros((2, ACTION_DIM), np.float32)
    envs.reset(seed=0)
    envs.step(actions)
    envs.reset(options={"reset_mask": np.array([False, True])})
    _, rewards, *_ = envs.step(actions)
    expected = [reward(obs_at(1, 1), actions[0], obs_at(1, 2))]
    expected += [reward(obs_at(2, 0), actions[1], obs_at(2, 1))]
    np.testing.assert_allclose(rewards, expected, rtol=1e-5)


def test_a_masked_reset_ends_waiting_for_one(half_cheetah_run):
    envs = rj.gymnasium.LearnedRewardVector(make_vector(AutoresetMode.NEXT_STEP), half_cheetah_run)
    actions = np.zeros((2, ACTION_DIM), np.float32)
    envs.reset(seed=0)
    for _ in range(4):
        envs.step(actions)
    envs.reset(options={"reset_mask": np.array([True, False])})
    _, rewards, *_ = envs.step(actions)
    assert rewards[0] != 0.0 and rewards[1] == 0.0


def test_gymnasiums_own_environment(half_cheetah_run):
    """Made by name with the wrapper, and again from its specification."""
    env = gymnasium.make("HalfCheetah-v5")
    env = rj.gymnasium.LearnedReward(env, half_cheetah_run)
    again = gymnasium.make(env.spec)
    paid = []
    for one in (env, again):
        one.reset(seed=0)
        paid.append(one.step(np.full(ACTION_DIM, 0.3, np.float32))[1])
    assert paid[0] == paid[1]


def test_spaces_are_checked(half_cheetah_run):
    wrap = rj.gymnasium.LearnedReward
    with pytest.raises(UsageError, match=r"observation size: expected 17.*half_cheetah.*found 11"):
        wrap(gymnasium.make("Hopper-v5"), half_cheetah_run)
    with pytest.raises(UsageError, match="observation_space: expected a Box"):
        wrap(gymnasium.make("FrozenLake-v1"), half_cheetah_run)
    with pytest.raises(UsageError, match="action_space: expected a Box"):
        wrap(gymnasium.make("CartPole-v1"), half_cheetah_run)
    with pytest.raises(UsageError, match="action_space: expected bounded actions"):
        wrap(Counter(bound=np.inf), half_cheetah_run)
    with pytest.raises(UsageError, match="unknown target 'strategy_3'"):
        wrap(Counter(), half_cheetah_run, "strategy_3")
    with pytest.raises(RepresentError, match="nowhere"):
        wrap(Counter(), "nowhere")


def test_a_vector_has_to_say_how_it_resets(half_cheetah_run):
    envs = make_vector(AutoresetMode.NEXT_STEP)
    envs.metadata = {}
    with pytest.raises(UsageError, match="autoreset_mode"):
        rj.gymnasium.LearnedRewardVector(envs, half_cheetah_run)
