"""What the figures hold, not how they look."""

import matplotlib
import numpy as np
import pytest
from matplotlib import _pylab_helpers
from matplotlib.colors import to_hex

from represent_jax.report import figures


def test_scatter_has_the_colours_of_the_papers_figure_4(points):
    figure = figures.scatters(points)
    assert len(figure.axes) == 3
    drawn = {c.get_label(): to_hex(c.get_facecolor()[0]) for c in figure.axes[0].collections}
    assert drawn == {
        "demonstrations": figures.DEMONSTRATIONS,
        "unseen test": figures.TEST,
        "noisy strategy 1": figures.STRATEGIES[0],
        "noisy strategy 2": figures.STRATEGIES[1],
    }
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert legend == ["demonstrations", "unseen test", "noisy strategy 1", "noisy strategy 2"]


def test_scatter_title_has_the_pooled_and_the_held_out_correlation():
    line = (np.arange(5.0), np.arange(5.0))
    groups = {"test": line, "noisy_1": (np.arange(5.0), -np.arange(5.0))}
    title = figures.scatters({"task": groups}).axes[0].get_title(loc="left")
    assert title == "Task  r = 0.00  (unseen test 1.000)"


def test_noise_curve_passes_through_the_fitted_values(results):
    figure = figures.noise_curves({"strategy_1": results["curve"][0]})
    points, curve = figure.axes[0].get_lines()
    np.testing.assert_allclose(points.get_ydata(), results["curve"][0]["returns"])
    at_levels = np.interp(points.get_xdata(), curve.get_xdata(), curve.get_ydata())
    np.testing.assert_allclose(at_levels, results["curve"][0]["fitted"], atol=2e-3)
    assert "0.97" in figure.axes[0].get_title(loc="left")


def test_degenerate_noise_curve_is_drawn_without_cancellation(results):
    curve = results["curve"][0] | {"x0": 2.99, "y0": -2034.0, "c": 2036.0, "k": -3.52}
    eta = np.array(curve["levels"])
    curve["fitted"] = (2036.0 / (1.0 + np.exp(3.52 * (eta - 2.99))) - 2034.0).tolist()
    line = figures.noise_curves({"strategy_1": curve}).axes[0].get_lines()[1]
    at_levels = np.interp(eta, line.get_xdata(), line.get_ydata())
    np.testing.assert_allclose(at_levels, curve["fitted"], atol=2e-3)
    assert np.all(np.diff(line.get_ydata()) <= 1e-6)


@pytest.mark.parametrize("status", ["not_falling", "non_finite"])
def test_noise_curve_without_a_sigmoid(results, status):
    curve = results["curve"][0] | {"status": status}
    if status == "non_finite":
        empty = {"x0": None, "y0": None, "c": None, "k": None, "r2": None}
        curve |= empty | {"returns": [None] * 20, "fitted": [None] * 20}
    lines = figures.noise_curves({"strategy_1": curve}).axes[0].get_lines()
    assert len(lines) == (2 if status == "not_falling" else 1)
    if status == "not_falling":
        np.testing.assert_allclose(lines[1].get_ydata(), curve["fitted"])
        assert "isotonic" in lines[1].get_label()


def test_learning_curves_show_the_demonstrators(learning):
    levels = {"task": (1400.0, 1600.0), "strategy_1": (1600.0, 1600.0)}
    figure = figures.learning_curves(learning, levels)
    assert len(figure.axes) == 6
    by_title = {ax.get_title(loc="left").split("  ")[0]: ax for ax in figure.axes}

    def dashed(ax):
        return {line.get_label(): line.get_ydata()[0] for line in ax.get_lines()[2:]}

    assert dashed(by_title["Task"]) == {"demonstrators' mean": 1400, "best demonstrator": 1600}
    assert dashed(by_title["Strategy 1"]) == {"its demonstrator": 1600}
    assert dashed(by_title["Strategy 2"]) == {}


def test_learning_curve_before_its_first_evaluation():
    empty = {name: np.zeros(0) for name in ("env_steps", "true_return", "learned_return")}
    figures.svg_data_uri(figures.learning_curves({"task": empty}, {"task": (1.0, 2.0)}))


def test_drawing_leaves_no_global_state(points, tmp_path):
    before = dict(matplotlib.rcParams)
    figures.save_png(figures.scatters(points), tmp_path / "new" / "scatter.png")
    assert (tmp_path / "new" / "scatter.png").read_bytes().startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before
    assert not _pylab_helpers.Gcf.figs


def test_equal_figures_are_equal_text(learning):
    first, second = (figures.svg_data_uri(figures.learning_curves(learning)) for _ in range(2))
    assert first == second
    assert first.startswith("data:image/svg+xml;base64,")
