"""Starts `experiments.represent` with tiny budgets, and reads what it leaves behind."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def launch(out, *flags, cache=None):
    """Starts the launcher; `cache` keeps compiled programs (those with host callbacks never)."""
    command = [sys.executable, "-m", "experiments.represent", "--preset=smoke", f"--out={out}"]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
    return subprocess.Popen(
        [*command, *flags],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process):
    """Waits for the launcher's end, which has to be a good one, and returns what it printed."""
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output
    return output


def results_of(run):
    """What a run found, without what may differ between two runs of it."""
    results = json.loads((run / "results.json").read_text())
    return {k: v for k, v in results.items() if k not in ("seconds", "peak_memory_gib")}


def log_of(run):
    """What a run logged, line by line."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
