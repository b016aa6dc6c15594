"""Populations on eight devices, and on two processes, against the same on one device."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).with_name("sharded.py")
SIZES = ("regression:8", "regression:9")


def _start(out, *arguments, devices=1):
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    out.mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, SCRIPT, out, *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _finish(*processes):
    try:
        for process in processes:
            output, _ = process.communicate(timeout=600)
            assert process.returncode == 0, output
    finally:
        for process in processes:
            process.kill()


def _free_address():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def _assert_same(folder, other, name):
    """Programs of other batch sizes round otherwise: a few units in the last place."""
    with np.load(folder / f"{name}.npz") as ours, np.load(other / f"{name}.npz") as theirs:
        assert set(ours) == set(theirs)
        for key in set(ours) - {"devices", "copies"}:
            np.testing.assert_allclose(ours[key], theirs[key], rtol=1e-4, atol=1e-5, err_msg=key)
        assert not np.array_equal(ours["state/0"][0], ours["state/0"][-1])
        return ours["devices"], ours["copies"]


@pytest.fixture(scope="module")
def one_device(tmp_path_factory):
    out = tmp_path_factory.mktemp("one")
    _finish(_start(out, *SIZES, "airl:8"))
    return out


@pytest.fixture(scope="module")
def eight_devices(tmp_path_factory):
    out = tmp_path_factory.mktemp("eight")
    _finish(_start(out, *SIZES, "airl:8", devices=8))
    return out


@pytest.mark.parametrize(("name", "num_devices"), [("regression:8", 8), ("regression:9", 3)])
def test_members_are_spread_over_as_many_devices_as_divide_them(
    one_device, eight_devices, name, num_devices
):
    devices, copies = _assert_same(eight_devices, one_device, name)
    assert set(devices) == {num_devices} and not copies.any()


def test_simulated_members_and_their_shared_counters_are_spread(one_device, eight_devices):
    devices, copies = _assert_same(eight_devices, one_device, "airl:8")
    # Counters that members share are on every device.
    assert set(devices) == {8} and 0 < copies.sum() < 10


def test_two_processes_share_the_members_or_each_have_all(one_device, tmp_path):
    address = _free_address()
    outs = [tmp_path / "0", tmp_path / "1"]
    _finish(*(_start(out, *SIZES, "--", address, "2", str(i)) for i, out in enumerate(outs)))
    for out in outs:
        for name, num_devices in zip(SIZES, (2, 1), strict=True):
            devices, _ = _assert_same(out, one_device, name)
            assert set(devices) == {num_devices}


def _launch(out, *flags):
    command = [sys.executable, "-m", "experiments.represent", "--method=bc", "--preset=smoke"]
    return subprocess.Popen(
        [*command, "--env=inverted_double_pendulum", f"--out={out}", *flags],
        cwd=ROOT,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_of_two_processes_of_a_run_the_first_writes(tmp_path):
    address = f"--coordinator={_free_address()}"
    flags = ("--distributed", "--num_processes=2", address)
    _finish(*(_launch(tmp_path / "two", *flags, f"--process={i}") for i in range(2)))
    _finish(_launch(tmp_path / "one"))
    logs = []
    for name in ("one", "two"):
        lines = (tmp_path / name / "metrics.jsonl").read_text().splitlines()
        told = [json.loads(line) for line in lines]
        logs.append([line | {"time": 0} for line in told if line["stage"] != "clock"])
    assert logs[0] == logs[1]
    results = [
        json.loads((tmp_path / name / "results.json").read_text()) for name in ("one", "two")
    ]
    measured = ("seconds", "peak_memory_gib")
    for key in set(results[0]) - set(measured):
        assert results[0][key] == results[1][key], key
    assert (tmp_path / "two" / "report.html").exists()
