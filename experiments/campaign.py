"""Runs everything behind the paper's tables: methods, domains, seeds; each stage once.

python -m experiments.campaign --tables=1,2,3,4,5 --seeds=5 --preset=paper
python -m experiments.campaign --tables=1 --domains=hopper --seeds=1 --preset=smoke --dry_run

Killed at any time, the same command goes on. Stages that several methods need are shared between
them, found again by the hash of what they depend on.
"""

import time

from absl import flags

from experiments import launch
from represent_jax.campaign.entries import entries, record
from represent_jax.campaign.variants import DOMAINS, TABLES
from represent_jax.errors import RepresentError
from represent_jax.report.values import format_duration
from represent_jax.runs.graph import BLOCKED, FAILED, Graph, Node

_TABLES = flags.DEFINE_list("tables", ["1", "2", "3", "5"], f"Of {', '.join(TABLES)}.")
_DOMAINS = flags.DEFINE_list("domains", list(DOMAINS), "Environments.")
_VARIANTS = flags.DEFINE_list("variants", [], "Of a table's methods and ablations; all if empty.")
_SEEDS = flags.DEFINE_integer("seeds", 5, "Number of seeds.", lower_bound=1)
_SEED = flags.DEFINE_integer("seed", 0, "First of the seeds.", lower_bound=0)
_PRESET = flags.DEFINE_string("preset", "paper", "Settings to begin with: smoke, quick or paper.")
_OUT = flags.DEFINE_string("out", "runs/campaign", "Folder of the campaign.")
_RECORD = flags.DEFINE_string("record", None, "File of records; <out>/records.jsonl if not given.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting of every run that has it.")
_DRY_RUN = flags.DEFINE_bool("dry_run", False, "Show what is done and left, and run nothing.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    seeds = range(_SEED.value, _SEED.value + _SEEDS.value)
    every = entries(
        _TABLES.value, _DOMAINS.value, seeds, _PRESET.value, _OVERRIDE.value, _VARIANTS.value
    )
    graph = Graph((node for entry in every for node in entry.reports.values()), _OUT.value)
    records = _RECORD.value or f"{_OUT.value}/records.jsonl"
    print(f"{len(every)} runs, {len(graph.nodes)} stages, {len(graph.left)} of them left")
    if _DRY_RUN.value:
        for node in graph.nodes:
            print(f"{'done' if graph.is_done(node) else 'left':5} {node.hash} {node.name}")
        return
    record(graph, every, records)
    started: dict[str, float] = {}

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
        said += "" if left is None else f"; {format_duration(left)} left"
        print(f"{number} {node.name}: {state} {said}", flush=True)
        record(graph, (entry for entry in every if node in entry.reports.values()), records)

    graph.run(report)
    bad = [node for node in graph.nodes if graph.states[node.hash] in (FAILED, BLOCKED)]
    print(f"{len(graph.nodes) - len(bad)} of {len(graph.nodes)} stages done; records: {records}")
    if bad:
        failed = [
            f"{node.name} ({graph.errors[node.hash]})" for node in bad if node.hash in graph.errors
        ]
        raise RepresentError(f"{len(bad)} stages are not done; failed: {'; '.join(failed)}")


if __name__ == "__main__":
    launch.run(main)
