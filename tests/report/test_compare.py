"""The page that compares runs: what differs between them, and nothing from the network."""

import json
import re
import shutil

import pytest
from test_html import read

from represent_jax.errors import UsageError
from represent_jax.report import compare


@pytest.fixture
def runs(run_path, tmp_path_factory, results):
    """The made-up run, and one of another seed that learned better policies and no curve."""
    folder = tmp_path_factory.mktemp("runs")
    shutil.copytree(run_path, folder / "a")
    shutil.copytree(run_path, folder / "b")
    config = json.loads((folder / "b" / "config.json").read_text())
    config["config"] |= {"seed": 7, "airl": {"learning_rate": 3e-4}}
    (folder / "b" / "config.json").write_text(json.dumps(config))
    results["policies"]["task"] = {"return_final": 4321.0}
    (folder / "b" / "results.json").write_text(json.dumps(results))
    return folder / "a", folder / "b"


def test_a_comparison_shows_what_differs(runs, tmp_path):
    page = compare.write_comparison(runs, tmp_path / "new" / "page.html")
    text, addresses = read(page)
    assert page == tmp_path / "new" / "page.html"
    for words in ("2 runs", "seed 7", "4,321", "3,100", "airl.learning_rate", "0.0003", "0.970"):
        assert words in text
    assert "preset" not in text  # The same for both.
    assert len(addresses) == 5  # Learning curves of three targets, noise curves of two strategies.
    assert all(address.startswith("data:") for address in addresses)
    assert not re.search(r"https?://|url\(|@import|<script", page.read_text())


def test_runs_under_way_are_compared_by_what_they_have(runs, tmp_path):
    (runs[1] / "results.json").unlink()
    shutil.rmtree(runs[1] / "arrays")
    text, addresses = read(compare.write_comparison(runs, tmp_path / "page.html"))
    assert "3,100" in text and len(addresses) == 5


def test_settings_that_differ():
    configs = {"a": {"x": 1, "inner": {"y": 2}}, "b": {"x": 1, "inner": {"y": 3}, "z": True}}
    assert compare.settings_that_differ(configs) == {"inner.y": [2, 3], "z": [None, True]}


def test_one_run_alone_or_twice_is_refused(runs, tmp_path):
    with pytest.raises(UsageError, match="at least two"):
        compare.write_comparison(runs[:1], tmp_path / "page.html")
    with pytest.raises(UsageError, match="twice"):
        compare.write_comparison([runs[0], f"{runs[0]}/"], tmp_path / "page.html")
