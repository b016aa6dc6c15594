"""Prints the paper's tables from records, beside the paper's own figures.

python -m experiments.tables --table=1 --preset=quick
python -m experiments.tables --table=2 --preset=quick --format=latex
python -m experiments.tables --update=README.md
"""

from pathlib import Path

from absl import flags

from experiments import launch
from represent_jax.campaign import embedded, formats, tables
from represent_jax.data.atomic import replacing
from represent_jax.errors import UsageError
from represent_jax.runs.records import read_records

_TABLE = flags.DEFINE_list("table", ["1"], f"Of {', '.join(tables.TABLES)}.")
_RECORDS = flags.DEFINE_string("records", "results/records.jsonl", "File of records.")
_PRESET = flags.DEFINE_string(
    "preset",
    "paper",
    "Of the records to take; paper_one_phase_1 where Phase 1 was shared.",
)
_FORMAT = flags.DEFINE_string("format", "text", f"One of {', '.join(formats.FORMATS)}.")
_METHODS = flags.DEFINE_list(
    "methods", [], "Of your own, recorded with `--record`, to show beside those of the table."
)
_UPDATE = flags.DEFINE_string(
    "update", None, "Markdown page whose tables are written anew; its comments say which."
)


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    records = read_records(_RECORDS.value)
    if not records:
        raise UsageError(f"{_RECORDS.value}: no records there")
    if _UPDATE.value:
        launch.refuse_beside("with --update", ("table", "preset", "format", "methods"))
        _update(Path(_UPDATE.value), records)
        return
    shown = [tables.make(name, records, _PRESET.value, _METHODS.value) for name in _TABLE.value]
    print("\n\n".join(formats.render(_FORMAT.value, *one) for one in shown))


def _update(page: Path, records: list[dict]) -> None:
    if not page.is_file():
        raise UsageError(f"--update: {page} is no file")
    before = page.read_text()
    after = embedded.update(before, records)
    if after == before:
        print(f"{page}: as the records have it")
        return
    with replacing(page) as temporary:
        temporary.write_text(after)
    print(f"{page}: tables written anew")


if __name__ == "__main__":
    launch.run(main)
