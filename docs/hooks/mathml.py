"""Turns the formulas of a page into MathML, which browsers show without a script."""

import html
import re

from latex2mathml.converter import convert

# What pymdownx.arithmatex leaves in its generic mode.
_FORMULA = re.compile(r'class="arithmatex">\\(?P<kind>[(\[])(?P<latex>.*?)\\[)\]]<', re.DOTALL)


def on_page_content(content: str, **_) -> str:
    """Called by MkDocs with the HTML of every page."""

    def mathml(match: re.Match) -> str:
        display = "inline" if match["kind"] == "(" else "block"
        return f'class="math">{convert(html.unescape(match["latex"]), display=display)}<'

    return _FORMULA.sub(mathml, content)
