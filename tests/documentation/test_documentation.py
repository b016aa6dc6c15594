"""Every code block of the documentation runs; see `blocks` for what that means."""

import shutil

import blocks
import numpy as np
import pytest

import represent_jax as rj
from represent_jax.campaign import embedded
from represent_jax.envs import registry
from represent_jax.methods import registry as methods
from represent_jax.runs.records import read_records

DOCS = blocks.ROOT / "docs"

# Run by tests of their own, which have the libraries that they need.
ELSEWHERE = {"train_elsewhere.md"}

PAGES = sorted(DOCS.rglob("*.md"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder as a reader has it after the first run of the documentation, at smoke size."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "results").symlink_to(blocks.ROOT / "results")
    words = next(
        w
        for b in blocks.blocks_of(DOCS / "index.md")
        for w in blocks.commands(b)
        if w[:3] == ["python", "-m", "experiments.represent"]
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setitem(blocks.SMALL, "represent", ["--preset=smoke"])
        assert blocks.run_command(words) == "runs/demo"
    assert (folder / "runs" / "demo" / "report.html").is_file()
    return folder


@pytest.fixture(autouse=True)
def reader(monkeypatch, request):
    """In the reader's folder; environments and methods of a page are forgotten after it."""
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    monkeypatch.setattr(methods, "METHODS", dict(methods.METHODS))
    if "folder" in request.fixturenames:
        monkeypatch.chdir(request.getfixturevalue("folder"))


def run_page(path, folder, namespace=None):
    namespace = {"__name__": path.stem, **(namespace or {})}
    for block in blocks.blocks_of(path):
        assert block.language in blocks.LANGUAGES, f"{path}: nothing runs {block.language!r}"
        if block.language == "python":
            blocks.run_python(block, path, namespace)
        elif block.language == "bash":
            for words in blocks.commands(block):
                out = blocks.run_command(words)
                if words[2:3] == ["experiments.represent"] and out and not (folder / out).exists():
                    # What comes after reads that run; the first one stands in for it.
                    shutil.copytree(folder / "runs" / "demo", folder / out)
        elif block.language != "text":
            for words in blocks.commands(block):
                blocks.run_command(words, parse_only=True)
    return namespace


@pytest.mark.parametrize("path", PAGES, ids=[str(page.relative_to(DOCS)) for page in PAGES])
def test_page(path, folder):
    if path.name in ELSEWHERE:
        pytest.skip("has a test of its own")
    run_page(path, folder)


def test_readme(folder):
    rows = rj.load_demonstrations("half_cheetah").trajectories[0]
    given = {"obs_t": rows.obs[:-1], "action_t": rows.actions, "next_obs_t": rows.obs[1:]}
    found = run_page(blocks.ROOT / "README.md", folder, given | {"obs": rows.obs})
    assert found["r"].shape == (rows.length,)
    assert np.isfinite(found["r"]).all() and found["action"].shape == (rows.length + 1, 6)


def test_tables_in_readme_are_those_of_the_records():
    page = (blocks.ROOT / "README.md").read_text()
    assert embedded.update(page, read_records(blocks.ROOT / "results" / "records.jsonl")) == page


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("python -m experiments.represent --presset=quick", "presset"),
        ("python -m experiments.represent --override polices.env_steps=1", "did you mean"),
        ("python -m experiments.represent --until=regresion", "regresion"),
        ("python -m experiments.campaign --tables=17", "17"),
        ("make dmeo", "dmeo"),
        ("curl example.org", "curl"),
    ],
)
def test_a_wrong_command_is_noticed(command, complaint):
    with pytest.raises(Exception, match=complaint):
        blocks.run_command(command.split())
