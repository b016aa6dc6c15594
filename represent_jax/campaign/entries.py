"""A campaign's runs as nodes of one graph, and what they found as records."""

import dataclasses
import functools
import os
from collections.abc import Iterable, Sequence

from represent_jax import config as configs
from represent_jax.campaign.variants import VARIANTS, runs_of
from represent_jax.data.catalogue import load_demonstrations, load_test
from represent_jax.envs import make_env
from represent_jax.errors import unknown
from represent_jax.methods.config import MethodConfig, Problem, make_problem
from represent_jax.methods.plan import nodes
from represent_jax.methods.registry import find_method
from represent_jax.methods.results import describe
from represent_jax.runs.graph import Graph, Node
from represent_jax.runs.records import append_results


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What a run is made from, in words that another process can read.

    Attributes:
      variant: one of `campaign.variants`.
      domain: the environment's name.
      preset: name of the preset.
      overrides: settings as `dotted.key=value`.
      reached: the stages that have to be reached.
    """

    variant: str
    domain: str
    preset: str
    overrides: tuple[str, ...]
    reached: tuple[str, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Entry:
    """One run of the campaign.

    Attributes:
      recipe: what it is made from.
      variant: what records call it.
      config: its settings.
      problem: what it is given.
      reports: the nodes whose outputs are recorded, by stage.
    """

    recipe: Recipe
    variant: str
    config: MethodConfig
    problem: Problem
    reports: dict[str, Node]


def entries(
    tables: Sequence[str],
    domains: Sequence[str],
    seeds: Sequence[int],
    preset: str,
    overrides: Sequence[str] = (),
    variants: Sequence[str] = (),
) -> list[Entry]:
    """The runs behind some tables, seed by seed, so that every seed adds to all of them.

    Raises:
      UsageError: no table, domain, variant or preset of that name, or a setting that does not fit.
      RepresentError: demonstrations do not fit their environment.
    """
    wanted = runs_of(tables, domains, variants)
    found = []
    for seed in seeds:
        for domain, runs in wanted.items():
            for variant, reached in runs.items():
                settings = (*overrides, f"seed={seed}")
                found.append(make_entry(Recipe(variant, domain, preset, settings, reached)))
    return found


def make_entry(recipe: Recipe) -> Entry:
    """Makes a run: its settings, what it is given, its stages as nodes.

    Raises:
      UsageError: no variant, domain or preset of that name, or a setting that does not fit.
      RepresentError: demonstrations do not fit their environment.
    """
    if recipe.variant not in VARIANTS:
        raise unknown("variant", recipe.variant, VARIANTS)
    variant = VARIANTS[recipe.variant]
    config = variant.config(recipe.preset, recipe.domain, recipe.overrides)
    env = _env(config.env, config.backend)
    problem = make_problem(
        config,
        env,
        _data(config.demonstrations or config.env),
        _test(config.env, config.test),
    )
    stages = find_method(config.method).plan(config, problem)
    made = nodes(config, problem, stages, f"{config.env} {recipe.variant} seed {config.seed}")
    last = max(i for i, stage in enumerate(stages) if stage.name in recipe.reached)
    reports = {stage.name: made[stage.name] for stage in stages[: last + 1] if stage.reports}
    return Entry(recipe, variant.name, config, problem, reports)


@functools.cache
def _env(name: str, backend: str):
    return make_env(name, backend)


@functools.cache
def _data(name: str):
    return load_demonstrations(name)


@functools.cache
def _test(env_name: str, name: str):
    return load_test(env_name, name)


def record(graph: Graph, every: Iterable[Entry], path: str | os.PathLike) -> None:
    """Appends to a file what is done and not recorded there yet.

    Called whenever a node ends it loses nothing, and called again it adds nothing.
    """
    for entry in every:
        for stage, node in entry.reports.items():
            if graph.is_done(node):
                results = describe(entry.config, entry.problem)
                results |= graph.directory(node).load_findings(stage)
                results["seconds"] = {node.name: graph.seconds_in_all(node)}
                config_hash = configs.config_hash(entry.config)
                append_results(path, entry.variant, config_hash, results, only_new=True)
