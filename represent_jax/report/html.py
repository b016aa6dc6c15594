"""The page of a run: one file that needs no network, made from whatever stages are done."""

import html
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from represent_jax.data.atomic import replacing
from represent_jax.errors import RepresentError
from represent_jax.report import diagnostics, figures, tables
from represent_jax.report.page import STYLE
from represent_jax.report.values import display_name, format_number
from represent_jax.runs.directory import RunDirectory, load_config_json
from represent_jax.runs.records import provenance

_STAGES = {
    "airl": "imitation",
    "curve": "noise curves",
    "rewards": "rewards",
    "policies": "policies",
}

_CURVES_NOTE = (
    "Each circle is the mean return of rollouts whose actions were replaced by random ones with "
    "probability \N{GREEK SMALL LETTER ETA}, measured by the reward that imitation found and "
    "scaled to run from 0 to 1. The line is the curve fitted to them: its values are what the "
    "final rewards are trained to give. It should fall from upper left to lower right and pass "
    "close to the circles."
)
_SCATTER_NOTE = (
    "Each dot is one trajectory: to the right, how good it is by the environment's own reward, "
    "which the method never sees; upwards, how good the learned reward says it is. Dots along a "
    "rising line mean a good reward. Right of the dashed line are trajectories better than every "
    "demonstration: there the reward has to extrapolate."
)
_LEARNING_NOTE = (
    "A policy trained on the learned reward alone. Above, its true return against the "
    "demonstrators (red lines); below, the learned return that it maximises, in its own units. "
    "Both should rise together, and the upper one should end above the red lines."
)


def write_report(run_path: str | os.PathLike) -> Path:
    """Writes report.html and figures/*.png into a run's folder, and returns the page's path.

    Stages that have no results yet are left out, and the page says so.

    Raises:
        RepresentError: the folder holds no run, or its results cannot be read or written to.
    """
    run = RunDirectory(run_path)
    config = load_config_json(run.path)
    results = run.read_results() if (run.path / "results.json").exists() else {}
    if not isinstance(results, dict):
        raise RepresentError(f"{run.path / 'results.json'}: not the results of a run")
    curves = dict(zip(tables.groups(results), results.get("curve") or (), strict=False))
    points = _scatter_points(_arrays(run, "scatter"))
    learning = _learning_curves(_arrays(run, "learning_curves"))
    levels = tables.demonstrator_levels(results)

    drawn = {
        "curve": {t: figures.noise_curves({t: curve}) for t, curve in curves.items()},
        "scatter": {t: figures.scatters({t: groups}) for t, groups in points.items()},
        "learning": {t: figures.learning_curves({t: c}, levels) for t, c in learning.items()},
    }
    for kind, by_target in drawn.items():
        for target, figure in by_target.items():
            figures.save_png(figure, run.figures / f"{kind}_{target}.png")

    page = run.path / "report.html"
    with replacing(page) as temporary:
        temporary.write_text(_page(config, results, learning, drawn), encoding="utf-8")
    return page


def _page(
    config: Mapping[str, Any],
    results: Mapping[str, Any],
    learning: Mapping[str, Mapping[str, np.ndarray]],
    drawn: Mapping[str, Mapping[str, Figure]],
) -> str:
    env = results.get("env", config.get("env", "unknown environment"))
    body = [
        _header(env, config, results),
        _notices(results),
        _verdicts(diagnostics.verdicts(results, learning)),
        _table(tables.returns_table(results)),
        _gallery("Policies", drawn["learning"], _LEARNING_NOTE, "Learning curves"),
        _table(tables.rewards_table(results)),
        _gallery("Rewards", drawn["scatter"], _SCATTER_NOTE, "Learned against true return"),
        _gallery("Noise and performance", drawn["curve"], _CURVES_NOTE, "Noise-performance curve"),
        _times(results.get("seconds") or {}),
        _pairs("Configuration", _flat(config)),
        _pairs("Versions", _versions(results)),
    ]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>REPRESENT: {_text(env)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in body if part)
        + "\n</main>\n</body>\n</html>\n"
    )


def _header(env: Any, config: Mapping[str, Any], results: Mapping[str, Any]) -> str:
    facts = [(key, results.get(key, config.get(key))) for key in ("preset", "seed", "backend")]
    facts.append(("strategies", results.get("strategies")))
    seconds = sum(value for value in (results.get("seconds") or {}).values() if value)
    facts.append(("time", _duration(seconds) if seconds else None))
    memory = results.get("peak_memory_gib")
    facts.append(("peak memory", None if memory is None else f"{format_number(memory, 1)} GiB"))
    shown = "".join(
        f"<li><span>{_text(key)}</span> {_text(value)}</li>"
        for key, value in facts
        if value is not None
    )
    return (
        "<header><p>REPRESENT: reward decomposition from suboptimal, heterogeneous "
        f"demonstrations</p><h1>{_text(display_name(str(env)))}</h1>"
        f"<ul class=facts>{shown}</ul></header>"
    )


def _notices(results: Mapping[str, Any]) -> str:
    notices = []
    missing = [name for stage, name in _STAGES.items() if not results.get(stage)]
    if missing:
        notices.append(
            f"This run is not finished: no results yet for {', '.join(missing)}. "
            "The page shows what there is."
        )
    if results.get("strategies") == 1 and len(tables.targets(results)) > 1:
        notices.append(
            "The demonstrations hold one strategy alone: there is nothing to decompose, and task "
            "and strategy reward may share what was learned in any way."
        )
    notices += tables.missing(results)
    return "".join(f"<p class=notice>{_text(notice)}</p>" for notice in notices)


def _verdicts(verdicts: Iterable[diagnostics.Verdict]) -> str:
    cards = []
    for verdict in verdicts:
        details = "".join(f"<li>{_text(line)}</li>" for line in verdict.details)
        cards.append(
            f'<article class="card {verdict.level}"><h3>{_text(verdict.question)}'
            f"<b>{_text(verdict.level)}</b></h3><p>{_text(verdict.sentence)}</p>"
            f"<ul>{details}</ul></article>"
        )
    if not cards:
        return ""
    return f"<section><h2>Verdicts</h2><div class=cards>{''.join(cards)}</div></section>"


def _table(table: tables.Table | None) -> str:
    if table is None:
        return ""
    head = "".join(f"<th scope=col>{_text(cell)}</th>" for cell in table.columns)
    rows = "".join(
        f"<tr><th scope=row>{_text(row[0])}</th>"
        + "".join(f"<td>{_typeset(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in table.rows
    )
    return (
        f"<section><h2>{_text(table.title)}</h2><div class=scroll><table><thead><tr>{head}</tr>"
        f"</thead><tbody>{rows}</tbody></table></div>"
        f"<p class=note>{_text(table.note)}</p></section>"
    )


def _gallery(title: str, drawn: Mapping[str, Figure], note: str, what: str) -> str:
    if not drawn:
        return ""
    images = "".join(
        f'<img src="{figures.svg_data_uri(figure)}" '
        f'alt="{_text(what)}: {_text(display_name(target))}">'
        for target, figure in drawn.items()
    )
    return (
        f"<section><h2>{_text(title)}</h2><div class=gallery>{images}</div>"
        f"<p class=note><b>How to read this.</b> {_text(note)}</p></section>"
    )


def _times(seconds: Mapping[str, float | None]) -> str:
    known = {stage: value for stage, value in seconds.items() if value is not None}
    if not known:
        return ""
    longest = max(*known.values(), 1e-9)
    rows = "".join(
        f"<tr><th scope=row>{_text(stage)}</th><td>{_duration(value)}</td>"
        f'<td class=bar><i style="width:{100 * value / longest:.1f}%"></i></td></tr>'
        for stage, value in known.items()
    )
    return f"<section><h2>Time</h2><table class=times><tbody>{rows}</tbody></table></section>"


def _pairs(title: str, pairs: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th scope=row>{_text(key)}</th><td>{_text(value)}</td></tr>"
        for key, value in pairs.items()
    )
    return (
        f"<details><summary>{_text(title)}</summary>"
        f"<div class=scroll><table class=pairs><tbody>{rows}</tbody></table></div></details>"
    )


def _versions(results: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what the run noted of its code and machine, or else what this process runs on."""
    found = {**provenance(), **{k: results[k] for k in provenance() if results.get(k)}}
    return _flat(found)


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested dictionaries as one, with dotted keys."""
    pairs = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            pairs |= _flat(value, f"{prefix}{key}.")
        else:
            pairs[prefix + key] = value
    return pairs


def _arrays(run: RunDirectory, name: str) -> dict[str, np.ndarray]:
    if not (run.path / "arrays" / f"{name}.npz").exists():
        return {}
    return run.load_arrays(name)


def _scatter_points(
    arrays: Mapping[str, np.ndarray],
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    points: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for key, true in arrays.items():
        target, group, which = _split(key, 3)
        learned = arrays.get(f"{target}/{group}/learned")
        if which == "true" and learned is not None and len(true):
            points.setdefault(target, {})[group] = (true, learned)
    return _in_order(points)


def _learning_curves(arrays: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    curves: dict[str, dict[str, np.ndarray]] = {}
    for key, values in arrays.items():
        target, name = _split(key, 2)
        curves.setdefault(target, {})[name] = values
    needed = {"env_steps", "true_return", "learned_return"}
    return _in_order({t: c for t, c in curves.items() if needed <= c.keys()})


def _split(key: str, num: int) -> tuple[str, ...]:
    parts = key.split("/")
    if len(parts) != num:
        raise RepresentError(f"array {key!r}: expected a name of {num} parts, found {len(parts)}")
    return tuple(parts)


def _in_order(by_target: dict[str, Any]) -> dict[str, Any]:
    """Returns the task first, then the strategies by number."""
    order = sorted(by_target, key=lambda t: (t != "task", len(t), t))
    return {target: by_target[target] for target in order}


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def _text(value: Any) -> str:
    return html.escape(str(value))


def _typeset(cell: str) -> str:
    """Returns a cell of the plain-text table with the signs that a page can show."""
    cell = cell.replace("+-", "\N{PLUS-MINUS SIGN}")
    if cell == "-":
        return "\N{EN DASH}"
    if cell.startswith("-"):
        cell = "\N{MINUS SIGN}" + cell[1:]
    if cell.endswith("x"):
        cell = cell[:-1] + "\N{MULTIPLICATION SIGN}"
    return _text(cell)
