"""A small campaign: all methods, killed and started again."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TINY = ("--preset=smoke", "--domains=inverted_double_pendulum", "--seeds=1", "--tables=1")


def _start(out, *flags):
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.campaign", *TINY, f"--out={out}", *flags],
        cwd=ROOT,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _finish(process):
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    return output


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A campaign that was killed after some stages, and one that went on from there."""
    out = tmp_path_factory.mktemp("campaign")
    process = _start(out)
    deadline = time.monotonic() + 300
    while process.poll() is None and time.monotonic() < deadline:
        if len(list(out.glob("*/done.json"))) >= 4:
            break
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    stamps = {path: path.stat().st_mtime_ns for path in out.glob("*/done.json")}
    return out, stamps, _finish(_start(out))


def _records(out):
    return [json.loads(line) for line in (out / "records.jsonl").read_text().splitlines()]


def test_what_was_done_is_not_done_again(campaign):
    out, stamps, output = campaign
    assert len(stamps) >= 4
    for path, stamp in stamps.items():
        assert path.stat().st_mtime_ns == stamp
    assert f"{len(list(out.glob('*/done.json'))) - len(stamps)} of them left" in output


def test_it_ends_in_the_records_of_one_that_was_never_killed(campaign, tmp_path):
    out, stamps, _ = campaign
    _finish(_start(tmp_path, "--variants=represent"))
    done = {path.parent.name for path in tmp_path.glob("*/done.json")}
    # Some of its stages were done before the kill, some after.
    before = {path.parent.name for path in stamps}
    assert done & before and done - before

    def told(folder):
        return sorted(
            (record["target"], record["quantity"], record["value"])
            for record in _records(folder)
            if record["method"] == "represent"
        )

    assert told(out) == told(tmp_path)


def test_every_method_is_recorded_once(campaign):
    out, _, _ = campaign
    records = _records(out)
    assert {record["method"] for record in records} == {
        "represent",
        "ssrr",
        "msrd",
        "drex",
        "airl",
    }
    names = ("domain", "method", "target", "quantity", "seed", "config_hash")
    told = [tuple(record[name] for name in names) for record in records]
    assert len(set(told)) == len(told)
    pooled = {
        (record["method"], record["target"])
        for record in records
        if record["quantity"] == "pearson_pooled"
    }
    strategies = ("task", "strategy_1", "strategy_2")
    assert pooled == {
        ("drex", "task"),
        *((method, name) for method in ("represent", "ssrr", "msrd") for name in strategies),
    }


def test_a_finished_campaign_adds_nothing(campaign):
    out, _, _ = campaign
    before = _records(out)
    output = _finish(_start(out))
    assert ", 0 of them left" in output
    assert _records(out) == before
    counts = re.findall(r"^  .+ (\d+) x .+ = .+$", output, flags=re.MULTILINE)
    assert sum(map(int, counts)) == len(list(out.glob("*/done.json")))


def test_tables_are_printed_from_its_records(campaign):
    out, _, _ = campaign
    command = [sys.executable, "-m", "experiments.tables", "--table=1", "--preset=smoke"]
    shown = subprocess.run(
        [*command, f"--records={out / 'records.jsonl'}", "--format=markdown"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.count("Double pendulum, strategy 1") >= 3


def test_bad_usage_is_one_line(tmp_path):
    process = _start(tmp_path, "--tables=17")
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "unknown table" in output and "Traceback" not in output


def test_figures_are_drawn_from_its_folder(campaign, tmp_path):
    out, _, _ = campaign
    command = [sys.executable, "-m", "experiments.figures", f"--campaign={out}", "--seeds=1"]
    flags = ["--preset=smoke", "--domains=inverted_double_pendulum", f"--out={tmp_path}"]
    shown = subprocess.run(
        [*command, *flags], cwd=ROOT, capture_output=True, text=True, timeout=200
    )
    assert shown.returncode == 0, shown.stderr
    drawn = {path.name for path in tmp_path.glob("*.png")}
    names = {
        f"figure_{n}_inverted_double_pendulum_{m}.png"
        for n in (3, 4)
        for m in ("represent", "ssrr")
    }
    # Policies are no part of Table I, so there is no Figure 5.
    assert drawn == names
