"""Makes demonstrators that are imperfect and differ in style, and trajectories to test on.

DIAYN with the environment's reward is stopped early, skill by skill: a skill's demonstrations
come from the training snapshot whose return is nearest to the wanted one. The test set comes from
snapshots of another seed, evenly spread over training, so that returns go from low to high.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.agents import sac
from represent_jax.agents.rollout import rollout
from represent_jax.agents.sac import SacConfig
from represent_jax.config import require
from represent_jax.data.trajectories import (
    Demonstrations,
    Trajectory,
    TrajectoryBatch,
    returns,
    unpad,
)
from represent_jax.envs import Episode, make_env
from represent_jax.errors import RepresentError
from represent_jax.methods.population import member_of
from represent_jax.runs.loop import advance
from represent_jax.stages import diayn
from represent_jax.stages.diayn import DiaynConfig

_LEAST = {
    "env_steps": 1,
    "test_env_steps": 1,
    "snapshot_env_steps": 1,
    # One to fit styles to, and one to judge them.
    "trajectories_per_skill": 2,
    "demonstration_horizon": 0,
    "steadiness_weight": 0,
    "test_snapshots": 2,
    "test_trajectories_per_skill": 1,
}


@dataclasses.dataclass(frozen=True)
class DemonstratorConfig:
    """Settings of one domain's demonstrators.

    Attributes:
      env: the environment's name.
      seed: seed of the demonstrators.
      test_seed: seed of the agent whose snapshots become the test set.
      env_steps: training budget of the demonstrators.
      test_env_steps: training budget of the test set's agent.
      snapshot_env_steps: environment steps between two snapshots of the demonstrators.
      target_returns: wanted mean true return of each skill.
      trajectories_per_skill: demonstrations of each skill.
      demonstration_horizon: steps after which a demonstration is cut off; 0 is the environment's
        own. Where the wanted episodes end early by themselves, a lower one saves rolling out
        later skills in full at every snapshot.
      steadiness_weight: weight, in judging a snapshot, of how much the two halves of its episodes
        differ; by its mean return alone, who runs and then falls passes for one who walks.
      strategy_order: which of the chosen skills becomes which strategy; as chosen if empty.
      min_skill_accuracy: share of its states by which DIAYN's discriminator must know a skill
        before it can demonstrate.
      test_snapshots: snapshots in the test set, the untrained agent among them.
      test_trajectories_per_skill: test trajectories of each skill at each snapshot.
      diayn: the agent.
    """

    env: str = "half_cheetah"
    seed: int = 0
    test_seed: int = 100
    env_steps: int = 480_000
    test_env_steps: int = 480_000
    snapshot_env_steps: int = 8_000
    target_returns: tuple[float, ...] = (1243.13, 1172.71, 1181.35)
    trajectories_per_skill: int = 4
    demonstration_horizon: int = 0
    steadiness_weight: float = 0.0
    strategy_order: tuple[int, ...] = ()
    min_skill_accuracy: float = 0.9
    test_snapshots: int = 18
    test_trajectories_per_skill: int = 2
    diayn: DiaynConfig = DiaynConfig(num_skills=3)

    def __post_init__(self) -> None:
        require(
            len(self.target_returns) == self.diayn.num_skills,
            "target_returns",
            f"one for each of {self.diayn.num_skills} skills",
            self.target_returns,
        )
        require(
            sorted(self.strategy_order) in ([], list(range(self.diayn.num_skills))),
            "strategy_order",
            f"empty or an order of 0 to {self.diayn.num_skills - 1}",
            self.strategy_order,
        )
        require(
            all(self.target_returns),
            "target_returns",
            "none that is 0, since a skill is judged by its error as a share of it",
            self.target_returns,
        )
        require(self.seed != self.test_seed, "test_seed", "another than seed", self.test_seed)
        for field, least in _LEAST.items():
            require(getattr(self, field) >= least, field, f"at least {least}", getattr(self, field))
        share = self.min_skill_accuracy
        require(0.0 <= share <= 1.0, "min_skill_accuracy", "in [0, 1]", share)


_SAC = SacConfig(initial_temperature=0.1, learning_rate=1e-3)

DEMONSTRATORS = {
    "half_cheetah": DemonstratorConfig(
        seed=3,
        test_seed=101,
        env_steps=112_000,
        test_env_steps=480_000,
        snapshot_env_steps=2_048,
        min_skill_accuracy=0.4,
        # The second and third targets are 1 % apart; this way the first two styles differ most.
        strategy_order=(0, 2, 1),
        diayn=DiaynConfig(
            num_skills=3,
            diversity_weight=2.0,
            # Joint angles: styles then are gaits, not running on the back.
            discriminator_obs=(2, 3, 4, 5, 6, 7),
            sac=dataclasses.replace(_SAC, initial_temperature=1.0),
        ),
    ),
    "hopper": DemonstratorConfig(
        env="hopper",
        env_steps=880_000,
        test_env_steps=960_000,
        snapshot_env_steps=16_000,
        target_returns=(1197.93, 1587.98),
        steadiness_weight=1.0,
        test_trajectories_per_skill=3,
        diayn=DiaynConfig(
            num_skills=2,
            diversity_weight=0.5,
            sac=dataclasses.replace(_SAC, initial_temperature=1.0),
        ),
    ),
    "inverted_double_pendulum": DemonstratorConfig(
        env="inverted_double_pendulum",
        env_steps=160_000,
        test_env_steps=240_000,
        snapshot_env_steps=1_600,
        target_returns=(861.84, 1217.65),
        trajectories_per_skill=20,
        min_skill_accuracy=0.8,
        demonstration_horizon=300,
        test_trajectories_per_skill=4,
        # A floor of 0: negative rewards would make falling over attractive.
        diayn=DiaynConfig(
            num_skills=2,
            diversity_weight=20.0,
            diversity_floor=0.0,
            sac=dataclasses.replace(_SAC, learning_rate=3e-4),
        ),
    ),
}
# By the name they ship under. How much the task reward gains from more strategies is asked of
# eight styles of one agent; the test set is the domain's own. The targets are what its skills
# offer: one learns too fast for any snapshot to show it steady below 1,800.
_CHEETAH = DEMONSTRATORS["half_cheetah"]
DEMONSTRATORS["half_cheetah_8"] = dataclasses.replace(
    _CHEETAH,
    env_steps=180_000,
    min_skill_accuracy=0.15,
    strategy_order=(),
    target_returns=(900.0, 1050.0, 1100.0, 1150.0, 1200.0, 1250.0, 1300.0, 1800.0),
    diayn=dataclasses.replace(_CHEETAH.diayn, num_skills=8),
)


class Snapshot(NamedTuple):
    """Rollouts of all skills at one moment of training.

    Attributes:
      env_steps: environment steps trained so far.
      trajectories: `[num_skills, num_episodes]`.
      accuracy: share of states by which the discriminator knows each skill, `[num_skills]`.
    """

    env_steps: int
    trajectories: TrajectoryBatch
    accuracy: np.ndarray


def train(
    config: DemonstratorConfig,
    seed: int,
    env_steps: int,
    snapshot_env_steps: int,
    num_episodes: int,
    horizon: int = 0,
    backend: str = "auto",
) -> list[Snapshot]:
    """Trains one DIAYN agent and rolls out every skill at every snapshot."""
    env = make_env(config.env, backend)
    episodes, whole = Episode(env), Episode(env, horizon or env.horizon, auto_reset=False)
    diayn_config = config.diayn
    key_init, key_rollout = jax.random.split(jax.random.PRNGKey(seed))
    state = jax.jit(lambda key: diayn.init(key, episodes, diayn_config))(key_init)
    steps = max(1, snapshot_env_steps // diayn_config.sac.num_envs)
    snapshot_env_steps = steps * diayn_config.sac.num_envs
    train_steps = jax.jit(
        lambda state: diayn.train(state, episodes, diayn_config, steps), donate_argnums=0
    )

    @jax.jit
    def roll(params, discriminator, key):
        def one_skill(key, skill):
            def policy(params, obs_t, key):
                return diayn.act(params, skill, obs_t, key, diayn_config, env.action_size)

            batch = rollout(whole, policy, params, key, jnp.zeros(num_episodes))
            posterior = diayn.log_skill_posterior(discriminator, batch.obs[:, 1:], diayn_config)
            known = (jnp.argmax(posterior, axis=-1) == skill) * batch.mask
            return batch, jnp.sum(known) / jnp.sum(batch.mask)

        skills = jnp.arange(diayn_config.num_skills)
        return jax.vmap(one_skill)(jax.random.split(key, skills.size), skills)

    snapshots = []

    def snap(state) -> Snapshot:
        key = jax.random.fold_in(key_rollout, len(snapshots))
        policy = sac.policy_of(state.sac.learner)
        batch, accuracy = jax.device_get(roll(policy, state.discriminator, key))
        snapshots.append(Snapshot(int(state.sac.env_steps), batch, accuracy))
        return snapshots[-1]

    def chunk(state):
        state, _ = train_steps(state)
        snapshot = snap(state)
        means = returns(snapshot.trajectories).mean(axis=1)
        return state, {"returns": means, "accuracy": snapshot.accuracy}

    snap(state)
    advance(
        None,
        f"{config.env} seed {seed}",
        state,
        chunk,
        env_steps // snapshot_env_steps,
        units_per_chunk=snapshot_env_steps,
        describe=lambda m: f"returns {m['returns'].round()}, known by {m['accuracy'].round(2)}",
    )
    return snapshots


def choose_demonstrations(
    snapshots: Sequence[Snapshot],
    target_returns: Sequence[float],
    min_skill_accuracy: float = 0.0,
    strategy_order: Sequence[int] = (),
    steadiness_weight: float = 0.0,
) -> tuple[list[Trajectory], list[int]]:
    """Takes the demonstrations of each target return from the snapshot and skill nearest to it.

    A snapshot is judged by the relative error of its mean return plus the relative spread of its
    episodes: a demonstrator who half the time falls on its back has no style to learn from.
    With `steadiness_weight` the difference between the halves of an episode, relative to the
    whole, is added. Skills learn at different speeds, so they are first dealt out to the targets
    such that these costs are least in sum. Strategy i is the skill that serves target i.

    `strategy_order` then renumbers them, for targets too close to each other to tell which skill
    should be which.

    Raises:
      RepresentError: a skill is never known well enough.

    Returns:
      Trajectories of all strategies, and the environment steps of each strategy's snapshot.
    """
    targets = np.asarray(target_returns)
    episodes = np.stack([returns(s.trajectories) for s in snapshots])
    known = np.stack([s.accuracy for s in snapshots]) >= min_skill_accuracy
    if not known.any(axis=0).all():
        raise RepresentError(
            f"skills {np.flatnonzero(~known.any(axis=0)).tolist()} are never known by "
            f"{min_skill_accuracy:.0%} of their states: train longer or raise diversity_weight"
        )
    mean, spread = episodes.mean(axis=-1)[..., None], episodes.std(axis=-1)[..., None]
    cost = np.abs(mean / targets - 1.0) + spread / np.abs(targets)  # [snapshot, skill, target]
    if steadiness_weight:
        halves = np.stack([_halves(s.trajectories) for s in snapshots])
        unsteady = np.abs(halves[..., 0] - halves[..., 1]).mean(axis=-1)[..., None]
        cost = cost + steadiness_weight * unsteady / np.maximum(np.abs(mean), 1e-6)
    cost = np.where(known[:, :, None], cost, np.inf)
    order = min(
        itertools.permutations(range(len(targets))),
        key=lambda skills: sum(cost[:, skill, i].min() for i, skill in enumerate(skills)),
    )
    trajectories, env_steps = [], []
    for strategy, target in enumerate(strategy_order or range(len(targets))):
        skill = order[target]
        snapshot = snapshots[int(np.argmin(cost[:, skill, target]))]
        batch = member_of(snapshot.trajectories, skill)
        trajectories += unpad(batch._replace(strategy=np.full_like(batch.strategy, strategy)))
        env_steps.append(snapshot.env_steps)
    return trajectories, env_steps


def _halves(batch: TrajectoryBatch) -> np.ndarray:
    """True return of the first and of the second half of the horizon, `[..., 2]`."""
    rewards = np.asarray(batch.rewards) * np.asarray(batch.mask)
    middle = rewards.shape[-1] // 2
    return np.stack([rewards[..., :middle].sum(-1), rewards[..., middle:].sum(-1)], axis=-1)


def choose_test_set(
    snapshots: Sequence[Snapshot], num_snapshots: int, per_skill: int
) -> list[Trajectory]:
    """Takes trajectories of all skills at snapshots evenly spread over training."""
    chosen = np.unique(np.linspace(0, len(snapshots) - 1, num_snapshots).round().astype(int))
    trajectories = []
    for index in chosen:
        batch = jax.tree.map(lambda x: x[:, :per_skill], snapshots[index].trajectories)
        for skill in range(batch.mask.shape[0]):
            one = member_of(batch, skill)
            trajectories += unpad(one._replace(strategy=np.full_like(one.strategy, skill)))
    return trajectories


def by_agent(test: Demonstrations) -> Demonstrations:
    """Relabels a test set by who acted: one skill of one snapshot is one agent.

    Only the second half of training is kept: untrained skills all act alike.

    Raises:
      RepresentError: the file does not say how many trajectories each agent has.
    """
    each = test.metadata.get("config", {}).get("test_trajectories_per_skill")
    if not each or len(test.trajectories) % each:
        raise RepresentError(
            f"test set of {test.env_name}: metadata: expected config.test_trajectories_per_skill, "
            f"a divisor of its {len(test.trajectories)} trajectories, found {each}"
        )
    num_agents = len(test.trajectories) // each
    late = test.trajectories[num_agents // 2 * each :]
    own = tuple(dataclasses.replace(t, strategy=i // each) for i, t in enumerate(late))
    return dataclasses.replace(test, trajectories=own)
