"""A campaign on Ray: lost workers, failing stages, no shared folder; the local engine's records."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("ray")
pytestmark = pytest.mark.extras

ROOT = Path(__file__).parents[2]
TINY = (
    "--preset=smoke",
    "--domains=inverted_double_pendulum",
    "--seeds=1",
    "--tables=2",
    "--variants=bc,bc_rnn",
)


def _start(out, *flags):
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.campaign", *TINY, f"--out={out}", *flags],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _finish(process):
    output, _ = process.communicate(timeout=600)
    return process.returncode, output


def _records(out):
    """Everything that was recorded but for the time it took."""
    records = [json.loads(line) for line in (out / "records.jsonl").read_text().splitlines()]
    told = [json.dumps(record | {"seconds": None}, sort_keys=True) for record in records]
    return sorted(told)


def _attempts(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    out = tmp_path_factory.mktemp("local")
    code, output = _finish(_start(out))
    assert code == 0, output
    return out


def test_a_killed_worker_is_replaced_and_the_records_are_the_local_ones(local, tmp_path):
    process = _start(tmp_path, "--engine=ray", "--address=local")
    deadline = time.monotonic() + 300
    begun = []
    while not begun and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
        begun = list(tmp_path.glob("*/attempts.jsonl"))
    assert begun and not (begun[0].parent / "done.json").exists()
    [attempt] = _attempts(begun[0])
    os.kill(attempt["pid"], signal.SIGKILL)
    code, output = _finish(process)
    assert code == 0, output
    pids = [attempt["pid"] for attempt in _attempts(begun[0])]
    assert len(set(pids)) == len(pids) == 2
    assert _records(tmp_path) == _records(local)
    done = {path.parent.name for path in tmp_path.glob("*/done.json")}
    assert done == {path.parent.name for path in local.glob("*/done.json")}


def test_without_a_shared_folder_a_failing_stage_blocks_no_other(local, tmp_path):
    flags = ("--engine=ray", "--noshared_folder", "--override=bc.learning_rate=1e30")
    code, output = _finish(_start(tmp_path, *flags))
    assert code == 1
    assert "bc seed 0 bc: failed" in output and "training diverged" in output
    assert "bc seed 0 policy_evaluation: blocked" in output
    expected = [record for record in _records(local) if '"bc_rnn"' in record]
    assert expected and _records(tmp_path) == expected


def test_no_cluster_at_the_address_is_one_line(tmp_path):
    code, output = _finish(_start(tmp_path, "--engine=ray", "--address=127.0.0.1:1"))
    assert code == 1
    assert "error: address 127.0.0.1:1: no Ray there" in output and "Traceback" not in output
