"""The code blocks of a page, and how each kind of them is run.

python        executed, all of a page in order and in one namespace
bash          every command is run by its launcher's own `main`, with SMALL's arguments appended
console, none commands that name what only a reader has: their flags are parsed
text          shown only
"""

import importlib
import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

from absl import flags
from absl.testing import flagsaver

from experiments import launch  # noqa: F401  (its flags stay when those of a launcher go)
from represent_jax.errors import RepresentError
from represent_jax.report import video

ROOT = Path(__file__).parents[2]
LANGUAGES = ("python", "bash", "console", "", "text")

# Last on a command line, these win: what a command would compute for hours is not computed.
SMALL = {
    "represent": ["--dry_run"],
    "campaign": ["--dry_run", "--seeds=1", "--domains=hopper"],
    "train_policy": [
        *("--env_steps=20", "--eval_env_steps=20", "--override=num_envs=4"),
        *("--override=hidden_sizes=8,8", "--override=unroll_length=5"),
        "--override=num_minibatches=2",
    ],
    "compare": ["--noopen"],
}


class Block(NamedTuple):
    """A fenced block: its language, its text, and the line of the page on which that begins."""

    language: str
    text: str
    line: int


def blocks_of(path):
    """Returns the fenced blocks of a page, in order."""
    page = path.read_text()
    found = re.finditer(r"^```(\w*)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    blocks = [Block(b[1], b[2], page.count("\n", 0, b.start(2))) for b in found]
    assert page.count("```") == 2 * len(blocks), f"{path}: a fence that is not understood"
    return blocks


def commands(block):
    """Returns the command lines of a block, each as words; beside bash, other lines are left out.

    What starts a launcher on a cluster (srun) is left out too.
    """
    lines = block.text.replace("\\\n", " ").splitlines()
    if block.language != "bash":
        lines = [line.removeprefix("srun ") for line in lines]
        lines = [line for line in lines if line.startswith(("python ", "make ", "pip "))]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def run_python(block, path, namespace):
    """Executes a block; tracebacks show the page."""
    code = "\n" * block.line + block.text
    exec(compile(code, str(path), "exec"), namespace)


def run_command(words, parse_only=False):
    """Runs one command of the documentation, or checks it where it is not Python's.

    Returns:
      The value of its flag `out`, None without one.
    """
    if words[0] == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(words[1:]) <= set(targets), f"no such target: {words}"
    elif words[:2] == ["pip", "install"]:
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        asked = re.findall(r"\[(.*?)\]", " ".join(words))
        known = extras["optional-dependencies"]
        assert all(extra in known for one in asked for extra in one.split(","))
    else:
        assert words[:2] == ["python", "-m"] and words[2].startswith("experiments."), words
        return _launch(words[2], words[3:], parse_only)
    return None


def _launch(module, arguments, parse_only):
    small = [] if parse_only else SMALL.get(module.rpartition(".")[2], [])
    sys.modules.pop(module, None)
    with flagsaver.flagsaver():
        launcher = importlib.import_module(module)
        try:
            rest = flags.FLAGS([module, *arguments, *small])
            if not parse_only and _possible(module):
                launcher.main(rest)
            return flags.FLAGS.out if "out" in flags.FLAGS else None
        finally:
            sys.modules.pop(module, None)


def _possible(module):
    if module != "experiments.play":
        return True
    try:
        video.check_available()
    except RepresentError:
        return False
    return True
