"""Judges a run's rewards on trajectories of your choice, and its policies in fresh episodes.

python -m experiments.evaluate --run=runs/demo
python -m experiments.evaluate --run=runs/demo --trajectories=mine.npz --noise_level=0.1
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from absl import flags

from experiments import launch
from represent_jax.agents import rollout
from represent_jax.api import load_config
from represent_jax.data.catalogue import load_test
from represent_jax.data.trajectories import TrajectoryBatch, pad
from represent_jax.envs import Episode, make_env
from represent_jax.errors import RepresentError, UsageError
from represent_jax.methods.registry import find_method
from represent_jax.report import tables
from represent_jax.report.values import display_name, format_number
from represent_jax.runs import RunDirectory
from represent_jax.stages import evaluation

_RUN = flags.DEFINE_string("run", None, "Run folder.", required=True)
_TRAJECTORIES = flags.DEFINE_string(
    "trajectories",
    "",
    "Name or npz file of trajectories, judged whole; if empty those that the run was judged on.",
)
_EPISODES = flags.DEFINE_integer("episodes", 10, "Episodes of each policy.", lower_bound=1)
_NOISE_LEVEL = flags.DEFINE_float(
    "noise_level",
    0.0,
    "Share of random actions.",
    lower_bound=0.0,
    upper_bound=1.0,
)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of the episodes.")
_BACKEND = flags.DEFINE_string("backend", None, "Physics engine; that of the run if not given.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    config = load_config(_RUN.value)
    robot = make_env(config.env, _BACKEND.value or config.backend)
    env = Episode(robot, config.horizon or robot.horizon, auto_reset=False)
    data = load_test(config.env, _TRAJECTORIES.value or config.test)
    method, directory = find_method(config.method), RunDirectory(_RUN.value)
    policies = {}
    if directory.is_done(method.policies_in):
        policies = method.load_policies(config, robot, directory)
    try:
        rewards = method.load_rewards(config, robot, directory)
    except RepresentError:
        # A clone has no reward; there are its policy's episodes to look at.
        if not policies:
            raise
        rewards = {}
    if data is None and not policies:
        raise UsageError(f"no trajectories of {config.env} ship: give some with --trajectories")
    batch, columns = None, ("target",)
    if data is not None:
        data.check_against(env.observation_size, env.action_size, -1.0, 1.0)
        if not data.has_rewards:
            raise UsageError("the trajectories hold no true rewards, to compare learned ones with")
        batch = pad(data.trajectories, max(t.length for t in data.trajectories))
        columns += ("Pearson", "Spearman")
    targets = config.target_names
    sampled = getattr(getattr(config, "policies", None), "actions", "mode") == "sampled"
    if policies:
        columns += ("true return", "std", "learned return", "std")
    rows = []
    for target in targets:
        reward = rewards.get(target)
        row = [display_name(target)]
        if batch is not None:
            row += _correlations(batch, reward) if reward else ["-", "-"]
        if target in policies:
            episodes = _episodes(env, policies[target], sampled)
            row += _mean_and_std(rollout.true_returns(episodes))
            row += _mean_and_std(_learned_returns(episodes, reward)) if reward else ["-", "-"]
        rows.append((*row, *["-"] * (len(columns) - len(row))))
    table = tables.Table(
        title=f"{len(data.trajectories) if data else 'No'} trajectories, "
        f"{_EPISODES.value} episodes of each policy",
        columns=columns,
        rows=tuple(rows),
        note="",
    )
    print(tables.to_text(table))


def _episodes(env: Episode, policy: Callable[..., jax.Array], sampled: bool) -> TrajectoryBatch:
    """Episodes of a policy, under the noise asked for; sampled actions differ between them."""

    def act(_, obs_t, key):
        return policy(obs_t, key) if sampled else policy(obs_t)

    levels = jnp.full(_EPISODES.value, _NOISE_LEVEL.value)
    roll_out = jax.jit(lambda key: rollout.rollout(env, act, None, key, levels))
    return roll_out(jax.random.PRNGKey(_SEED.value))


def _learned_returns(batch: TrajectoryBatch, reward: Callable[..., jax.Array]) -> jax.Array:
    return rollout.learned_returns(batch, lambda _, *transition: reward(*transition), None)


def _correlations(batch: TrajectoryBatch, reward: Callable[..., jax.Array]) -> list[str]:
    found = evaluation.correlate(rollout.true_returns(batch), _learned_returns(batch, reward))
    return [format_number(float(x), 3) for x in found]


def _mean_and_std(values: jax.Array) -> list[str]:
    return [format_number(float(np.mean(values))), format_number(float(np.std(values)))]


if __name__ == "__main__":
    launch.run(main)
