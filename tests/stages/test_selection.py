"""Whose policy a target is handed: cases by hand."""

import jax
import jax.numpy as jnp
import pytest

from represent_jax.errors import UsageError
from represent_jax.stages.selection import SelectionConfig, choose

# The task, then two strategies.
MARGINS = jnp.array([0.0, 0.05, 0.05])


def chosen(*rows):
    return jax.jit(choose)(jnp.array(rows), MARGINS).tolist()


def test_each_keeps_its_own_where_it_earns_most():
    assert chosen([3.0, 1.0, 1.0], [2.0, 4.0, 1.0], [1.0, 1.0, 5.0]) == [0, 1, 2]


def test_the_task_takes_whatever_earns_more():
    assert chosen([10.0, 9.0, 9.0], [10.1, 10.0, 9.0], [10.2, 9.0, 10.0]) == [2, 1, 2]


def test_a_strategy_keeps_its_style_within_the_margin():
    assert chosen([10.0, 10.4, 9.0], [9.0, 10.0, 9.0], [9.0, 10.4, 10.0]) == [0, 1, 2]


def test_a_strategy_that_was_stuck_takes_the_best_of_the_others():
    assert chosen([14.6, 14.61, 15.4], [12.9, 13.3, 14.8], [14.5, 14.55, 15.5]) == [0, 0, 2]


def test_the_margin_is_a_share_of_negative_returns_too():
    assert chosen([0.0, -9.6, 0.0], [0.0, -10.0, 0.0], [0.0, 0.0, 0.0])[1] == 2
    assert chosen([0.0, -9.6, 0.0], [0.0, -10.0, 0.0], [0.0, -9.7, 0.0])[1] == 1


def test_one_target_has_one_choice():
    assert jax.jit(choose)(jnp.array([[jnp.nan]]), jnp.zeros(1)).tolist() == [0]


def test_a_policy_of_no_finite_return_is_replaced():
    assert chosen([jnp.nan, jnp.nan, 0.0], [5.0, 6.0, 0.0], [1.0, jnp.nan, jnp.nan]) == [1, 1, 0]


def test_what_is_not_finite_is_never_handed_to_others():
    assert chosen([jnp.nan, jnp.nan, 1.0], [1.0, 1.0, 1.0], [2.0, 0.5, 1.0])[1] == 1


def test_no_strategy_is_handed_what_leaves_the_task_undone():
    # The second strategy's own policy earns most of its reward, and next to nothing of the task's.
    returns = jnp.array([[10.0, 9.0, 9.0], [9.0, 9.5, 8.0], [4.0, 7.0, 11.0]])
    task_returns = returns[:, 0]

    def with_floor(floor):
        floors = jnp.array([-jnp.inf, floor, floor])
        return jax.jit(choose)(returns, MARGINS, task_returns, floors).tolist()

    assert jax.jit(choose)(returns, MARGINS).tolist() == [0, 1, 2]
    assert with_floor(7.5) == [0, 1, 0]
    assert with_floor(9.5) == [0, 0, 0]
    # Where none does the task, each keeps its own.
    assert with_floor(20.0) == [0, 1, 2]


def test_a_negative_margin_is_refused():
    with pytest.raises(UsageError, match="strategy_margin: expected at least 0"):
        SelectionConfig(strategy_margin=-0.1)
