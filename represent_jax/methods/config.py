"""Settings of a method, and the problem it is given."""

import dataclasses
from typing import NamedTuple

from represent_jax.config import later, require
from represent_jax.data.trajectories import Demonstrations, Trajectory, without_pauses
from represent_jax.envs import Environment, Episode, registry
from represent_jax.errors import RepresentError, UsageError, unknown
from represent_jax.methods.population import MODES as POPULATION_MODES
from represent_jax.stages import airl, decomposition, policies
from represent_jax.stages.airl import AirlConfig
from represent_jax.stages.curve import CurveConfig
from represent_jax.stages.noise import NoiseConfig
from represent_jax.stages.policies import PoliciesConfig, TaskPolicyConfig
from represent_jax.stages.regression_config import RegressionConfig
from represent_jax.stages.selection import SelectionConfig


@dataclasses.dataclass(frozen=True)
class MethodConfig:
    """What the settings of every method begin with.

    Attributes:
      method: name of the method, one of `methods.registry`.
      env: the environment's name.
      preset: name of the preset the settings began as.
      seed: seed of everything after the demonstrations.
      phase_1_seed: seed of Phase 1 and of its noisy rollouts alone; `seed` if none. Kept while
        `seed` varies, it is the cheaper protocol of SSRR's authors: one Phase 1, several rewards.
      backend: physics engine.
      num_strategies: strategies used of those demonstrated; the first ones.
      grouping: "separate" keeps strategies apart; "merged" takes all demonstrations for those of
        one; "strategy_1" and so on takes that strategy alone.
      demonstrations: name or file of the demonstrations; the environment's own if empty.
      test: name or file of unseen trajectories, on which rewards are judged; the environment's own
        if empty, none where none ship.
      horizon: environment steps of an episode; 0 is the environment's own.
      least_change: of the entry of a demonstrated observation that changes most in a step; in less
        the demonstrator pauses, and methods do not learn from it. 0 keeps every step.
      population: how members run together, see `methods.population`.
    """

    method: str = "represent"
    env: str = "half_cheetah"
    preset: str = "quick"
    seed: int = 0
    phase_1_seed: int | None = later(None)
    backend: str = "auto"
    num_strategies: int = 2
    grouping: str = "separate"
    demonstrations: str = ""
    test: str = ""
    horizon: int = 0
    least_change: float = 0.0
    population: str = "auto"

    def __post_init__(self) -> None:
        require(self.num_strategies >= 1, "num_strategies", "at least 1", self.num_strategies)
        groupings = ("separate", "merged", *strategy_names(self.num_strategies))
        require(
            self.grouping in groupings,
            "grouping",
            f"one of {', '.join(groupings)}",
            self.grouping,
        )
        modes = f"one of {', '.join(POPULATION_MODES)}"
        require(self.population in POPULATION_MODES, "population", modes, self.population)
        require(self.seed >= 0, "seed", "at least 0", self.seed)
        require((self.phase_1_seed or 0) >= 0, "phase_1_seed", "at least 0", self.phase_1_seed)
        require(self.horizon >= 0, "horizon", "at least 0", self.horizon)
        require(self.least_change >= 0.0, "least_change", "at least 0", self.least_change)

    @property
    def protocol(self) -> str:
        """What records of these settings go by: the preset, and whether Phase 1 is repeated."""
        return self.preset if self.phase_1_seed is None else f"{self.preset}_one_phase_1"

    @property
    def num_groups(self) -> int:
        """Strategies that the method is given, after grouping."""
        return self.num_strategies if self.grouping == "separate" else 1

    @property
    def group_names(self) -> tuple[str, ...]:
        """What the groups are called: "strategy_1" and so on, or "merged"."""
        if self.grouping == "separate":
            return strategy_names(self.num_strategies)
        return (self.grouping,)

    @property
    def merged_name(self) -> str:
        """What a single reward or policy is called: "task", or the strategy it comes from alone."""
        return "task" if self.grouping in ("separate", "merged") else self.grouping

    @property
    def target_names(self) -> tuple[str, ...]:
        """Names of the rewards, or policies, that a run learns."""
        return (self.merged_name,)

    @property
    def policy_names(self) -> tuple[str, ...]:
        """Names of the targets that a policy is trained for."""
        return self.target_names

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """What a judge calls things, which is all that tells some runs' findings apart."""
        return {"groups": self.group_names, "targets": self.target_names}

    @property
    def needs_actions(self) -> str:
        """What in these settings needs demonstrated actions; empty where states are enough."""
        return ""

    def check_against(self, obs_dim: int) -> None:
        """Raises a UsageError for settings that observations of this size do not fit."""


@dataclasses.dataclass(frozen=True)
class OneGroupConfig(MethodConfig):
    """Settings of a method that takes all demonstrations for those of one strategy."""

    grouping: str = "merged"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.grouping != "separate", "grouping", "'merged' or one strategy", self.grouping)


@dataclasses.dataclass(frozen=True)
class RepresentConfig(MethodConfig):
    """Settings of REPRESENT, and of SSRR on the same stages.

    Attributes:
      policy_targets: targets that a policy is trained for; all if empty.
      airl, noise, curve, regression, policies, selection: settings of the stages; nothing is
        selected where only one policy is trained, or the rewards are not of one task.
      task_policy: what is different for the policy on R^0.
    """

    policy_targets: tuple[str, ...] = ()
    airl: AirlConfig = AirlConfig()
    noise: NoiseConfig = NoiseConfig()
    curve: CurveConfig = CurveConfig()
    regression: RegressionConfig = RegressionConfig()
    policies: PoliciesConfig = PoliciesConfig()
    selection: SelectionConfig = SelectionConfig()
    task_policy: TaskPolicyConfig = later(TaskPolicyConfig())

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.policy_targets:
            if name not in self.target_names:
                raise unknown("policy target", name, self.target_names)
        check_start(self.airl, self.policies)
        require(
            not self.clones_for_task or self.airl.cloning_updates > 0,
            "airl.cloning_updates",
            "above 0 where task_policy.start=clone",
            self.airl.cloning_updates,
        )
        require(
            self.task_policy.prior_half_life is None or self.policies.agent == "sac",
            "task_policy.prior_half_life",
            f"none with policies.agent={self.policies.agent}, which has no prior",
            self.task_policy.prior_half_life,
        )

    @property
    def clones_for_task(self) -> bool:
        """Whether the policy on R^0 starts from a clone of all demonstrations."""
        return self.policies.start == "phase1" and self.task_policy.start == "clone"

    @property
    def target_names(self) -> tuple[str, ...]:
        """ "task", "strategy_1", ...; one name where nothing is decomposed (alpha = 0)."""
        if self.regression.strategy_weight == 0.0:
            return (self.merged_name,)
        if self.grouping == "merged":
            return ("task", *strategy_names(1))
        return ("task", *self.group_names)

    @property
    def policy_names(self) -> tuple[str, ...]:
        """The targets asked for, in the order of all."""
        asked = self.policy_targets or self.target_names
        return tuple(name for name in self.target_names if name in asked)

    @property
    def selects(self) -> bool:
        """Whether there are several policies on rewards of one task to choose among."""
        return self.regression.strategy_weight > 0.0 and len(self.policy_names) > 1

    @property
    def needs_actions(self) -> str:
        """Phase 1 as it is set, rewards that see actions, and clones; others do without."""
        seen = "regression.include_action=true" if self.regression.include_action else ""
        cloned = "task_policy.start=clone" if self.clones_for_task else ""
        return self.airl.needs_actions or seen or cloned

    def check_against(self, obs_dim: int) -> None:
        decomposition.check_entries(self.regression, obs_dim)


def check_start(airl_config: AirlConfig, policies_config: PoliciesConfig) -> None:
    """Raises a SettingError where policies are to start from a Phase 1 policy unlike them."""
    if policies_config.start != "phase1":
        return
    _, first = airl.generator(airl_config)
    _, settings = policies.agent_of(policies_config)
    require(
        settings.hidden_sizes == first.hidden_sizes,
        f"policies.{policies_config.agent}.hidden_sizes",
        f"{first.hidden_sizes}, those of Phase 1's policy, which policies start from",
        settings.hidden_sizes,
    )
    # Statistics are gathered anew, and the same networks would see other inputs.
    for stage, normalizes in (
        (f"policies.{policies_config.agent}", settings.normalize_observations),
        (f"airl.{airl_config.agent}", first.normalize_observations),
    ):
        require(
            not normalizes,
            f"{stage}.normalize_observations",
            "false where policies.start=phase1",
            normalizes,
        )


class Problem(NamedTuple):
    """What the method is given.

    Attributes:
      env: episodes that reset themselves.
      demonstrations: of the strategies in use.
      lessons: these without their pauses, which is what methods learn from.
      test: unseen trajectories, with true rewards; only evaluation looks at them. May be none.
      num_cut: how many demonstrations went on beyond the horizon, and end there.
    """

    env: Episode
    demonstrations: Demonstrations
    lessons: Demonstrations
    test: tuple[Trajectory, ...]
    num_cut: int = 0


def make_problem(
    config: MethodConfig,
    env: Environment,
    demonstrations: Demonstrations,
    test: Demonstrations | None = None,
) -> Problem:
    """Checks demonstrations and test trajectories against the environment and cuts them to size.

    Raises:
      UsageError: actions are missing that the method needs, or the test's true rewards, or a
        setting does not fit the environment.
      RepresentError: they do not fit the environment, or too few strategies are demonstrated.
    """
    horizon = config.horizon or env.horizon
    config.check_against(env.observation_size)
    for what, data in (("demonstrations", demonstrations), ("test trajectories", test)):
        if data is None:
            continue
        # A name that nobody registered may be anyone's for this robot.
        own = (config.env, env.name)
        if data.env_name in registry.names() and data.env_name not in own:
            raise RepresentError(f"{what} are of {data.env_name}, expected {env.name}")
        data.check_against(env.observation_size, env.action_size, -1.0, 1.0)
        if config.needs_actions and not data.has_actions:
            needs = config.needs_actions
            way_out = "; without them, override that setting" if "=" in needs else ""
            raise UsageError(f"{what} hold no actions, which {needs} needs{way_out}")
    if test is not None and not test.has_rewards:
        raise UsageError("test trajectories hold no true rewards, which are all they are for")
    if config.num_strategies > demonstrations.num_strategies:
        raise RepresentError(
            f"num_strategies: expected at most {demonstrations.num_strategies}, as many as are "
            f"demonstrated, found {config.num_strategies}"
        )
    own = [t for t in demonstrations.trajectories if t.strategy < config.num_strategies]
    if config.grouping != "separate":
        names = strategy_names(config.num_strategies)
        own = [
            dataclasses.replace(t, strategy=0)
            for t in own
            if config.grouping in ("merged", names[t.strategy])
        ]
    num_cut = sum(t.length > horizon for t in own)
    own = [_truncate(t, horizon) for t in own]
    moving = [without_pauses(t, config.least_change) for t in own]
    return Problem(
        Episode(env, horizon),
        dataclasses.replace(demonstrations, trajectories=tuple(own)),
        dataclasses.replace(demonstrations, trajectories=tuple(moving)),
        tuple(_truncate(t, horizon) for t in test.trajectories) if test is not None else (),
        num_cut,
    )


def _truncate(t: Trajectory, horizon: int) -> Trajectory:
    if t.length <= horizon:
        return t
    actions, rewards = (None if x is None else x[:horizon] for x in (t.actions, t.rewards))
    return Trajectory(t.obs[: horizon + 1], actions, rewards, False, t.strategy)


def strategy_names(num_strategies: int) -> tuple[str, ...]:
    """ "strategy_1", "strategy_2", ..."""
    return tuple(f"strategy_{i + 1}" for i in range(num_strategies))
