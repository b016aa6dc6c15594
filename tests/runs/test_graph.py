"""Graphs of stages: order, sharing, resuming, failing."""

import pytest

from represent_jax.errors import RepresentError
from represent_jax.runs.graph import BLOCKED, DONE, FAILED, Graph, Node


def _quiet(graph, node, state):
    pass


class Arithmetic:
    """Nodes that add a number to their inputs and count how often they really work."""

    def __init__(self):
        self.worked = []

    def node(self, name, number, *inputs, fails=False):
        def run(directory, *values):
            file = directory.path / "value"
            if not file.exists():
                self.worked.append(name)
                if fails:
                    raise RepresentError("it broke")
                file.write_text(str(number + sum(values)))
            return int(file.read_text())

        return Node("add", name, {"number": number}, inputs, run)


def test_inputs_run_first_and_shared_nodes_once(tmp_path):
    work = Arithmetic()
    root = work.node("root", 1)
    left, right = work.node("left", 10, root), work.node("right", 20, root)
    top = work.node("top", 100, left, right)
    graph = Graph([top, right], tmp_path)
    graph.run(_quiet)
    assert work.worked == ["root", "left", "right", "top"]
    assert graph.output(top) == 100 + (10 + 1) + (20 + 1)
    assert set(graph.states.values()) == {DONE}


def test_a_second_graph_runs_only_what_is_new(tmp_path):
    work = Arithmetic()
    root = work.node("root", 1)
    Graph([work.node("a", 2, root)], tmp_path).run(_quiet)
    again = Graph([work.node("a", 2, root), work.node("b", 3, root)], tmp_path)
    assert [node.name for node in again.left] == ["b"]
    assert again.seconds_left() is not None
    again.run(_quiet)
    assert work.worked == ["root", "a", "b"]


def test_the_hash_sees_settings_and_inputs_but_not_names():
    work = Arithmetic()
    node = work.node("a", 1)
    assert work.node("renamed", 1).hash == node.hash
    assert work.node("a", 2).hash != node.hash
    assert work.node("a", 1, node).hash != node.hash


def test_a_failure_blocks_what_lies_behind_it_and_nothing_else(tmp_path):
    work = Arithmetic()
    broken = work.node("broken", 1, fails=True)
    behind, beside = work.node("behind", 2, broken), work.node("beside", 3)
    graph = Graph([behind, beside], tmp_path)
    seen = []
    graph.run(lambda graph, node, state: seen.append((node.name, state)))
    assert graph.states == {broken.hash: FAILED, behind.hash: BLOCKED, beside.hash: DONE}
    assert graph.errors[broken.hash] == "RepresentError: it broke"
    assert ("beside", "running") in seen and ("behind", "running") not in seen
    with pytest.raises(RepresentError, match="behind"):
        graph.output(behind)
    # What failed is tried again by the next graph.
    assert [node.name for node in Graph([behind, beside], tmp_path).left] == ["broken", "behind"]


def test_a_fault_of_the_program_leaves_its_traceback_until_the_stage_is_done(tmp_path):
    faulty = [True]

    def run(directory):
        return {}["absent"] if faulty else 3

    node = Node("adder", "faulty", {}, (), run)
    graph = Graph([node], tmp_path)
    graph.run(_quiet)
    assert graph.errors[node.hash] == f"KeyError: 'absent' (see {node.hash}/traceback.txt)"
    kept = tmp_path / node.hash / "traceback.txt"
    assert 'return {}["absent"]' in kept.read_text()
    faulty.clear()
    again = Graph([node], tmp_path)
    again.run(_quiet)
    assert again.output(node) == 3 and not kept.exists()


def test_time_left_is_unknown_until_every_kind_has_run(tmp_path):
    work = Arithmetic()
    assert Graph([work.node("a", 1)], tmp_path).seconds_left() is None
