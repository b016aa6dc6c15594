"""A method as a plan: its stages in order, what each is given and what its output depends on.

A run executes a plan in one folder; a campaign executes many plans as one graph, in which methods
share the stages that are the same for both. The key of a stage depends on the seed and the stage's
name alone, so both ways give the same results.
"""

import dataclasses
import functools
import hashlib
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from represent_jax import config as configs
from represent_jax.data.trajectories import Trajectory
from represent_jax.errors import unknown
from represent_jax.methods.clock import Clock
from represent_jax.methods.config import MethodConfig, Problem
from represent_jax.methods.results import describe
from represent_jax.runs import RunDirectory, provenance
from represent_jax.runs.graph import Node


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage of a method.

    Attributes:
      name: where a run keeps it, and what its key is drawn for.
      run: `run(key, directory, *inputs)` makes the output, or loads it where the directory has it.
      inputs: names of the stages whose outputs it is given, in order.
      settings: what the output depends on beside the problem, the seed and the inputs.
      reports: whether the output is a part of the run's results.
      sees_pauses: whether it looks at whole demonstrations, `Problem.demonstrations`.
      before_rewards: whether rewards are learned from it, so that its seed is Phase 1's.
      revision: raised when the stage makes something else of the same settings, so that a campaign
        does not take what was made before for it.
    """

    name: str
    run: Callable[..., Any]
    inputs: tuple[str, ...] = ()
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    reports: bool = False
    sees_pauses: bool = False
    before_rewards: bool = False
    revision: int = 1


def stage_key(seed: int, name: str) -> jax.Array:
    """The key of a stage."""
    return jax.random.fold_in(jax.random.PRNGKey(seed), zlib.crc32(name.encode()))


def seed_of(config: MethodConfig, stage: Stage) -> int:
    """The seed of a stage: the run's own, unless the settings give Phase 1 another."""
    own = config.phase_1_seed if stage.before_rewards else None
    return config.seed if own is None else own


def run_stage(seed: int, stage: Stage, directory: RunDirectory, *inputs: Any) -> Any:
    """Runs a stage, or returns what it reported where the directory holds that already.

    What is reported carries the commit, the device and the versions that it was found with: a
    campaign may be continued, and recorded, by another.
    """
    key = stage_key(seed, stage.name)
    if not stage.reports:
        return stage.run(key, directory, *inputs)
    if not directory.has_findings(stage.name):
        found = stage.run(key, directory, *inputs)
        directory.save_findings(stage.name, {**found, **provenance()})
    return directory.load_findings(stage.name)


def stage_names(stages: Sequence[Stage], until: str = "") -> list[str]:
    """Names of a plan's stages as far as the one named `until`, of all if empty.

    Raises:
      UsageError: no stage of that name.
    """
    names = [stage.name for stage in stages]
    if until and until not in names:
        raise unknown("stage", until, names)
    return names[: names.index(until) + 1] if until else names


def execute(
    config: MethodConfig,
    problem: Problem,
    stages: Sequence[Stage],
    directory: RunDirectory,
    until: str = "",
) -> dict[str, Any] | None:
    """Runs every stage that is not done yet and returns the results.

    Args:
      config: settings of the method.
      problem: environment, demonstrations, test trajectories.
      stages: the method's plan.
      directory: where stages are saved as they end, and restored from.
      until: the last stage to run, the plan's last if empty; called again, the run goes on.

    Returns:
      The results, None where the run stopped before its last stage.

    Raises:
      UsageError: no stage of that name.
      RepresentError: a loss diverged, or Phase 1's reward is not finite.
    """
    stage_names(stages, until)
    provenance()  # Of the code that is loaded now: a checkout may change while the run lasts.
    clock, outputs = Clock(directory), {}
    for stage in stages:
        with clock(stage.name):
            inputs = (outputs[before] for before in stage.inputs)
            outputs[stage.name] = run_stage(seed_of(config, stage), stage, directory, *inputs)
        if stage.name == until != stages[-1].name:
            return None
    results = describe(config, problem)
    for stage in stages:
        if stage.reports:
            results |= outputs[stage.name]
    return clock.finish(results)


def nodes(
    config: MethodConfig, problem: Problem, stages: Sequence[Stage], name: str
) -> dict[str, Node]:
    """The stages of a plan as nodes of a graph, by the name of the stage.

    Args:
      config: settings of the method.
      problem: environment, demonstrations, test trajectories.
      stages: the method's plan.
      name: of the run, as people see it.
    """
    common = {
        "env": config.env,
        "backend": problem.env.backend,
        "horizon": problem.env.horizon,
        "demonstrations": _digest(problem.lessons.trajectories),
    }
    # Judges look at what methods do not, pauses and test trajectories.
    whole = common | {"whole_demonstrations": _digest(problem.demonstrations.trajectories)}
    judged = whole | {"test": _digest(problem.test)}
    made: dict[str, Node] = {}
    for stage in stages:
        seed = seed_of(config, stage)
        made[stage.name] = Node(
            kind=f"{config.env} {stage.name}",
            name=f"{name} {stage.name}",
            settings={
                "seed": seed,
                **(judged if stage.reports else whole if stage.sees_pauses else common),
                **configs.identity(stage.settings),
                **({"revision": stage.revision} if stage.revision > 1 else {}),
            },
            inputs=tuple(made[before] for before in stage.inputs),
            run=functools.partial(run_stage, seed, stage),
        )
    return made


def _digest(trajectories: Sequence[Trajectory]) -> str:
    """Hash of everything in the trajectories."""
    digest = hashlib.sha256()
    for t in trajectories:
        for array in (t.obs, t.actions, t.rewards):
            missing = array is None
            digest.update(b"missing" if missing else np.ascontiguousarray(array).tobytes())
        digest.update(f"{t.length} {t.terminated} {t.strategy}".encode())
    return digest.hexdigest()[:16]
