"""What a run takes: seconds of each stage, and memory."""

import resource
import time
from typing import Any

from represent_jax.runs import RunDirectory


class Clock:
    """Seconds spent in each stage, kept across restarts in the run's log.

    What a killed process spent in the stage that it was in is not known, and left out.
    """

    def __init__(self, directory: RunDirectory):
        self._directory = directory
        self.seconds: dict[str, float] = {}
        for line in directory.read_log("clock"):
            self._add(line)

    def _add(self, line: dict[str, Any]) -> None:
        name = line["name"]
        self.seconds[name] = round(self.seconds.get(name, 0.0) + line["seconds"], 1)

    def __call__(self, name: str) -> "Clock":
        self._name = name
        return self

    def __enter__(self) -> None:
        self._start = time.monotonic()

    def __exit__(self, *exception: object) -> None:
        line = {"name": self._name, "seconds": time.monotonic() - self._start}
        self._directory.log("clock", 0, line)
        self._add(line)

    def finish(self, results: dict[str, Any]) -> dict[str, Any]:
        """Adds seconds and peak memory to the results of a run and writes them."""
        results["seconds"] = self.seconds
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        results["peak_memory_gib"] = round(peak / 2**20, 2)
        self._directory.write_results(results)
        return results
