"""The benchmark's tables, on next to nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def benchmark(*flags, folder):
    command = [sys.executable, "-m", "experiments.benchmark", *flags]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)


def test_table_of_engines(tmp_path):
    result = benchmark(
        "--sections=engines",
        "--envs=half_cheetah",
        "--num_envs=2",
        "--nomjx",
        "--seconds=0",
        "--repeats=1",
        "--record=records.jsonl",
        folder=tmp_path,
    )
    assert result.returncode == 0, result.stderr
    rows = [line for line in result.stdout.splitlines() if line.startswith("| half_cheetah")]
    assert [row.split("|")[3].strip() for row in rows] == [
        "mujoco.batch, Python loop",
        "mujoco, jit(scan)",
        "mujoco, jit(scan), episodes",
        "gymnasium.make_vec, sync",
    ]
    assert len({len(row) for row in rows}) == 1
    assert "Machine: " in result.stdout and "Peak resident memory" in result.stdout
    assert "WARNING" not in result.stderr
    assert len((tmp_path / "records.jsonl").read_text().splitlines()) == 2 * len(rows)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--sections=engine", "error: unknown section 'engine': did you mean engines?"),
        ("--num_envs=0", "error: --num_envs: expected positive integers, found '0'"),
    ],
)
def test_bad_flags_are_one_line(tmp_path, flag, message):
    result = benchmark(flag, folder=tmp_path)
    assert result.returncode == 2
    assert result.stderr.strip() == message
