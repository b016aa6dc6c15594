"""Learning curves over seeds."""

import numpy as np

from represent_jax.campaign.figures import learning


def test_mean_and_spread_over_seeds_are_drawn():
    steps = np.array([10.0, 20.0, 30.0])
    seeds = [(steps, np.array([0.0, 1.0, 4.0])), (steps, np.array([2.0, 3.0, 6.0]))]
    figure = learning(
        {"task": {"represent": seeds, "ssrr": seeds[:1]}, "strategy_1": {"ssrr": seeds}}
    )
    axes = figure.axes[0]
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["Task", "Strategy 1"]
    drawn = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    np.testing.assert_allclose(drawn["REPRESENT (2 seeds)"], [1.0, 2.0, 5.0])
    band = axes.collections[0].get_paths()[0].vertices[:, 1]
    # The deviation of two seeds that differ by 2, as the tables have it.
    np.testing.assert_allclose([band.min(), band.max()], [1.0 - 2**0.5, 5.0 + 2**0.5])
