"""Tables as Markdown, LaTeX and JSON."""

import json
from collections.abc import Sequence

from represent_jax.campaign.tables import Cell, to_grids, to_table
from represent_jax.errors import unknown
from represent_jax.report.tables import Table, to_text


def markdown(table: Table) -> str:
    """A Markdown table under its title."""
    lines = [table.columns, ("---", *["---:"] * (len(table.columns) - 1)), *table.rows]
    body = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"**{table.title}**\n\n{body}\n\n{table.note}".replace("+-", "\N{PLUS-MINUS SIGN}")


def latex(table: Table) -> str:
    """A LaTeX tabular of the booktabs package, with its caption."""
    rows = [" & ".join(_escape(cell) for cell in line) + r" \\" for line in table.rows]
    head = " & ".join(_escape(column) for column in table.columns) + r" \\"
    alignment = "ll" + "r" * (len(table.columns) - 2)
    return "\n".join(
        [
            r"\begin{table}",
            rf"\caption{{{_escape(table.title)}. {_escape(table.note)}}}",
            rf"\begin{{tabular}}{{{alignment}}}",
            r"\toprule",
            head,
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        ]
    )


def _escape(text: str) -> str:
    for character in "&%$#_":
        text = text.replace(character, f"\\{character}")
    return text.replace("^", r"\textasciicircum{}").replace("+-", r"$\pm$")


def _json(title: str, cells: Sequence[Cell]) -> str:
    lines = [cell._asdict() | {"found": cell.found._asdict()} for cell in cells]
    text = json.dumps({"title": title, "cells": lines}, indent=2)
    # A single seed has no spread; JSON has no NaN.
    return text.replace("NaN", "null")


FORMATS = {
    "text": lambda title, cells: to_text(to_table(title, cells)),
    "markdown": lambda title, cells: markdown(to_table(title, cells)),
    "grid": lambda title, cells: "\n\n".join(map(markdown, to_grids(title, cells))),
    "latex": lambda title, cells: latex(to_table(title, cells)),
    "json": _json,
}


def render(style: str, title: str, cells: Sequence[Cell]) -> str:
    """A table in one of the formats.

    Raises:
      UsageError: no format of that name.
    """
    if style not in FORMATS:
        raise unknown("format", style, FORMATS)
    return FORMATS[style](title, cells)
