"""Writes a page that compares several runs: correlations, returns, curves, settings that differ.

python -m experiments.compare runs/a runs/b --out=comparison.html
python -m experiments.compare runs/a runs/b runs/c --open
"""

from absl import flags

from experiments import launch
from represent_jax.report import compare

_OUT = flags.DEFINE_string("out", "comparison.html", "Page to write.")
_OPEN = flags.DEFINE_bool("open", False, "Show the page in a browser.")


def main(argv: list[str]) -> None:
    page = compare.write_comparison(argv[1:], _OUT.value)
    print(f"comparison: {page}")
    if _OPEN.value:
        launch.open_page(page)


if __name__ == "__main__":
    launch.run(main)
