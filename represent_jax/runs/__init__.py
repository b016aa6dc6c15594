"""Run directories, checkpoints, records and the loop that fills them."""

from represent_jax.runs.directory import RunDirectory, load_config_json, open_run
from represent_jax.runs.loop import advance
from represent_jax.runs.records import append_record, provenance, read_records

__all__ = [
    "RunDirectory",
    "advance",
    "append_record",
    "load_config_json",
    "open_run",
    "provenance",
    "read_records",
]
