"""Prints the paper's tables from records, beside the paper's own figures.

python -m experiments.tables --table=1
python -m experiments.tables --table=2 --preset=quick --format=latex
"""

from absl import flags

from experiments import launch
from represent_jax.campaign import formats, tables
from represent_jax.errors import UsageError
from represent_jax.runs.records import read_records

_TABLE = flags.DEFINE_list("table", ["1"], f"Of {', '.join(tables.TABLES)}.")
_RECORDS = flags.DEFINE_string("records", "results/records.jsonl", "File of records.")
_PRESET = flags.DEFINE_string("preset", "paper", "Preset whose records to take.")
_FORMAT = flags.DEFINE_string("format", "text", f"One of {', '.join(formats.FORMATS)}.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    records = read_records(_RECORDS.value)
    if not records:
        raise UsageError(f"{_RECORDS.value}: no records there")
    shown = [tables.make(name, records, _PRESET.value) for name in _TABLE.value]
    print("\n\n".join(formats.render(_FORMAT.value, *one) for one in shown))


if __name__ == "__main__":
    launch.run(main)
