import json
import multiprocessing
import subprocess

import numpy as np
import pytest

from represent_jax import runs
from represent_jax.errors import RepresentError, UsageError
from represent_jax.runs import records


def fields(**changes):
    values = {
        "domain": "cart",
        "method": "represent",
        "target": "strategy_1",
        "quantity": "pearson_test",
        "seed": 0,
        "value": 0.93,
        "preset": "smoke",
        "config_hash": "0123456789ab",
        "backend": "mjx",
        "seconds": 12.5,
    }
    return values | changes


def test_append_and_read(tmp_path):
    path = tmp_path / "results" / "records.jsonl"
    assert runs.read_records(path) == []
    runs.append_record(path, **fields())
    runs.append_record(path, **fields(seed=1, value=np.float32(0.5)))
    runs.append_record(path, **fields(seed=2, value=np.nan, commit="abc"))
    everything = runs.read_records(path)
    assert [tuple(record) for record in everything] == [records.FIELDS] * 3
    assert [record["value"] for record in everything] == [0.93, 0.5, None]
    assert everything[0]["versions"]["jax"]
    assert everything[2]["commit"] == "abc"
    assert runs.read_records(path, seed=1, target="strategy_1") == [everything[1]]
    assert runs.read_records(path, domain="pole") == []


def test_bad_records(tmp_path):
    path = tmp_path / "records.jsonl"
    with pytest.raises(UsageError, match="unknown field of a record 'sed': did you mean seed"):
        runs.append_record(path, **fields(sed=1))
    with pytest.raises(UsageError, match="a record needs domain, method"):
        runs.append_record(path, seed=0)
    with pytest.raises(UsageError, match="unknown field of a record 'sed'"):
        runs.read_records(path, sed=1)
    runs.append_record(path, **fields())
    with open(path, "a") as file:
        file.write('{"domain": ')
    with pytest.raises(RepresentError, match=r"records.jsonl: line 2 is no record"):
        runs.read_records(path)


def test_lines_of_several_processes_stay_whole(tmp_path):
    path = tmp_path / "records.jsonl"
    given = fields(commit="c" * 20_000, device="d", versions={})
    context = multiprocessing.get_context("spawn")
    writers = [
        context.Process(target=append_many, args=(path, given | {"seed": seed}))
        for seed in range(2)
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [w.exitcode for w in writers] == [0, 0]
    assert sorted(record["seed"] for record in runs.read_records(path)) == [0] * 20 + [1] * 20


def append_many(path, given):
    for _ in range(20):
        runs.append_record(path, **given)


def test_provenance():
    found = runs.provenance()
    json.dumps(found)
    assert found["device"]
    assert {"python", "jax", "numpy"} <= set(found["versions"])


def test_commit_of_a_checkout(tmp_path, monkeypatch):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
        subprocess.run(
            ["git", *identity, *arguments], cwd=tmp_path, check=True, capture_output=True
        )

    code = tmp_path / "represent_jax" / "runs" / "records.py"
    code.parent.mkdir(parents=True)
    code.write_text("")
    monkeypatch.setattr(records, "__file__", str(code))
    assert records._commit() == "unknown"
    git("init")
    assert records._commit() == "unknown"
    git("add", ".")
    git("commit", "-m", "first")
    commit = records._commit()
    assert len(commit) == 12 and not commit.endswith("-dirty")
    (tmp_path / "records.jsonl").write_text("")
    assert records._commit() == commit
    code.write_text("x = 1")
    assert records._commit() == f"{commit}-dirty"


def test_results_are_recorded_with_the_commit_they_were_found_with(tmp_path):
    results = {
        "env": "hopper",
        "seed": 0,
        "preset": "smoke",
        "backend": "mujoco",
        "seconds": {"policies": 2.0},
        "demonstrators": [{"name": "strategy_1", "return_mean": 3.0}],
    }
    path = tmp_path / "records.jsonl"
    records.append_results(path, "represent", "hash", results | {"commit": "earlier"})
    records.append_results(path, "represent", "hash", results)
    found = runs.read_records(path)
    assert [one["commit"] for one in found] == ["earlier", runs.provenance()["commit"]]
    assert found[0]["device"] == runs.provenance()["device"]


def test_only_what_is_new_is_recorded_and_a_return_to_earlier_settings_is_new(tmp_path):
    path = tmp_path / "records.jsonl"

    def append(config_hash, value):
        results = {
            **{"env": "hopper", "seed": 0, "preset": "smoke", "backend": "mujoco"},
            "seconds": {"policies": 2.0},
            "demonstrators": [{"name": "strategy_1", "return_mean": value}],
        }
        records.append_results(path, "represent", config_hash, results, only_new=True)
        return len(runs.read_records(path))

    assert append("a", 3.0) == 1 and append("a", 3.0) == 1
    assert append("b", 4.0) == 2
    # The last line is what tables show.
    assert append("a", 3.0) == 3 and append("a", 3.0) == 3
    assert append("a", 5.0) == 4
    assert append("a", float("nan")) == 5 and append("a", float("nan")) == 5
