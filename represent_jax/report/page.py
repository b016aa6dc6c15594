"""What the pages are made of: a document with its style, tables, galleries of figures."""

import html
from collections.abc import Iterable, Mapping
from typing import Any

from matplotlib.figure import Figure

from represent_jax.report import figures
from represent_jax.report.tables import Table
from represent_jax.report.values import display_name

STYLE = """
:root { color-scheme: light; --ink: #1f2933; --muted: #5d6975; --line: #e3e7eb;
  --good: #1d7f46; --fair: #9a6700; --poor: #b42336; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f6f8; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
header p { margin: 0; color: var(--muted); font-size: .92rem; }
h1 { margin: .1rem 0 .6rem; font-size: clamp(1.6rem, 5vw, 2.3rem); line-height: 1.15;
  overflow-wrap: anywhere; }
h2 { margin: 0 0 .8rem; font-size: 1.2rem; }
.facts { display: flex; flex-wrap: wrap; gap: .4rem; margin: 0; padding: 0; list-style: none; }
.facts li { background: #fff; border: 1px solid var(--line); border-radius: 999px;
  padding: .12rem .75rem; font-size: .9rem; }
.facts span { color: var(--muted); }
.facts i { display: inline-block; width: 1.6em; height: .35em; border-radius: 2px;
  margin-right: .5em; vertical-align: middle; }
section, details { background: #fff; border: 1px solid var(--line); border-radius: 12px;
  padding: 1.2rem 1.2rem 1.1rem; margin-top: 1.1rem; }
.notice { background: #fff8e1; border: 1px solid #f0dca0; border-radius: 12px;
  padding: .7rem 1rem; margin: 1.1rem 0 0; }
.cards { display: grid; gap: .8rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 330px), 1fr)); }
.card { border: 1px solid var(--line); border-left: 5px solid; border-radius: 8px;
  padding: .75rem .9rem; }
.card h3 { display: flex; justify-content: space-between; align-items: start; gap: .6rem;
  margin: 0; font-size: 1rem; line-height: 1.3; }
.card b { border-radius: 999px; padding: .12rem .6rem; color: #fff; font-size: .78rem;
  font-weight: 600; }
.card p { margin: .4rem 0 .3rem; font-size: .94rem; }
.card ul { margin: 0; padding: 0; list-style: none; color: var(--muted); font-size: .86rem; }
.good { border-left-color: var(--good); } .good b { background: var(--good); }
.fair { border-left-color: var(--fair); } .fair b { background: var(--fair); }
.poor { border-left-color: var(--poor); } .poor b { background: var(--poor); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .95rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: .42rem .7rem; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--line); }
th:first-child { text-align: left; padding-left: 0; }
thead th { color: var(--muted); font-weight: 500; font-size: .88rem; }
tbody th { font-weight: 600; }
tbody tr:last-child > * { border-bottom: 0; }
.note { margin: .8rem 0 0; color: var(--muted); font-size: .9rem; max-width: 96ch; }
.note b { color: var(--ink); }
.gallery { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 310px), 1fr)); }
.gallery img { width: 100%; max-width: 460px; height: auto; display: block; margin: 0 auto; }
figure { margin: 0 0 1rem; }
figure video { width: 100%; display: block; border-radius: 8px; background: #000; }
figcaption { display: flex; margin-top: .35rem; font-size: .9rem; }
figcaption span { flex: 1; text-align: center; color: var(--muted); }
figcaption b { color: var(--ink); }
.times td:nth-child(2) { width: 1%; }
.times th { width: 1%; }
.times .bar { padding-right: 0; }
.bar i { display: block; height: .7rem; min-width: 2px; border-radius: 3px; background: #7f96b2; }
summary { cursor: pointer; font-weight: 600; }
details .scroll { margin-top: .8rem; }
.pairs { font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; font-size: .84rem; }
.pairs th, .pairs td { text-align: left; font-weight: 400; padding-left: 0; white-space: normal;
  overflow-wrap: anywhere; }
.pairs th { color: var(--muted); width: 45%; }
"""


def document(title: str, body: Iterable[str]) -> str:
    """Returns a page of its own from its sections; empty ones are left out."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in body if part)
        + "\n</main>\n</body>\n</html>\n"
    )


def table(shown: Table | None) -> str:
    """Returns a table as a section, and nothing for none."""
    if shown is None:
        return ""
    head = "".join(f"<th scope=col>{text(cell)}</th>" for cell in shown.columns)
    rows = "".join(
        f"<tr><th scope=row>{text(row[0])}</th>"
        + "".join(f"<td>{typeset(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in shown.rows
    )
    return (
        f"<section><h2>{text(shown.title)}</h2><div class=scroll><table><thead><tr>{head}</tr>"
        f"</thead><tbody>{rows}</tbody></table></div>"
        f"<p class=note>{text(shown.note)}</p></section>"
    )


def gallery(title: str, drawn: Mapping[str, Figure], note: str, what: str) -> str:
    """Returns figures side by side as a section; `what` they are is for those who cannot see."""
    if not drawn:
        return ""
    images = "".join(
        f'<img src="{figures.svg_data_uri(figure)}" '
        f'alt="{text(what)}: {text(display_name(target))}">'
        for target, figure in drawn.items()
    )
    return (
        f"<section><h2>{text(title)}</h2><div class=gallery>{images}</div>"
        f"<p class=note><b>How to read this.</b> {text(note)}</p></section>"
    )


def pairs(title: str, values: Mapping[str, Any]) -> str:
    """Returns names and values, folded away under a title."""
    rows = "".join(
        f"<tr><th scope=row>{text(key)}</th><td>{text(value)}</td></tr>"
        for key, value in values.items()
    )
    return (
        f"<details><summary>{text(title)}</summary>"
        f"<div class=scroll><table class=pairs><tbody>{rows}</tbody></table></div></details>"
    )


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested dictionaries as one, with dotted keys."""
    found = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found


def text(value: Any) -> str:
    """Returns a value as text that no page takes for HTML."""
    return html.escape(str(value))


def typeset(cell: str) -> str:
    """Returns a cell of the plain-text table with the signs that a page can show."""
    cell = cell.replace("+-", "\N{PLUS-MINUS SIGN}")
    if cell == "-":
        return "\N{EN DASH}"
    if cell.startswith("-"):
        cell = "\N{MINUS SIGN}" + cell[1:]
    if cell.endswith("x"):
        cell = cell[:-1] + "\N{MULTIPLICATION SIGN}"
    return text(cell)
