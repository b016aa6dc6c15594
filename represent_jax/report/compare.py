"""A page that sets several runs side by side: what they found, and how their settings differ."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from represent_jax.data.atomic import replacing
from represent_jax.errors import UsageError
from represent_jax.report import contents, figures, tables
from represent_jax.report.contents import Contents
from represent_jax.report.page import document, flat, gallery, table, text
from represent_jax.report.values import display_name, format_duration, format_number

# One a run, then again from the first with another dash.
_COLOURS = ("#2f6fdb", "#d0661b", "#0f8b8d", "#8e44c9", "#c2488f", "#6b7785")
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)))

_REWARDS = {
    "pearson_test": (
        "Learned against true return, unseen trajectories",
        "Pearson's r over test trajectories that no reward was trained on.",
    ),
    "pearson_pooled": (
        "Learned against true return, pooled",
        "Pearson's r over demonstrations, noisy rollouts and test trajectories, as the paper "
        "reports it.",
    ),
}
_POLICIES = {
    "return_final": (
        "True return of the policy kept",
        "Mean of the final episodes of the policy that the method hands on, chosen without the "
        "true reward.",
    ),
    "return_best": (
        "Highest true return",
        "The best evaluation along the way, as the paper reports it.",
    ),
    "style_kept": (
        "Style kept",
        "Share of states in which a strategy's policy is still recognised as that strategy.",
    ),
}


def write_comparison(run_paths: Sequence[str | os.PathLike], path: str | os.PathLike) -> Path:
    """Writes the page for some runs, finished or under way, and returns its path.

    Raises:
        UsageError: fewer than two runs are given, or one twice.
        RepresentError: a folder holds no run, or the page cannot be written.
    """
    names = [os.path.normpath(run) for run in run_paths]
    if len(names) < 2:
        raise UsageError(f"expected at least two run folders, found {len(names)}")
    if len(set(names)) < len(names):
        raise UsageError(f"a run is given twice: {', '.join(names)}")
    runs = dict(zip(_shortened(names), (contents.load(run) for run in run_paths), strict=True))
    path = Path(path)
    with replacing(path) as temporary:
        temporary.write_text(_page(runs), encoding="utf-8")
    return path


def settings_that_differ(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Returns, by dotted name, the values of the settings in which configurations differ.

    Args:
        configs: the configurations, by run; a setting that one does not have counts as None.
    """
    every = [flat(config) for config in configs.values()]
    found = {}
    for name in dict.fromkeys(name for one in every for name in one):
        values = [one.get(name) for one in every]
        if any(value != values[0] for value in values):
            found[name] = values
    return found


def _page(runs: Mapping[str, Contents]) -> str:
    body = [
        _header(runs),
        _settings(runs),
        *(_quantity(runs, "rewards", key, *told) for key, told in _REWARDS.items()),
        *(_quantity(runs, "policies", key, *told) for key, told in _POLICIES.items()),
        gallery(
            "Policies",
            {target: _learning(runs, target) for target in _having(runs, lambda r: r.learning)},
            "Above, the true return of the policies while they learn, against environment steps; "
            "below, the learned return that each maximises, in its own units.",
            "Learning curves",
        ),
        gallery(
            "Noise and performance",
            {name: _noise(runs, name) for name in _having(runs, lambda r: r.curves)},
            "Circles are what rollouts at each noise level earn under the imitation's reward, "
            "scaled from 0 to 1; lines are the curves fitted to them.",
            "Noise-performance curves",
        ),
        _times(runs),
    ]
    return document(f"REPRESENT: {len(runs)} runs", body)


def _header(runs: Mapping[str, Contents]) -> str:
    shown = []
    for i, (name, run) in enumerate(runs.items()):
        about = [run.config.get(key) for key in ("env", "method", "preset")]
        about.append(f"seed {run.config.get('seed')}")
        swatch = f'<i style="background:{_COLOURS[i % len(_COLOURS)]}"></i>'
        facts = ", ".join(str(one) for one in about if one is not None)
        shown.append(f"<li>{swatch}<b>{text(name)}</b> <span>{text(facts)}</span></li>")
    return f"<header><h1>{len(runs)} runs</h1><ul class=facts>{''.join(shown)}</ul></header>"


def _settings(runs: Mapping[str, Contents]) -> str:
    different = settings_that_differ({name: run.config for name, run in runs.items()})
    rows = tuple(
        (name, *("-" if value is None else str(value) for value in values))
        for name, values in different.items()
    )
    if not rows:
        return "<p class=notice>All runs have the same settings.</p>"
    note = "All other settings are the same."
    return table(tables.Table("Settings that differ", ("setting", *runs), rows, note))


def _quantity(runs: Mapping[str, Contents], part: str, key: str, title: str, note: str) -> str:
    """Returns one quantity of every target, a row, and every run, a column."""
    found = [run.results.get(part) or {} for run in runs.values()]
    rows = []
    for target in dict.fromkeys(target for one in found for target in one):
        values = [(one.get(target) or {}).get(key) for one in found]
        if any(value is not None for value in values):
            digits = None if key.startswith("return") else 3
            rows.append((display_name(target), *(format_number(v, digits) for v in values)))
    if not rows:
        return ""
    return table(tables.Table(title, ("target", *runs), tuple(rows), note))


def _times(runs: Mapping[str, Contents]) -> str:
    taken = [run.results.get("seconds") or {} for run in runs.values()]
    rows = [
        (stage, *("-" if (s := one.get(stage)) is None else format_duration(s) for one in taken))
        for stage in dict.fromkeys(stage for one in taken for stage in one)
    ]
    if not rows:
        return ""
    return table(tables.Table("Time", ("stage", *runs), tuple(rows), ""))


def _learning(runs: Mapping[str, Contents], target: str) -> Figure:
    size = (figures.PANEL_INCHES[0], figures.PANEL_INCHES[1] + 0.6)
    with figures.panels(1, size, rows=(3.0, 2.0)) as (figure, (ax_true, ax_learned)):
        for style, run in zip(_styles(), runs.values(), strict=False):
            curve = run.learning.get(target)
            if curve is not None:
                ax_true.plot(curve["env_steps"], curve["true_return"], **style)
                ax_learned.plot(curve["env_steps"], curve["learned_return"], **style)
        ax_true.set_title(display_name(target))
        ax_true.set_ylabel("true return")
        ax_true.tick_params(labelbottom=False)
        ax_learned.set_ylabel("learned return")
        ax_learned.set_xlabel("environment steps")
        ax_learned.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax_learned.xaxis.set_major_locator(MaxNLocator(6))
    return figure


def _noise(runs: Mapping[str, Contents], name: str) -> Figure:
    with figures.panels(1) as (figure, (ax,)):
        for style, run in zip(_styles(), runs.values(), strict=False):
            curve = run.curves.get(name) or {}
            levels, returns, fitted = (
                np.array([np.nan if v is None else v for v in curve.get(key) or ()], float)
                for key in ("levels", "returns", "fitted")
            )
            ax.plot(levels, returns, "o", ms=4.5, mfc="white", mec=style["color"])
            ax.plot(levels, fitted, **style)
        ax.set_title(display_name(name))
        ax.set_xlabel("noise level $\\eta$")
        ax.set_ylabel("return under the initial reward, scaled")
        ax.set_ylim(-0.12, 1.12)
    return figure


def _styles() -> Iterable[dict[str, Any]]:
    return (dict(color=colour, ls=dashes) for dashes in _DASHES for colour in _COLOURS)


def _having(
    runs: Mapping[str, Contents], part: Callable[[Contents], Mapping[str, Any]]
) -> list[str]:
    """Returns the names that a part of any run has, in order."""
    return list(dict.fromkeys(name for run in runs.values() for name in part(run)))


def _shortened(names: Sequence[str]) -> list[str]:
    """Returns the paths without the folders that all of them begin with."""
    parts = [Path(name).parts for name in names]
    shared = 0
    while len({part[: shared + 1] for part in parts}) == 1:
        shared += 1
    shared = min(shared, *(len(part) - 1 for part in parts))
    return [str(Path(*part[shared:])) for part in parts]
