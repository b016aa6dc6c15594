"""Runs everything behind the paper's tables: methods, domains, seeds; each stage once.

python -m experiments.campaign --tables=1,2,3,4,5 --seeds=5 --preset=paper
python -m experiments.campaign --tables=1 --domains=hopper --seeds=1 --preset=smoke --dry_run
python -m experiments.campaign --engine=ray --address=auto --seeds=5 --preset=paper

Killed at any time, the same command goes on. Stages that several methods need are shared between
them, found again by the hash of what they depend on.
"""

import contextlib
import time
from pathlib import Path

from absl import flags

from experiments import launch
from represent_jax.campaign.entries import Entry, entries, record
from represent_jax.campaign.variants import DOMAINS, TABLES
from represent_jax.config import config_hash
from represent_jax.errors import RepresentError, UsageError, unknown
from represent_jax.report.values import format_duration
from represent_jax.runs import provenance
from represent_jax.runs.graph import BLOCKED, FAILED, Engine, Graph, InTurn, Node
from represent_jax.runs.tracking import WandbTracker

_ENGINES = ("local", "ray")

_TABLES = flags.DEFINE_list("tables", ["1", "2", "3", "5"], f"Of {', '.join(TABLES)}.")
_DOMAINS = flags.DEFINE_list("domains", list(DOMAINS), "Environments.")
_VARIANTS = flags.DEFINE_list("variants", [], "Of a table's methods and ablations; all if empty.")
_SEEDS = flags.DEFINE_integer(
    "seeds", None, "Number of seeds; 5, and 1 with preset smoke, if not given.", lower_bound=1
)
_SEED = flags.DEFINE_integer("seed", 0, "First of the seeds.", lower_bound=0)
_PRESET = flags.DEFINE_string("preset", "paper", "Settings to begin with: smoke, quick or paper.")
_OUT = flags.DEFINE_string("out", "runs/campaign", "Folder of the campaign.")
_RECORD = flags.DEFINE_string("record", None, "File of records; <out>/records.jsonl if not given.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting of every run that has it.")
_WANDB = flags.DEFINE_string(
    "wandb", None, "Project of Weights & Biases to log to (extra `wandb`)."
)
_DRY_RUN = flags.DEFINE_bool("dry_run", False, "Show what is done and left, and run nothing.")
_ENGINE = flags.DEFINE_string("engine", "local", "Where stages run: local, in turn, or ray.")
_ADDRESS = flags.DEFINE_string("address", "local", "Of Ray: local starts one here, auto, or host.")
_SHARED = flags.DEFINE_bool("shared_folder", True, "Whether Ray's workers see --out.")
_RETRIES = flags.DEFINE_integer("retries", 3, "Of a stage that lost its Ray worker.")
_CPUS = flags.DEFINE_float("stage_cpus", 1.0, "What Ray sets aside for a stage.")
_GPUS = flags.DEFINE_float("stage_gpus", 0.0, "What Ray sets aside for a stage.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    launch.compile_quickly(_PRESET.value)
    if _ENGINE.value not in _ENGINES:
        raise unknown("engine", _ENGINE.value, _ENGINES)
    if _WANDB.value and _ENGINE.value != "local":
        raise UsageError("--wandb: expected --engine=local, Ray's workers log to their files alone")
    if _ENGINE.value == "local":
        launch.refuse_beside(
            "with --engine=local",
            ("address", "shared_folder", "retries", "stage_cpus", "stage_gpus"),
        )
    overrides = launch.overrides(_OVERRIDE.value)
    num_seeds = _SEEDS.value or (1 if _PRESET.value == "smoke" else 5)
    seeds = range(_SEED.value, _SEED.value + num_seeds)
    every = entries(_TABLES.value, _DOMAINS.value, seeds, _PRESET.value, overrides, _VARIANTS.value)
    wanted = (node for entry in every for node in entry.reports.values())
    graph = Graph(wanted, _OUT.value, _track if _WANDB.value else None)
    records = _RECORD.value or f"{_OUT.value}/records.jsonl"
    print(f"{len(every)} runs, {len(graph.nodes)} stages, {len(graph.left)} of them left")
    if _DRY_RUN.value:
        for entry in every:
            config = entry.config
            run = f"{config.env} {entry.recipe.variant} seed {config.seed}"
            print(f"settings {config_hash(config)} {run}")
        for node in graph.nodes:
            print(f"{'done' if graph.is_done(node) else 'left':5} {node.hash} {node.name}")
        _print_time(graph)
        return
    launch.require_writable(records)
    provenance()  # Of the code that is loaded now: a checkout may change while stages run.
    record(graph, every, records)
    started: dict[str, float] = {}
    # Nodes that several runs share have names of their own, and one hash.
    needing: dict[str, list[Entry]] = {}
    for entry in every:
        for node in entry.reports.values():
            needing.setdefault(node.hash, []).append(entry)

    def report(graph: Graph, node: Node, state: str) -> None:
        number = f"[{len(graph.nodes) - len(graph.left)}/{len(graph.nodes)}]"
        if state == "running":
            started[node.hash] = time.monotonic()
            print(f"{number} {node.name}: running", flush=True)
            return
        said = graph.errors.get(node.hash, "")
        if node.hash in started:
            said += f" after {format_duration(time.monotonic() - started[node.hash])}"
        left = graph.seconds_left()
        what = "left" if _ENGINE.value == "local" else "of work left"
        said += "" if left is None else f"; {format_duration(left)} {what}"
        print(f"{number} {node.name}: {state} {said}", flush=True)
        record(graph, needing.get(node.hash, ()), records)

    with _engine(every) as engine:
        graph.run(report, engine)
    bad = [node for node in graph.nodes if graph.states[node.hash] in (FAILED, BLOCKED)]
    print(f"{len(graph.nodes) - len(bad)} of {len(graph.nodes)} stages done; records: {records}")
    _print_time(graph)
    if bad:
        failed = [
            f"{node.name} ({graph.errors[node.hash]})" for node in bad if node.hash in graph.errors
        ]
        raise RepresentError(f"{len(bad)} stages are not done; failed: {'; '.join(failed)}")


def _print_time(graph: Graph) -> None:
    """Prints where the time went: what stages of each kind took, the longest first."""
    taken = graph.seconds_by_kind()
    total = sum(map(sum, taken.values()))
    print(f"stages done took {format_duration(total)} in all:")
    for kind, seconds in sorted(taken.items(), key=lambda item: -sum(item[1])):
        each = format_duration(sum(seconds) / len(seconds))
        print(f"  {kind:<42} {len(seconds):>4} x {each:>12} = {format_duration(sum(seconds))}")


def _engine(every: list[Entry]) -> contextlib.AbstractContextManager[Engine]:
    if _ENGINE.value == "local":
        return contextlib.nullcontext(InTurn())
    from represent_jax.campaign.ray_engine import RayConfig, RayEngine

    config = RayConfig(_ADDRESS.value, _SHARED.value, _RETRIES.value, _CPUS.value, _GPUS.value)
    return RayEngine(every, config)


def _track(node: Node, folder: Path) -> WandbTracker:
    return WandbTracker(_WANDB.value, folder, node.name, node.settings, group=_OUT.value)


if __name__ == "__main__":
    launch.run(main)
