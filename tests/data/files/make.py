"""Makes the files beside it with imitation 1.0.1 and d4rl 1.1; see README.md.

python -m venv /tmp/other && /tmp/other/bin/pip install imitation==1.0.1 h5py gym==0.26.2
/tmp/other/bin/pip install --no-deps d4rl==1.1
/tmp/other/bin/python tests/data/files/make.py
"""

import os
from pathlib import Path

import gymnasium
import numpy as np

os.environ["D4RL_SUPPRESS_IMPORT_ERROR"] = "1"

from d4rl.utils.dataset_utils import DatasetWriter
from imitation.data import rollout, serialize, types
from imitation.data.wrappers import RolloutInfoWrapper
from imitation.policies.base import RandomPolicy
from stable_baselines3.common.vec_env import DummyVecEnv

HERE = Path(__file__).parent


def imitation_trajectories(exclude_infos):
    """Two random episodes of 3 and 5 steps, both cut by a time limit."""
    trajectories = []
    for steps in (3, 5):
        env = RolloutInfoWrapper(gymnasium.make("Pendulum-v1", max_episode_steps=steps))
        envs = DummyVecEnv([lambda env=env: env])
        envs.seed(0)
        envs.action_space.seed(0)
        trajectories += rollout.rollout(
            RandomPolicy(envs.observation_space, envs.action_space),
            envs,
            rollout.make_sample_until(min_episodes=1),
            rng=np.random.default_rng(0),
            unwrap=False,
            exclude_infos=exclude_infos,
        )
    return trajectories


def write_old_npz(path, trajectories):
    """The layout that `serialize.load` knows from the library's older versions."""
    np.savez_compressed(
        path,
        obs=np.concatenate([t.obs for t in trajectories]),
        acts=np.concatenate([t.acts for t in trajectories]),
        rews=np.concatenate([t.rews for t in trajectories]),
        infos=np.concatenate([np.array([{}] * len(t)) for t in trajectories]),
        terminal=np.array([t.terminal for t in trajectories]),
        indices=np.cumsum([len(t) for t in trajectories[:-1]]),
    )
    assert [len(t) for t in serialize.load(path)] == [3, 5]


def d4rl_writer(*extra):
    """Seven steps: terminal at the second, a time limit four steps later, and one step more."""
    writer = DatasetWriter()
    writer.data |= {name: [] for name in extra}
    env = gymnasium.make("Pendulum-v1", max_episode_steps=4)
    env.action_space.seed(1)
    obs, _ = env.reset(seed=1)
    for step in range(7):
        action = env.action_space.sample()
        next_obs, reward, _, timeout, _ = env.step(action)
        terminal = step == 1  # a pendulum never terminates by itself
        writer.append_data(obs, action, reward, terminal)
        if "timeouts" in extra:
            writer.data["timeouts"].append(timeout)
        if "next_observations" in extra:
            writer.data["next_observations"].append(next_obs)
        obs = env.reset()[0] if terminal or timeout else next_obs
    return writer


if __name__ == "__main__":
    serialize.save(HERE / "imitation_with_infos", imitation_trajectories(exclude_infos=False))
    plain = imitation_trajectories(exclude_infos=True)
    without_rewards = [types.Trajectory(t.obs, t.acts, None, False) for t in plain]
    serialize.save(HERE / "imitation_without_rewards", without_rewards)
    write_old_npz(HERE / "imitation_old.npz", plain)
    for name, extra in {
        "d4rl_with_next.hdf5": ("timeouts", "next_observations"),
        "d4rl_with_timeouts.hdf5": ("timeouts",),
        "d4rl_plain.hdf5": (),
    }.items():
        d4rl_writer(*extra).write_dataset(HERE / name)
