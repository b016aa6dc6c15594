"""Weights & Biases: only where it is asked for, and the same scalars as the event files."""

import json
import struct
import sys

import pytest

from represent_jax.errors import RepresentError
from represent_jax.runs import open_run
from represent_jax.runs.graph import Graph, Node
from represent_jax.runs.tracking import WandbTracker


class Recorder:
    """A tracker that keeps what it takes."""

    def __init__(self):
        self.lines, self.closed = [], 0

    def write(self, stage, step, scalars):
        self.lines.append((stage, step, dict(scalars)))

    def close(self):
        self.closed += 1


def test_a_tracker_takes_the_scalars_that_a_run_logs(tmp_path):
    recorder = Recorder()
    with open_run(tmp_path / "run", {"a": 1}, tracker=recorder) as run:
        run.log("airl", 8, {"loss": 0.5, "returns": [1.0, float("nan")], "note": "text"})
    assert recorder.lines == [("airl", 8, {"loss": 0.5, "returns/0": 1.0})]
    assert recorder.closed == 1


def test_every_stage_of_a_graph_has_a_tracker_that_is_closed(tmp_path):
    recorders = {}

    def track(node, folder):
        assert folder == tmp_path / node.hash
        return recorders.setdefault(node.name, Recorder())

    def run(directory, *inputs):
        if not directory.has_findings("x"):
            directory.log("x", 1, {"value": len(inputs)})
            directory.save_findings("x", {})

    first = Node("x", "first", {}, (), run)
    graph = Graph([Node("x", "second", {}, (first,), run)], tmp_path, track)
    graph.run(lambda *_: None)
    assert {name: one.lines for name, one in recorders.items()} == {
        "first": [("x", 1, {"value": 0.0})],
        "second": [("x", 1, {"value": 1.0})],
    }
    assert all(one.closed == 1 for one in recorders.values())


def test_without_the_package_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(RepresentError, match=r"represent_jax\[wandb\]"):
        WandbTracker("project", tmp_path, "name", {})


def test_scalars_reach_an_offline_log_and_a_resumed_run_keeps_its_id(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    for step in (8, 16):
        tracker = WandbTracker("project", tmp_path / "run", "name", {"seed": 3})
        with open_run(tmp_path / "run", {"a": 1}, resume=True, tracker=tracker) as run:
            run.log("airl", step, {"loss": 0.25, "returns": [1.0, 2.0]})
    logs = sorted((tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb"))
    assert [{**line} for log in logs for line in history(log)] == [
        {"airl/loss": 0.25, "airl/returns/0": 1.0, "airl/returns/1": 2.0, "airl/step": step}
        for step in (8, 16)
    ]
    assert len({log.name for log in logs}) == 1


def history(path):
    """Yields what an offline log holds, a dictionary a step, without W&B's own entries."""
    from wandb.proto import wandb_internal_pb2

    for data in level_db_log(path.read_bytes()[7:]):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        if record.HasField("history"):
            items = {
                item.key or "/".join(item.nested_key): json.loads(item.value_json)
                for item in record.history.item
            }
            yield {key: value for key, value in items.items() if not key.startswith("_")}


def level_db_log(log, block_size=32768, header_size=7):
    """Yields the records of a LevelDB log; its file begins with 7 bytes that are W&B's own."""
    place, parts = header_size, []
    log = bytes(header_size) + log
    while place + header_size <= len(log):
        left = block_size - place % block_size
        if left < header_size:
            place += left
            continue
        length, kind = struct.unpack("<HB", log[place + 4 : place + header_size])
        parts.append(log[place + header_size : place + header_size + length])
        place += header_size + length
        if kind in (1, 4):  # Whole, or the last part.
            yield b"".join(parts)
            parts = []
