"""The comparison in closed form, and policies whose return Gymnasium must agree with exactly."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from represent_jax.envs import Episode, make_env
from represent_jax.errors import UsageError
from represent_jax.methods import transfer


def test_comparison_has_a_known_answer():
    found = transfer.compare(np.array([1.0, 3.0]), np.array([4.0, 6.0, 8.0, 10.0]))
    # Variances 2 and 20/3, of means 1 and 5/3: (7 - 2) / sqrt(8/3).
    np.testing.assert_allclose(found, (2.0, 1.0, 7.0, (5 / 3) ** 0.5, 5.0 / (8 / 3) ** 0.5))
    assert transfer.compare(np.ones(3), np.ones(2)).difference == 0.0
    assert transfer.compare(np.ones(3), np.zeros(2)).difference == -np.inf


def test_equal_returns_are_within_two_standard_errors_in_nineteen_of_twenty():
    rng = np.random.default_rng(0)
    differences = [
        transfer.compare(rng.normal(size=40), rng.normal(size=60)).difference for _ in range(500)
    ]
    assert 0.92 < np.mean(np.abs(differences) < 2.0) < 0.98
    shifted = transfer.compare(rng.normal(size=400), rng.normal(1.0, size=400))
    assert 11.0 < shifted.difference < 18.0


@pytest.fixture(autouse=True)
def log_elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings into the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", transfer.TASKS)
def test_a_policy_earns_as_much_in_gymnasium(name):
    """Twenty steps from the same law of initial states, on both sides."""
    env = Episode(make_env(name, "mujoco"), horizon=20)
    weights = jax.random.normal(jax.random.PRNGKey(1), (env.observation_size, env.action_size))
    policies = {"task": lambda obs: jnp.tanh(obs @ weights)}
    found = transfer.transfer(name, env, policies, num_episodes=64, seed=0)["task"]
    assert abs(found.difference) < 4.0, found
    assert 0.0 < found.ours_error < 0.2 * max(1.0, abs(found.ours))


def test_episodes_that_end_early_are_counted_to_their_end():
    """Idle double pendulums fall; what Gymnasium pays after its reset is not theirs."""
    idle = lambda obs: jnp.zeros((*obs.shape[:-1], 1))  # noqa: E731
    returns = transfer.gymnasium_returns("inverted_double_pendulum", 300, idle, 3, seed=7)
    env = gymnasium.make("InvertedDoublePendulum-v5").unwrapped
    expected = []
    for seed in (7, 8, 9):
        env.reset(seed=seed)
        total, terminated = 0.0, False
        while not terminated:
            _, _, terminated, _, _ = env.step(np.zeros(1))
            tip_x, _, tip_z = env.data.site_xpos[0]
            v1, v2 = env.data.qvel[1:3]
            distance = 0.01 * tip_x**2 + (tip_z - 2.0) ** 2
            total += 10.0 - distance - 1e-3 * v1**2 - 5e-3 * v2**2
        expected.append(total)
    np.testing.assert_allclose(returns, expected, rtol=1e-6)
    assert np.ptp(returns) > 0.0


def test_tasks_that_gymnasium_lacks_are_refused():
    with pytest.raises(UsageError, match="unknown task of Gymnasium 'franka_kitchen'"):
        transfer.gymnasium_returns("franka_kitchen", 5, lambda obs: obs, 2, seed=0)
