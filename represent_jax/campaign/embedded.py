"""Tables inside a Markdown page, kept as the records have them.

A page says which table belongs where; what stands between the two comments is written anew:

    <!-- tables: --table=1,2 --preset=quick --format=grid -->
    <!-- end of tables -->
"""

import re
import shlex
from collections.abc import Iterable, Mapping
from typing import Any

from represent_jax.campaign import formats, tables
from represent_jax.errors import RepresentError, UsageError

_END = "<!-- end of tables -->"
_BLOCK = re.compile(rf"(<!-- tables:(.*?)-->\n)(.*?)({re.escape(_END)})", re.DOTALL)
_DEFAULTS = {"table": "", "preset": "paper", "format": "markdown"}


def update(page: str, records: Iterable[Mapping[str, Any]]) -> str:
    """Returns a page with every table in it as `records` have it.

    Raises:
      UsageError: a block asks for something that there is not, or the page has no block.
      RepresentError: a block does not end, or no record belongs to its table.
    """
    records = list(records)
    if page.count("<!-- tables:") != len(_BLOCK.findall(page)):
        raise RepresentError(f"a block of tables does not end: expected {_END!r} after it")
    if not _BLOCK.search(page):
        raise UsageError("no block of tables in the page: expected '<!-- tables: --table=... -->'")
    return _BLOCK.sub(lambda match: _block(match, records), page)


def _block(match: re.Match[str], records: list[Mapping[str, Any]]) -> str:
    asked = dict(_DEFAULTS)
    for word in shlex.split(match[2]):
        name, equals, value = word.removeprefix("--").partition("=")
        if name not in asked or not equals:
            expected = ", ".join(f"--{known}=..." for known in asked)
            raise UsageError(f"block of tables: expected {expected}, found {word!r}")
        asked[name] = value
    made = [tables.make(name, records, asked["preset"]) for name in asked["table"].split(",")]
    body = "\n\n".join(formats.render(asked["format"], *one) for one in made)
    return f"{match[1]}\n{body}\n\n{match[4]}"
