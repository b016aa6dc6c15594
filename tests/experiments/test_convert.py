"""The launcher that converts: what it writes, what it says, how it refuses."""

import subprocess
import sys
from pathlib import Path

import pytest

import represent_jax as rj

ROOT = Path(__file__).parents[2]


def convert(*flags):
    command = [sys.executable, "-m", "experiments.convert", *flags]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


def test_two_tables_become_two_strategies(tmp_path):
    rows = "obs_0,obs_1,action_0,reward\n0,1,0.5,2\n1,1,0.25,3\n2,1,,\n"
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(rows)
    inputs, out = f"{tmp_path / 'a.csv'},{tmp_path / 'b.csv'}", tmp_path / "mine.npz"
    said = convert("--from=arrays", f"--inputs={inputs}", f"--out={out}", "--env=cart")
    assert said.returncode == 0, said.stderr
    assert "cart: 2 trajectories of 2 demonstrators, 4 steps" in said.stdout
    assert "strategy 2: 1 trajectories of 2 to 2 steps" in said.stdout
    assert "mean return 5.0" in said.stdout
    held = rj.load_demonstrations(out)
    assert held.num_strategies == 2 and held.action_dim == 1 and held.has_rewards
    # What somebody recorded is not written over by a name given twice.
    again = convert("--inputs=hopper", f"--out={out}")
    assert again.returncode == 2 and "exists already" in again.stderr
    assert rj.load_demonstrations(out).env_name == "cart"
    assert convert("--inputs=hopper", f"--out={out}", "--overwrite").returncode == 0
    assert rj.load_demonstrations(out).env_name == "hopper"


@pytest.mark.parametrize(
    "flags, message",
    [
        (("--from=minary", "--inputs=a"), "did you mean minari"),
        (("--inputs=nothing.npz", "--leave_out=rewards"), "nothing.npz: no such file"),
    ],
)
def test_bad_usage_is_one_line(flags, message):
    said = convert(*flags)
    assert said.returncode == 2
    assert message in said.stderr and "Traceback" not in said.stderr
