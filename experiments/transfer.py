"""Runs policies in Gymnasium's own environments, beside ours: the proof that the physics is theirs.

python -m experiments.transfer --run=runs/demo --episodes=50
python -m experiments.transfer --campaign=runs/campaign --seeds=5 --record=results/records.jsonl
"""

import time
from collections.abc import Iterator
from typing import NamedTuple

from absl import flags

from experiments import launch
from represent_jax import config as configs
from represent_jax.api import load_config
from represent_jax.campaign import formats
from represent_jax.campaign.entries import entries
from represent_jax.campaign.variants import DOMAINS
from represent_jax.envs import Episode, make_env
from represent_jax.errors import RepresentError, UsageError
from represent_jax.methods import transfer
from represent_jax.methods.config import MethodConfig
from represent_jax.methods.registry import find_method
from represent_jax.report import tables
from represent_jax.report.values import display_name, format_number
from represent_jax.runs import RunDirectory
from represent_jax.runs.graph import Graph
from represent_jax.runs.records import append_results

_RUN = flags.DEFINE_string("run", None, "Run folder.")
_CAMPAIGN = flags.DEFINE_string("campaign", None, "Folder of a campaign, instead of a run.")
_DOMAINS = flags.DEFINE_list("domains", list(DOMAINS), "Of a campaign: environments.")
_SEEDS = flags.DEFINE_integer("seeds", 5, "Of a campaign: number of seeds.", lower_bound=1)
_SEED = flags.DEFINE_integer("seed", 0, "Of a campaign: first of the seeds.", lower_bound=0)
_PRESET = flags.DEFINE_string("preset", "paper", "Of a campaign: settings it began with.")
_VARIANTS = flags.DEFINE_list("variants", ["represent"], "Of a campaign: whose policies.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Of a campaign: settings it was given.")
_EPISODES = flags.DEFINE_integer("episodes", 50, "Episodes of each policy.", lower_bound=2)
_EPISODE_SEED = flags.DEFINE_integer("episode_seed", 0, "Seed of the episodes.")
_FORMAT = flags.DEFINE_enum("format", "text", ["text", "markdown", "latex"], "Of the table.")
_RECORD = flags.DEFINE_string("record", None, "File to append the results to, one JSON a line.")


class _Trained(NamedTuple):
    """Policies of one run: what records call it, its settings, and where its policies are."""

    method: str
    config: MethodConfig
    directory: RunDirectory


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    if bool(_RUN.value) == bool(_CAMPAIGN.value):
        raise UsageError("give either --run or --campaign")
    found = list(_of_run(_RUN.value) if _RUN.value else _of_campaign(_CAMPAIGN.value))
    if not found:
        raise RepresentError(f"{_CAMPAIGN.value}: no policies of these runs are done there")
    rows = []
    for trained in found:
        config, start = trained.config, time.monotonic()
        env = make_env(config.env, config.backend)
        load = find_method(config.method).load_policies
        compared = transfer.transfer(
            config.env,
            Episode(env, config.horizon or env.horizon),
            load(config, env, trained.directory),
            _EPISODES.value,
            _EPISODE_SEED.value,
        )
        rows += [_row(trained, target, one) for target, one in compared.items()]
        if _RECORD.value:
            _record(trained, env.backend, compared, time.monotonic() - start)
    table = tables.Table(
        title=f"Policies in Gymnasium's own environments, {_EPISODES.value} episodes each",
        columns=("policy", "method", "seed", "ours", "Gymnasium", "difference"),
        rows=tuple(rows),
        note="Mean true return and its standard error. Difference: Gymnasium's minus ours, in "
        "units of its standard error; equal physics leave it within 2 in 19 rows of 20.",
    )
    print(tables.to_text(table) if _FORMAT.value == "text" else _RENDER[_FORMAT.value](table))


_RENDER = {"markdown": formats.markdown, "latex": formats.latex}


def _of_run(path: str) -> Iterator[_Trained]:
    config = load_config(path)
    yield _Trained(config.method, config, RunDirectory(path))


def _of_campaign(folder: str) -> Iterator[_Trained]:
    seeds = range(_SEED.value, _SEED.value + _SEEDS.value)
    settings = (_PRESET.value, _OVERRIDE.value, _VARIANTS.value)
    every = entries(["2"], _DOMAINS.value, seeds, *settings)
    graph = Graph((node for one in every for node in one.reports.values()), folder)
    for one in every:
        # What judges policies is given them last, whatever the method.
        node = one.reports["policy_evaluation"].inputs[-1]
        if graph.is_done(node):
            yield _Trained(one.variant, one.config, graph.directory(node))


def _row(trained: _Trained, target: str, found: transfer.Comparison) -> tuple[str, ...]:
    return (
        f"{trained.config.env}, {display_name(target).lower()}",
        trained.method,
        str(trained.config.seed),
        f"{format_number(found.ours)} +- {format_number(found.ours_error)}",
        f"{format_number(found.gymnasium)} +- {format_number(found.gymnasium_error)}",
        format_number(found.difference, 2),
    )


def _record(
    trained: _Trained, backend: str, compared: dict[str, transfer.Comparison], seconds: float
) -> None:
    config = trained.config
    results = {
        "env": config.env,
        "seed": config.seed,
        "preset": config.protocol,
        "backend": backend,
        "seconds": {"transfer": round(seconds, 1)},
        "demonstrators": (),
        "policies": {
            target: {f"transfer_{name}": value for name, value in one._asdict().items()}
            for target, one in compared.items()
        },
    }
    append_results(_RECORD.value, trained.method, configs.config_hash(config), results)


if __name__ == "__main__":
    launch.run(main)
