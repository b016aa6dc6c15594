"""Figures of a run, drawn without a display and without matplotlib's global state."""

import base64
import contextlib
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from represent_jax.data.atomic import replacing
from represent_jax.report.values import display_name, format_correlation, format_number, pearson
from represent_jax.stages.curve import Curve, CurveStatus, evaluate

INK = "#1f2933"
MUTED = "#6b7785"
GRID = "#e6e9ed"
DEMONSTRATIONS = "#d62839"
TEST = "#2a9d5c"
# Yellow, blue as in the paper's Figure 4, then further strategies.
STRATEGIES = ("#e5a50a", "#2f6fdb", "#8e44c9", "#d0661b", "#0f8b8d", "#c2488f")
TASK = "#2d3b4e"

PANEL_INCHES = (4.4, 3.5)

_STYLE = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": "#aab3bd",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.9,
    "lines.solid_capstyle": "round",
    "text.color": INK,
    "svg.hashsalt": "represent_jax",
    "svg.fonttype": "path",
    "savefig.facecolor": "white",
}


def colour(target: str) -> str:
    """Returns the colour that stands for "task" or "strategy_<i>" in every figure."""
    if target in ("task", "merged"):
        return TASK
    return STRATEGIES[(int(target.rpartition("_")[2]) - 1) % len(STRATEGIES)]


def noise_curves(curves: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draws the scaled returns at each noise level and the curve fitted to them, a panel a target.

    Args:
        curves: the entries of results.json's "curve", by target.
    """
    with panels(len(curves)) as (figure, axes):
        for ax, (target, curve) in zip(axes, curves.items(), strict=True):
            _draw_noise_curve(ax, target, curve)
    return figure


def scatters(points: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]) -> Figure:
    """Draws learned against true return, a panel a target, in the manner of the paper's Figure 4.

    Args:
        points: by target and group ("demonstrations", "test", "noisy_1", ...), the true and the
            learned returns, both [n].
    """
    with panels(len(points), (PANEL_INCHES[0], PANEL_INCHES[1] + 0.35)) as (figure, axes):
        for ax, (target, groups) in zip(axes, points.items(), strict=True):
            _draw_scatter(ax, target, groups)
    return figure


def learning_curves(
    curves: Mapping[str, Mapping[str, np.ndarray]],
    demonstrators: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Draws true return, and learned return below it, against env steps, a column a target.

    Args:
        curves: by target, "env_steps", "true_return" and "learned_return", each [num_evals].
        demonstrators: by target, the mean true return of its demonstrators and that of the best
            demonstrator of all.
    """
    size = (PANEL_INCHES[0], PANEL_INCHES[1] + 0.8)
    with panels(len(curves), size, rows=(3.0, 2.0)) as (figure, axes):
        columns = zip(axes[::2], axes[1::2], curves.items(), strict=True)
        for ax_true, ax_learned, (target, curve) in columns:
            levels = (demonstrators or {}).get(target)
            _draw_learning_curve(ax_true, ax_learned, target, curve, levels)
    return figure


def save_png(figure: Figure, path: Path, dpi: int = 160) -> None:
    """Writes the figure to a PNG file.

    Raises:
        RepresentError: no space is left, or the file cannot be written.
    """
    with replacing(path) as temporary, matplotlib.rc_context(_STYLE):
        figure.savefig(temporary, format="png", dpi=dpi)


def svg_data_uri(figure: Figure) -> str:
    """Returns the figure as a `data:` address that a page can hold; equal figures, equal text."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()


@contextlib.contextmanager
def panels(
    num: int, inches: tuple[float, float] = PANEL_INCHES, rows: tuple[float, ...] = (1.0,)
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Yields a figure of `num` columns and its axes, column by column."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(inches[0] * max(num, 1), inches[1]), layout="constrained")
        grid = figure.subplots(
            len(rows), max(num, 1), squeeze=False, sharex="col", height_ratios=rows
        )
        yield figure, list(grid.T.ravel())


def _draw_noise_curve(ax: Axes, target: str, curve: Mapping[str, Any]) -> None:
    levels = _numbers(curve.get("levels"))
    returns = _numbers(curve.get("returns"))
    fitted = _numbers(curve.get("fitted"))
    falls = curve.get("status") in ("converged", "max_iterations")
    ax.plot(
        levels,
        returns,
        "o",
        ms=5.5,
        mfc="white",
        mec=colour(target),
        mew=1.5,
        label="rollouts",
        zorder=3,
    )
    if fitted.size and np.all(np.isfinite(fitted)):
        label = "sigmoid" if falls else "isotonic fit: no sigmoid fits"
        ax.plot(*_dense(curve, levels, fitted, falls), color=colour(target), label=label)
    r2 = curve.get("r2")
    quality = f"  $R^2$ = {r2:.2f}" if falls and r2 is not None else ""
    ax.set_title(f"{display_name(target)}{quality}")
    ax.set_xlabel("noise level $\\eta$")
    ax.set_ylabel("return under the initial reward, scaled")
    ax.set_ylim(-0.12, 1.12)
    ax.legend(loc="lower left" if falls else "best")


def _dense(
    curve: Mapping[str, Any], levels: np.ndarray, fitted: np.ndarray, falls: bool
) -> tuple[np.ndarray, np.ndarray]:
    parameters = [curve.get(name) for name in ("x0", "y0", "c", "k")]
    if not falls or any(parameter is None for parameter in parameters):
        return levels, fitted
    eta = np.linspace(levels[0], levels[-1], 200)
    x0, y0, c, k = (np.float32(parameter) for parameter in parameters)
    rest = dict(scaled_returns=fitted, r2=np.float32(1.0), status=np.int32(CurveStatus.CONVERGED))
    levels, fitted = levels.astype(np.float32), fitted.astype(np.float32)
    found = Curve(x0=x0, y0=y0, c=c, k=k, levels=levels, fitted=fitted, **rest)
    return eta, np.asarray(evaluate(found, eta.astype(np.float32)))


def _draw_scatter(
    ax: Axes,
    target: str,
    groups: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> None:
    order = sorted(groups, key=lambda g: (g != "demonstrations", g != "test", len(g), g))
    handles = {}
    for group in reversed(order):
        true, learned = groups[group]
        if group == "demonstrations":
            style = dict(color=DEMONSTRATIONS, s=46, label="demonstrations", linewidths=0.9)
        elif group == "test":
            style = dict(color=TEST, s=22, label="unseen test", linewidths=0.5)
        else:
            of = group.rpartition("_")[2]
            own = f"strategy_{of}" if of.isdigit() else "task"
            label = f"noisy {own.replace('_', ' ')}" if of.isdigit() else "noisy"
            style = dict(color=colour(own), s=22, label=label, linewidths=0.5)
        handles[group] = ax.scatter(true, learned, alpha=0.85, edgecolors="white", **style)
    pooled = pearson(*(np.concatenate([groups[g][i] for g in order]) for i in (0, 1)))
    title = f"{display_name(target)}  r = {format_correlation(pooled)}"
    if "test" in groups:
        title += f"  (unseen test {format_correlation(pearson(*groups['test']))})"
    ax.set_title(title)
    if "demonstrations" in groups and len(groups["demonstrations"][0]):
        best = np.max(groups["demonstrations"][0])
        ax.axvline(best, color=DEMONSTRATIONS, lw=1.0, ls=(0, (4, 3)), zorder=0.9)
    ax.set_xlabel("true return")
    ax.set_ylabel("learned return")
    ax.xaxis.set_major_locator(MaxNLocator(5))
    _legend_below(ax, [handles[group] for group in order], 0.2)


def _draw_learning_curve(
    ax_true: Axes,
    ax_learned: Axes,
    target: str,
    curve: Mapping[str, np.ndarray],
    levels: tuple[float, float] | None,
) -> None:
    steps = np.asarray(curve["env_steps"], np.float64)
    true = np.asarray(curve["true_return"], np.float64)
    learned = np.asarray(curve["learned_return"], np.float64)
    handles = ax_true.plot(steps, true, color=colour(target), label="policy")
    title = display_name(target)
    if true.size:
        ax_true.plot(steps[-1], true[-1], "o", color=colour(target), ms=5.5, mec="white")
        title += f"  final {format_number(true[-1])}"
    if levels is not None:
        mean, best = levels
        own = "demonstrators' mean" if target == "task" else "its demonstrator"
        for level, label, dashes in ((mean, own, (5, 3)), (best, "best demonstrator", (1, 1.6))):
            if label == own or not np.isclose(mean, best):
                style = dict(color=DEMONSTRATIONS, lw=1.3, ls=(0, dashes), label=label)
                handles.append(ax_true.axhline(level, **style))
    ax_true.set_title(title)
    ax_true.set_ylabel("true return")
    ax_true.tick_params(labelbottom=False)
    ax_learned.plot(steps, learned, color=MUTED)
    ax_learned.set_ylabel("learned return")
    ax_learned.set_xlabel("environment steps")
    ax_learned.xaxis.set_major_formatter(EngFormatter(sep=""))
    ax_learned.xaxis.set_major_locator(MaxNLocator(6))
    _legend_below(ax_learned, handles, 0.36, ncols=3)


def _legend_below(ax: Axes, handles: Sequence[Artist], distance: float, ncols: int = 2) -> None:
    """Puts the legend below the axes, where it covers no data; distance is in axes heights."""
    ax.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.46, -distance),
        ncols=ncols,
        handletextpad=0.4,
        columnspacing=1.2,
    )


def _numbers(values: Sequence[float | None] | None) -> np.ndarray:
    """Returns the numbers as an array [n], null as NaN."""
    return np.array([np.nan if value is None else value for value in values or ()], np.float64)
