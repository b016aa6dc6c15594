"""Tables from records: what counts, what is shown beside it, and in which formats."""

import json

import numpy as np
import pytest

from represent_jax.campaign import embedded, formats, paper, tables
from represent_jax.campaign.variants import VARIANTS
from represent_jax.config import config_hash
from represent_jax.errors import RepresentError, UsageError


def _record(target, quantity, seed, value, method="represent", domain="hopper", preset="quick"):
    names = ("domain", "target", "method", "quantity", "seed", "value", "preset")
    values = (domain, target, method, quantity, seed, value, preset)
    return dict(zip(names, values, strict=True))


def test_seeds_are_aggregated_and_the_newest_record_of_a_run_counts():
    records = [
        _record("task", "pearson_pooled", 0, 0.1),
        _record("task", "pearson_pooled", 0, 0.9),
        _record("task", "pearson_pooled", 1, 0.7),
        _record("task", "pearson_pooled", 2, 0.3, preset="smoke"),
        _record("task", "pearson_pooled", 3, None),
    ]
    _, cells = tables.make("1", records, "quick")
    (cell,) = cells
    assert cell.found.num == 2 and cell.found.mean == pytest.approx(0.8)
    assert cell.paper == (0.949, 0.002)


def test_records_of_settings_that_the_preset_no_longer_has_are_marked():
    config = VARIANTS["represent"].config("quick", "hopper", ("seed=1",))
    records = [
        _record("task", "return_final", 1, 1.0) | {"config_hash": config_hash(config)},
        _record("task", "return_final", 2, 2.0) | {"config_hash": "0" * 12},
        _record("strategy_1", "return_final", 1, 1.0) | {"config_hash": config_hash(config)},
    ]
    title, cells = tables.make("2", records, "quick")
    assert {cell.target: cell.other_settings for cell in cells} == {"task": 1, "strategy_1": 0}
    (grid,) = tables.to_grids(title, cells)
    marked = {row[0]: row[1].endswith("\N{DAGGER}") for row in grid.rows}
    assert marked == {"Hopper, task": True, "Hopper, strategy 1": False}
    assert grid.note.endswith("\N{DAGGER}: of settings that the preset has no longer.")
    one = [record | {"preset": "quick_one_phase_1"} for record in records]
    assert not any(c.other_settings for c in tables.make("2", one, "quick_one_phase_1")[1])


def test_a_method_of_ones_own_stands_beside_the_others():
    records = [_record("task", "pearson_test", 0, 0.5, method=m) for m in ("ssrr", "mine:RIDGE")]
    title, cells = tables.make("1", records, "quick", ["mine:RIDGE"])
    assert [cell.method for cell in cells] == ["ssrr", "mine:RIDGE"]
    (grid,) = tables.to_grids(title, cells)
    assert grid.columns[1:] == ("SSRR", "mine:RIDGE")
    assert [cell.method for cell in tables.make("1", records, "quick")[1]] == ["ssrr"]
    with pytest.raises(UsageError, match="'mine:RIGDE': did you mean mine:RIDGE"):
        tables.make("1", records, "quick", ["mine:RIGDE"])


def test_imitation_is_shown_as_a_method_of_its_own():
    records = [_record("strategy_1", "airl_return", 0, 900.0)]
    records += [_record("strategy_1", "airl_pearson_test", 0, 0.5)]
    for name, quantity in (("2", "return_final"), ("1", "pearson_test")):
        _, (cell,) = tables.make(name, records, "quick")
        assert (cell.method, cell.quantity) == ("noisy_airl", quantity)


def test_demonstrators_of_the_task_are_those_of_all_strategies():
    records = [_record("strategy_1", "demo_return", seed, 1000.0) for seed in (0, 1)]
    records += [_record("strategy_2", "demo_return", 0, 2000.0)]
    _, cells = tables.make("2", records, "quick")
    found = {cell.target: cell.found.mean for cell in cells if cell.method == "demonstrators"}
    assert found == {"task": 1500.0, "strategy_1": 1000.0, "strategy_2": 2000.0}


def test_the_papers_percentages_follow_from_its_returns():
    shown = {("hopper", "strategy_1"): 110, ("half_cheetah", "strategy_2"): 329}
    for (domain, target), percent in shown.items():
        ours = paper.RETURNS[domain, target, "represent"]
        demonstrated = paper.RETURNS[domain, target, "demonstrators"]
        assert round(100 * ours / demonstrated) == percent


@pytest.mark.parametrize("style", formats.FORMATS)
def test_formats_hold_the_same_figures(style):
    records = [_record("task", "return_best", seed, 1000.0 + 10 * seed) for seed in range(5)]
    title, cells = tables.make("2", records, "quick")
    text = formats.render(style, title, cells)
    if style == "json":
        (cell,) = json.loads(text)["cells"]
        assert cell["found"]["mean"] == 1020.0
    else:
        assert "1,020" in text and "1,692" in text and "REPRESENT" in text
    if style == "latex":
        assert text.count(r"\\") == 2 and "%" not in text.replace(r"\%", "")


def test_json_of_a_single_seed_is_strict():
    title, cells = tables.make("2", [_record("task", "return_best", 0, 1.0)], "quick")
    (cell,) = json.loads(formats.render("json", title, cells))["cells"]
    assert cell["found"]["std"] is None and np.isfinite(cell["found"]["mean"])


def test_unknown_names_and_empty_tables_are_errors():
    with pytest.raises(UsageError, match="ablations"):
        tables.make("ablation", [], "quick")
    with pytest.raises(RepresentError, match="no record"):
        tables.make("3", [_record("task", "return_best", 0, 1.0, preset="smoke")], "quick")
    with pytest.raises(UsageError, match="markdown"):
        formats.render("markdwn", "", [])


def test_grids_have_a_table_a_quantity_and_a_column_a_method():
    records = [_record("task", "return_best", seed, 1000.0 + 10 * seed) for seed in range(3)]
    records += [_record("task", "return_best", 0, 7.0, method="drex")]
    records += [_record("strategy_1", "return_final", 0, 5.0)]
    records += [_record("strategy_1", "demo_return", 0, 4.0)]
    highest, kept = tables.to_grids(*tables.make("2", records, "quick"))
    assert highest.title.endswith("highest") and kept.title.endswith("kept")
    assert highest.columns == ("", "REPRESENT", "D-REX")
    assert highest.rows == (("Hopper, task", "1,010 +- 10 (1,692)", "7 (1) [1]"),)
    assert kept.columns == ("", "Demonstrators", "REPRESENT")
    assert kept.rows == (("Hopper, strategy 1", "4 (1,198)", "5"),)
    assert "3 seeds, or" in highest.note and kept.note == "One seed; in round brackets the paper's."


def test_grids_say_where_seeds_are_missing():
    records = [_record("task", "return_final", seed, 1000.0) for seed in range(5)]
    records += [_record("task", "return_final", seed, 900.0, method="ssrr") for seed in range(2)]
    text = formats.render("grid", *tables.make("2", records, "quick"))
    assert "| 1,000 ± 0 | 900 ± 0 [2] |" in text
    assert "over 5 seeds, or as many as square brackets say" in text


_BLOCK = """# Page
<!-- tables: --table=2 --preset=quick --format=grid -->
{}<!-- end of tables -->
"""


def test_tables_inside_a_page_are_written_anew_and_nothing_else_is():
    records = [_record("task", "return_best", 0, 1000.0)]
    page = embedded.update(_BLOCK.format("what stood here before\n") + "after", records)
    assert page.startswith("# Page\n") and page.endswith("after") and "| 1,000 (1,692) |" in page
    assert "what stood here" not in page
    assert embedded.update(page, records) == page


@pytest.mark.parametrize(
    ("page", "error"),
    [
        ("no block", "no block of tables"),
        ("<!-- tables: --table=2 -->\n", "does not end"),
        (_BLOCK.format("").replace("--table", "--tabel"), "expected --table"),
        (_BLOCK.format("").replace("=2", "=9"), "unknown table"),
        (_BLOCK.format("").replace("grid", "gird"), "unknown format"),
    ],
)
def test_blocks_that_cannot_be_filled_are_errors(page, error):
    with pytest.raises(RepresentError, match=error):
        embedded.update(page, [_record("task", "return_best", 0, 1000.0)])
