"""Runs the Python of a page of the documentation."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def run_page(name):
    """Executes a page's Python blocks in order, in one namespace, and returns that."""
    text = (DOCS / name).read_text()
    namespace = {"__name__": name}
    for block in re.finditer(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        lines_before = text[: block.start(1)].count("\n")
        exec(compile("\n" * lines_before + block[1], str(DOCS / name), "exec"), namespace)
    return namespace
