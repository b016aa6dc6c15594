"""The page of a run, made from whatever stages are done.

One file that needs no network; only videos, where there are any, lie beside it.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from represent_jax.data.atomic import replacing
from represent_jax.data.trajectories import SOURCES
from represent_jax.report import contents, diagnostics, figures, showcase, tables
from represent_jax.report.page import document, flat, gallery, pairs, table, text
from represent_jax.report.values import (
    METHOD_NAMES,
    display_name,
    format_duration,
    format_number,
)
from represent_jax.runs.records import provenance

_CURVES_NOTE = (
    "Each circle is the typical return of rollouts whose actions were replaced by random ones with "
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
# How files begin to say where they are from if `experiments.make_demonstrations` drove the robot.
_SCRIPTED = "scripted operators"
_SCRIPTED_NOTE = (
    "Scripted operators, not people, drove the robot: programs that press the keys of the same "
    "interface that a person would use."
)


def write_report(run_path: str | os.PathLike) -> Path:
    """Writes report.html and figures/*.png into a run's folder, and returns the page's path.

    Stages that have no results yet are left out, and the page says so.

    Raises:
        RepresentError: the folder holds no run, or its results cannot be read or written to.
    """
    run, config, results, curves, points, learning, losses = contents.load(run_path)
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
        answers = diagnostics.verdicts(results, learning, losses)
        page_html = _page(config, results, answers, drawn, showcase.read(run))
        temporary.write_text(page_html, encoding="utf-8")
    return page


def _page(
    config: Mapping[str, Any],
    results: Mapping[str, Any],
    answers: Sequence[diagnostics.Verdict],
    drawn: Mapping[str, Mapping[str, Figure]],
    shown: showcase.Showcase | None,
) -> str:
    env = results.get("env", config.get("env", "unknown environment"))
    body = [
        _header(env, config, results),
        _notices(results),
        _verdicts(answers),
        table(tables.returns_table(results)),
        gallery("Policies", drawn["learning"], _LEARNING_NOTE, "Learning curves"),
        _videos(shown),
        table(tables.rewards_table(results)),
        gallery("Rewards", drawn["scatter"], _SCATTER_NOTE, "Learned against true return"),
        gallery("Noise and performance", drawn["curve"], _CURVES_NOTE, "Noise-performance curve"),
        _times(results.get("seconds") or {}),
        pairs("Configuration", flat(config)),
        pairs("Versions", _versions(results)),
    ]
    return document(f"{_method(config)}: {env}", body)


def _method(config: Mapping[str, Any]) -> str:
    name = str(config.get("method", "represent"))
    return METHOD_NAMES.get(name, name)


def _header(env: Any, config: Mapping[str, Any], results: Mapping[str, Any]) -> str:
    facts = [(key, results.get(key, config.get(key))) for key in ("preset", "seed", "backend")]
    facts.append(("strategies", results.get("strategies")))
    seconds = sum(value for value in (results.get("seconds") or {}).values() if value)
    facts.append(("time", format_duration(seconds) if seconds else None))
    memory = results.get("peak_memory_gib")
    facts.append(("peak memory", None if memory is None else f"{format_number(memory, 1)} GiB"))
    shown = "".join(
        f"<li><span>{text(key)}</span> {text(value)}</li>"
        for key, value in facts
        if value is not None
    )
    return (
        f"<header><p>{text(_method(config))} on suboptimal, heterogeneous demonstrations</p>"
        f"<h1>{text(display_name(str(env)))}</h1>"
        f"<ul class=facts>{shown}</ul></header>"
    )


def _notices(results: Mapping[str, Any]) -> str:
    notices = []
    # Results are written when the last stage ends.
    if not results.get("seconds"):
        notices.append("This run is not finished. The page shows what there is.")
    if results.get("strategies") == 1 and len(tables.targets(results)) > 1:
        notices.append(
            "The demonstrations hold one strategy alone: there is nothing to decompose, and task "
            "and strategy reward may share what was learned in any way."
        )
    notices += _source(results)
    notices += tables.lengths(results)
    notices += tables.missing(results)
    return "".join(f"<p class=notice>{text(notice)}</p>" for notice in notices)


def _source(results: Mapping[str, Any]) -> list[str]:
    """Where the demonstrations are from, if their file says so."""
    source = results.get("source")
    if not source:
        return []
    said = [f"Where the demonstrations are from, by their file: {source}."]
    if all(one.startswith(_SCRIPTED) for one in str(source).split(SOURCES)):
        said.append(_SCRIPTED_NOTE)
    return [" ".join(said)]


def _verdicts(verdicts: Iterable[diagnostics.Verdict]) -> str:
    cards = []
    for verdict in verdicts:
        details = "".join(f"<li>{text(line)}</li>" for line in verdict.details)
        cards.append(
            f'<article class="card {verdict.level}"><h3>{text(verdict.question)}'
            f"<b>{text(verdict.level)}</b></h3><p>{text(verdict.sentence)}</p>"
            f"<ul>{details}</ul></article>"
        )
    if not cards:
        return ""
    return f"<section><h2>Verdicts</h2><div class=cards>{''.join(cards)}</div></section>"


def _videos(shown: showcase.Showcase | None) -> str:
    if shown is None:
        return ""
    parts = []
    for video in shown.videos:
        speed = ""
        if video.speed != 1:
            speed = f'<span style="flex-basis:100%">{video.speed} times as fast</span>'
        panels = "".join(
            f"<span><b>{text(panel.name)}</b>, "
            f"true return {format_number(panel.true_return)}</span>"
            for panel in video.panels
        )
        parts.append(
            f'<figure style="max-width:{380 * len(video.panels)}px">'
            f"<h3>{text(display_name(video.target))}</h3>"
            f'<video src="{text(video.file)}" controls loop muted playsinline></video>'
            f'<figcaption style="flex-wrap:wrap">{panels}{speed}</figcaption></figure>'
        )
    parts += [f"<p class=notice>{text(line)}</p>" for line in shown.notices]
    return f"<section><h2>Side by side</h2>{''.join(parts)}</section>"


def _times(seconds: Mapping[str, float | None]) -> str:
    known = {stage: value for stage, value in seconds.items() if value is not None}
    if not known:
        return ""
    longest = max(*known.values(), 1e-9)
    rows = "".join(
        f"<tr><th scope=row>{text(stage)}</th><td>{format_duration(value)}</td>"
        f'<td class=bar><i style="width:{100 * value / longest:.1f}%"></i></td></tr>'
        for stage, value in known.items()
    )
    return f"<section><h2>Time</h2><table class=times><tbody>{rows}</tbody></table></section>"


def _versions(results: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what the run noted of its code and machine, or else what this process runs on."""
    found = {**provenance(), **{k: results[k] for k in provenance() if results.get(k)}}
    return flat(found)
