"""The tables a terminal shows."""

import numpy as np
import pytest

from represent_jax.report.tables import (
    Table,
    demonstrator_levels,
    returns_table,
    rewards_table,
    summary,
    to_text,
)
from represent_jax.report.values import display_name, format_correlation, format_number, pearson


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (12345.6, "12,346"),
        (-1234.5, "-1,234"),
        (123.44, "123.4"),
        (0.0271, "0.027"),
        (None, "-"),
        (float("nan"), "-"),
    ],
)
def test_numbers_have_the_decimals_a_reader_needs(value, text):
    assert format_number(value) == text


def test_correlations_close_to_one_get_a_third_digit():
    assert [format_correlation(r) for r in (0.874, 0.9987, -0.2)] == ["0.87", "0.999", "-0.20"]
    assert format_correlation(float("nan")) == "\N{EN DASH}"


def test_pearson_is_nan_where_it_is_not_defined():
    assert pearson(np.arange(4.0), 2 - 3 * np.arange(4.0)) == pytest.approx(-1.0)
    assert pearson(np.array([0.0, 1.0, np.nan]), np.array([0.0, 1.0, 5.0])) == pytest.approx(1.0)
    assert np.isnan(pearson(np.zeros(4), np.arange(4.0)))
    assert np.isnan(pearson(np.zeros(1), np.zeros(1)))


def test_columns_are_aligned():
    table = Table("T", ("name", "a", "b"), (("x", "1", "22"), ("longer", "333", "4")), "")
    assert to_text(table).splitlines() == [
        "T",
        "---------------",
        "name      a   b",
        "---------------",
        "x         1  22",
        "longer  333   4",
        "---------------",
    ]


def test_summary_of_a_finished_run(results):
    text = summary(results)
    lines = [line.split() for line in text.splitlines()]
    assert ["Task", "1,400", "-", "3,100", "3,350", "2.22x", "12.3", "-"] in lines
    strategy = ["Strategy", "1", "1,200", "+-", "12.0", "1,150", "3,100", "3,350", "2.22x"]
    assert [*strategy, "12.3", "87", "%"] in lines
    assert ["Strategy", "2", "0.970", "0.950", "0.930", "0.962", "0.810"] in lines
    assert text.isascii()
    assert max(len(line) for line in text.splitlines()) <= 80


def test_summary_of_a_run_that_is_under_way(results):
    assert summary({}) == ""
    early = {key: results[key] for key in ("demonstrators", "airl")}
    assert "1,150" in summary(early)
    assert rewards_table(early) is None
    results["policies"] = {"task": {"return_final": None}}
    results["rewards"] = {"task": {}}
    assert "Task" in summary(results)


def test_a_policy_of_another_target_is_named(results):
    own = {"trained_for": "strategy_2", "learned_returns": {}}
    results["selection"] = {"strategy_1": own, "strategy_2": own}
    note = returns_table(results).note
    assert "Strategy 1 has the policy of strategy 2" in note and "Strategy 2 has" not in note


def test_levels_of_the_demonstrators(results):
    assert demonstrator_levels(results)["task"] == (1400.0, 1600.0)
    assert demonstrator_levels(results)["strategy_1"] == (1200.0, 1600.0)
    assert display_name("strategy_1") == "Strategy 1"
