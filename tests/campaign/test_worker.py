"""Stages made elsewhere from a recipe: found by their hash, or refused."""

import dataclasses

import pytest

from represent_jax.campaign.entries import Recipe, make_entry
from represent_jax.campaign.worker import Order, attempts, work
from represent_jax.runs import provenance
from represent_jax.runs.graph import Graph
from represent_jax.runs.parcel import pack, unpack

RECIPE = Recipe("bc", "inverted_double_pendulum", "smoke", ("seed=3",), ("policy_evaluation",))


@pytest.fixture(scope="module")
def order():
    (report,) = make_entry(RECIPE).reports.values()
    return Order(RECIPE, report.inputs[0].hash, None, provenance()["commit"])


def test_a_stage_comes_back_as_a_folder(order, tmp_path):
    outcome = work(order, {})
    assert outcome.error is None
    unpack(outcome.parcel, tmp_path / order.node)
    graph = Graph(make_entry(RECIPE).reports.values(), tmp_path)
    first, last = graph.nodes
    assert graph.is_done(first) and not graph.is_done(last)
    assert len(attempts(tmp_path / order.node)) == 1
    # It is enough to go on from, here as well as elsewhere.
    behind = dataclasses.replace(order, node=last.hash)
    assert work(behind, {first.hash: pack(tmp_path / first.hash)}).error is None


def test_a_stage_whose_inputs_are_not_there_is_refused(order):
    (report,) = make_entry(RECIPE).reports.values()
    outcome = work(dataclasses.replace(order, node=report.hash), {})
    assert "bc seed 3 bc is not done there" in outcome.error


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"node": "0" * 16}, "has no stage 0000"),
        ({"commit": "0" * 12}, "the campaign's of 0000"),
        ({"folder": "/nonexistent"}, "is it on a shared file system"),
    ],
)
def test_what_does_not_fit_is_refused(order, changed, message):
    if changed.get("commit") and order.commit == "unknown":
        pytest.skip("no checkout")
    outcome = work(dataclasses.replace(order, **changed), {})
    assert message in outcome.error and "on " in outcome.error


def test_the_mark_is_packed_last(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "done.json").write_text("{}")
    (tmp_path / "a" / "b" / "z.npz").write_bytes(b"123")
    parcel = pack(tmp_path / "a")
    assert parcel.index(b"b/z.npz") < parcel.index(b"done.json")
    unpack(parcel, tmp_path / "c")
    assert (tmp_path / "c" / "b" / "z.npz").read_bytes() == b"123"
