"""Draws the paper's Figures 3 (the curves), 4 and 5 from a campaign's folder.

Figures 3 and 4 show what tables 1 and 2 are made of, Figure 5 what `--tables=figure_5` ran.

python -m experiments.figures --campaign=runs/campaign --out=results/figures
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from absl import flags

from experiments import launch
from represent_jax.campaign import figures as campaign_figures
from represent_jax.campaign.entries import Entry, entries
from represent_jax.campaign.variants import GYM_DOMAINS
from represent_jax.errors import RepresentError
from represent_jax.report import figures
from represent_jax.runs import RunDirectory
from represent_jax.runs.graph import Graph

_CAMPAIGN = flags.DEFINE_string("campaign", "runs/campaign", "Folder of the campaign.")
_DOMAINS = flags.DEFINE_list("domains", list(GYM_DOMAINS), "Environments.")
_SEEDS = flags.DEFINE_integer("seeds", 5, "Number of seeds; 3 and 4 show the first.", lower_bound=1)
_SEED = flags.DEFINE_integer("seed", 0, "First of the seeds.", lower_bound=0)
_PRESET = flags.DEFINE_string("preset", "paper", "Settings the campaign began with.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Settings the campaign was given.")
_OUT = flags.DEFINE_string("out", "results/figures", "Folder to write to.")

_METHODS = ("represent", "ssrr")
_FROM_SCRATCH = ("scratch", "ssrr_scratch")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    seeds = range(_SEED.value, _SEED.value + _SEEDS.value)
    every = entries(["2", "figure_5"], _DOMAINS.value, seeds, _PRESET.value, _OVERRIDE.value)
    graph = Graph((node for one in every for node in one.reports.values()), _CAMPAIGN.value)
    written = []
    os.makedirs(_OUT.value, exist_ok=True)
    for domain in _DOMAINS.value:
        own = [one for one in every if one.config.env == domain]
        first = [one for one in own if one.config.seed == _SEED.value]
        drawn = {}
        for method in _METHODS:
            runs = [one for one in first if one.variant == method]
            curves, points = _curves(graph, runs), _points(graph, runs)
            if curves:
                drawn[f"figure_3_{domain}_{method}"] = figures.noise_curves(curves)
            if points:
                drawn[f"figure_4_{domain}_{method}"] = figures.scatters(points)
        paths = _paths(graph, [one for one in own if one.variant in _FROM_SCRATCH])
        if paths:
            drawn[f"figure_5_{domain}"] = campaign_figures.learning(paths)
        for name, figure in drawn.items():
            path = Path(_OUT.value) / f"{name}.png"
            figures.save_png(figure, path)
            written.append(str(path))
    if not written:
        raise RepresentError(f"{_CAMPAIGN.value}: no stage that a figure shows is done there")
    print("\n".join(written))


def _done(graph: Graph, runs: list[Entry], stage: str) -> Iterator[tuple[Entry, RunDirectory]]:
    """Yields the runs whose stage is done, each with the stage's folder."""
    for run in runs:
        node = run.reports[stage]
        if graph.is_done(node):
            yield run, graph.directory(node)


def _curves(graph: Graph, runs: list[Entry]) -> dict:
    found = {}
    for run, directory in _done(graph, runs, "reward_evaluation"):
        curves = directory.load_findings("reward_evaluation")["curve"]
        found |= dict(zip(run.config.group_names, curves, strict=True))
    return found


def _points(graph: Graph, runs: list[Entry]) -> dict:
    """By target and group of trajectories, true and learned returns."""
    found: dict[str, dict] = {}
    for run, directory in _done(graph, runs, "reward_evaluation"):
        arrays = directory.load_arrays("scatter")
        for target in run.config.target_names:
            groups = {key.split("/")[1] for key in arrays if key.startswith(f"{target}/")}
            found[target] = {
                group: (arrays[f"{target}/{group}/true"], arrays[f"{target}/{group}/learned"])
                for group in groups
            }
    return found


def _paths(graph: Graph, runs: list[Entry]) -> dict:
    """By target and method, the learning curve of every seed."""
    found: dict[str, dict[str, list[tuple[np.ndarray, np.ndarray]]]] = {}
    for run, directory in _done(graph, runs, "policy_evaluation"):
        arrays = directory.load_arrays("learning_curves")
        for target in run.config.policy_names:
            path = (arrays[f"{target}/env_steps"], arrays[f"{target}/true_return"])
            found.setdefault(target, {}).setdefault(run.variant, []).append(path)
    return found


if __name__ == "__main__":
    launch.run(main)
