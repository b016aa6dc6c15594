"""The demonstrations that ship: returns, styles, and how far their test sets reach."""

import numpy as np
import pytest

import represent_jax as rj
from represent_jax.methods.demonstrators import DEMONSTRATORS


@pytest.mark.parametrize("name", sorted(DEMONSTRATORS))
def test_shipped_demonstrations_are_within_a_tenth_of_their_targets(name):
    demonstrations = rj.load_demonstrations(name)
    for strategy, target in enumerate(DEMONSTRATORS[name].target_returns):
        assert abs(demonstrations.mean_return(strategy) / target - 1.0) < 0.1
    styles = demonstrations.metadata["style_accuracy"]
    assert styles["1-2"]["trajectories"] >= 0.95


@pytest.mark.parametrize("name", sorted({config.env for config in DEMONSTRATORS.values()}))
def test_shipped_test_sets_span_far_beyond_the_demonstrators(name):
    returns = np.array(
        [t.total_reward for t in rj.load_demonstrations(f"{name}_test").trajectories]
    )
    best = max(DEMONSTRATORS[name].target_returns)
    assert len(returns) >= 100
    assert returns.min() < 0.2 * best and returns.max() > 1.2 * best
