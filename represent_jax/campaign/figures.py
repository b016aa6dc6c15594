"""Learning curves of several methods over seeds, in the manner of the paper's Figure 5."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from represent_jax.campaign.tables import VARIANT_NAMES
from represent_jax.report import figures
from represent_jax.report.values import display_name

# Colour-blind safe and apart from the colours that stand for targets.
_COLOURS = ("#0b5c8a", "#c7651d", "#5d7d2b", "#7a4a8c")

# Env steps and true returns of one seed, both `[num_evals]`.
Path = tuple[np.ndarray, np.ndarray]


def learning(paths: Mapping[str, Mapping[str, Sequence[Path]]]) -> Figure:
    """Draws the mean true return over seeds, with its standard deviation, a panel a target.

    Args:
      paths: by target and method, a path for each seed, all evaluated at the same env steps.
    """
    with figures.panels(len(paths)) as (figure, axes):
        for ax, (target, methods) in zip(axes, paths.items(), strict=True):
            _draw(ax, target, methods)
    return figure


def _draw(ax: Axes, target: str, methods: Mapping[str, Sequence[Path]]) -> None:
    for colour, (method, seeds) in zip(_COLOURS, methods.items(), strict=False):
        steps = seeds[0][0]
        returns = np.stack([values for _, values in seeds])
        mean, std = returns.mean(axis=0), returns.std(axis=0, ddof=min(1, len(returns) - 1))
        label = f"{VARIANT_NAMES[method]} ({len(seeds)} seed{'s' * (len(seeds) > 1)})"
        ax.plot(steps, mean, color=colour, lw=1.6, label=label)
        ax.fill_between(steps, mean - std, mean + std, color=colour, alpha=0.18, lw=0)
    ax.set_title(display_name(target))
    ax.set_xlabel("env steps")
    ax.set_ylabel("true return")
    ax.legend(frameon=False)
