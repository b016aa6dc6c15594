"""`experiments.transfer` on smoke runs of all three domains, of runs and of a campaign."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import represent_jax as rj

ROOT = Path(__file__).parents[2]
CAMPAIGN = ("--preset=smoke", "--seeds=1", "--domains=inverted_double_pendulum", "--variants=bc")


def _launch(launcher, *flags):
    return subprocess.run(
        [sys.executable, "-m", f"experiments.{launcher}", *flags],
        cwd=ROOT,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=300,
    )


def _check(finished, record, env_name):
    """What is printed is what is recorded."""
    assert finished.returncode == 0, finished.stderr
    (row,) = (line for line in finished.stdout.splitlines() if line.startswith(env_name))
    records = {one["quantity"]: one for one in map(json.loads, record.read_text().splitlines())}
    assert {(one["domain"], one["method"], one["target"]) for one in records.values()} == {
        (env_name, "bc", "task")
    }
    ours, error, theirs, their_error, difference = (
        records[f"transfer_{name}"]["value"]
        for name in ("ours", "ours_error", "gymnasium", "gymnasium_error", "difference")
    )
    assert difference == pytest.approx((theirs - ours) / np.hypot(error, their_error))
    assert abs(difference) < 5.0
    assert f"{difference:.2f}" == row.split()[-1]


@pytest.mark.parametrize("name", ["hopper", "half_cheetah"])
def test_a_run(tmp_path, name):
    config = rj.make_config("smoke", name, method="bc")
    rj.learn(tmp_path / "run", config, rj.load_demonstrations(name))
    record = tmp_path / "records.jsonl"
    flags = (f"--run={tmp_path / 'run'}", "--episodes=12", f"--record={record}")
    _check(_launch("transfer", *flags), record, name)


def test_a_campaign(tmp_path):
    out, record = tmp_path / "campaign", tmp_path / "records.jsonl"
    finished = _launch("campaign", "--tables=2", f"--out={out}", *CAMPAIGN)
    assert finished.returncode == 0, finished.stderr
    flags = (f"--campaign={out}", "--episodes=12", f"--record={record}", *CAMPAIGN)
    _check(_launch("transfer", *flags), record, "inverted_double_pendulum")


def test_bad_usage_is_one_line():
    finished = _launch("transfer")
    assert finished.returncode == 2
    assert "either --run or --campaign" in finished.stderr and "Traceback" not in finished.stderr
