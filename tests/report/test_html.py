"""The page: whole, self-contained, and there for a run under way."""

import html.parser
import json
import re
import types

import numpy as np
import pytest

import represent_jax as rj
from represent_jax.errors import RepresentError
from represent_jax.methods.config import Problem
from represent_jax.methods.presets import make_config
from represent_jax.methods.results import describe
from represent_jax.report import html as html_page
from represent_jax.report import tables
from represent_jax.report.html import write_report

VOID = {"meta", "img"}


class _Checker(html.parser.HTMLParser):
    """Collects the text, and fails on tags that do not match."""

    def __init__(self):
        super().__init__()
        self.open, self.text, self.addresses = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(page):
    checker = _Checker()
    checker.feed(page.read_text())
    assert not checker.open
    return " ".join(checker.text), checker.addresses


def test_report_of_a_finished_run(run_path):
    page = write_report(run_path)
    assert page == run_path / "report.html"
    text, addresses = read(page)
    assert "not finished" not in text
    for words in ("Half cheetah", "Is the imitation", "3,350", "airl.learning_rate", "3 min 03 s"):
        assert words in text
    assert text.count("How to read this.") == 3
    assert len(addresses) == 8
    names = {path.name for path in (run_path / "figures").iterdir()}
    assert {"curve_strategy_1.png", "scatter_task.png", "learning_strategy_2.png"} <= names
    assert len(names) == 8


def test_report_needs_no_network(run_path):
    page = write_report(run_path)
    _, addresses = read(page)
    assert all(address.startswith("data:") for address in addresses)
    assert not re.search(r"https?://|url\(|@import|<script", page.read_text())


def test_report_of_a_run_that_has_only_begun(run_path):
    (run_path / "results.json").unlink()
    for file in (run_path / "arrays").iterdir():
        file.unlink()
    text, addresses = read(write_report(run_path))
    assert "This run is not finished." in text
    assert not addresses


def test_report_of_a_run_after_phase_2(run_path, results):
    del results["rewards"], results["policies"], results["seconds"]
    (run_path / "results.json").write_text(json.dumps(results))
    (run_path / "arrays" / "scatter.npz").unlink()
    (run_path / "arrays" / "learning_curves.npz").unlink()
    text, addresses = read(write_report(run_path))
    assert "This run is not finished." in text
    assert len(addresses) == 2


def test_one_strategy_alone_is_said_to_decompose_nothing(run_path, results):
    assert "nothing to decompose" not in read(write_report(run_path))[0]
    (run_path / "results.json").write_text(json.dumps(results | {"strategies": 1}))
    assert "nothing to decompose" in read(write_report(run_path))[0]


def test_demonstrations_that_stop_early_are_said_to(run_path, results):
    assert "though nothing ended them" not in read(write_report(run_path))[0]
    demonstrators = [{"name": f"strategy_{i}", "return_mean": 1.0, "num": 3} for i in (1, 2)]
    short = {"horizon": 50, "cut_short": 2, "cut_off": 1, "demonstrators": demonstrators}
    assert tables.lengths(results | short) == [
        "2 of 6 demonstrations stop before the horizon of 50 steps though nothing ended them: "
        "their returns are of fewer steps than those of the policies beside them.",
        "1 of 6 demonstrations go on beyond the horizon of 50 steps, and were cut there: nothing "
        "was learned from what they came to later. The setting `horizon` makes episodes longer.",
    ]


def test_the_source_of_the_demonstrations_is_told(run_path, results):
    assert html_page._notices(results | {"source": None}) == html_page._notices(results) == ""
    (run_path / "results.json").write_text(json.dumps(results | {"source": "my <lab>"}))
    text, _ = read(write_report(run_path))
    assert "by their file: my <lab>." in text and "operators" not in text


@pytest.mark.parametrize("env", ["franka_kitchen", "franka_kitchen_hand"])
def test_a_kitchen_nobody_drove_is_said_to_be_one(run_path, results, env):
    given = rj.load_demonstrations(env)
    problem = Problem(types.SimpleNamespace(backend="mujoco", horizon=500), given, given, ())
    described = describe(make_config("smoke", env), problem)
    assert (described["horizon"], described["cut_short"]) == (500, 0)
    source = described["source"]
    (run_path / "results.json").write_text(json.dumps(results | {"source": source}))
    text, _ = read(write_report(run_path))
    note = "Scripted operators, not people, drove the robot"
    assert source in text and note in text
    both = results | {"source": f"{source} + teleoperation"}
    (run_path / "results.json").write_text(json.dumps(both))
    text, _ = read(write_report(run_path))
    assert f"{source} + teleoperation" in text and note not in text


def test_demonstrations_that_nothing_ended_before_the_horizon_are_counted():
    given = rj.load_demonstrations("franka_kitchen")
    problem = Problem(types.SimpleNamespace(backend="mujoco", horizon=501), given, given, ())
    assert describe(make_config("smoke", "franka_kitchen"), problem)["cut_short"] == 10


def test_text_from_the_run_is_escaped(run_path, results):
    (run_path / "results.json").write_text(json.dumps(results | {"env": "<b>& co"}))
    page = write_report(run_path)
    assert "&lt;b&gt;&amp; co" in page.read_text()
    read(page)


def test_writing_twice_replaces_the_page(run_path):
    first = write_report(run_path).read_bytes()
    assert write_report(run_path).read_bytes() == first
    assert not list(run_path.glob(".tmp*"))


def test_what_is_no_run_is_refused(tmp_path, run_path):
    with pytest.raises(RepresentError, match=r"no config\.json"):
        write_report(run_path / "arrays")
    (run_path / "results.json").write_text("{")
    with pytest.raises(RepresentError, match=r"results\.json"):
        write_report(run_path)


def test_foreign_arrays_are_named(run_path):
    np.savez(run_path / "arrays" / "scatter.npz", points=np.zeros(3))
    with pytest.raises(RepresentError, match="'points'"):
        write_report(run_path)
