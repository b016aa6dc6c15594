"""Progress on standard error: a bar on a terminal, now and then a line elsewhere."""

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import Protocol

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 10.0


class Progress(Protocol):
    """What `progress` hands out."""

    def update(self, num: int, note: str = "") -> None:
        """Counts `num` more units, and shows a note beside them."""


@contextlib.contextmanager
def progress(title: str, total: int, unit: str, initial: int = 0) -> Iterator[Progress]:
    """Shows how far a task is, its rate and the time left, from before its first unit.

    Args:
        title: name of the task.
        total: number of units in all.
        unit: name of the units, in plural, for example "env steps".
        initial: number of units that were done before.
    """
    kind = _Bar if sys.stderr.isatty() else _Lines
    shown = kind(title, total, unit, initial)
    try:
        yield shown
    finally:
        shown.close()


class _Bar:
    def __init__(self, title: str, total: int, unit: str, initial: int):
        self._bar = tqdm(
            desc=title,
            total=total,
            initial=initial,
            unit=f" {unit}",
            unit_scale=True,
            dynamic_ncols=True,
            file=sys.stderr,
        )

    def update(self, num: int, note: str = "") -> None:
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(num)

    def close(self) -> None:
        self._bar.close()


class _Lines:
    def __init__(self, title: str, total: int, unit: str, initial: int):
        self._title, self._total, self._unit = title, total, unit
        self._done = initial
        self._note = ""
        self._rate_from: tuple[float, int] | None = None
        self._print()

    def update(self, num: int, note: str = "") -> None:
        self._done += num
        self._note = note
        if self._rate_from is None:
            # The first units wait for compilation, and tell nothing about the rate.
            self._rate_from = (time.monotonic(), self._done)
        if time.monotonic() - self._printed_at >= SECONDS_BETWEEN_LINES:
            self._print()

    def close(self) -> None:
        if self._printed_done != self._done:
            self._print()

    def _print(self) -> None:
        now = time.monotonic()
        parts = [
            f"{self._title}: {self._done:,} of {self._total:,} {self._unit} "
            f"({self._done / max(self._total, 1):.0%})"
        ]
        if self._rate_from is not None and now > self._rate_from[0]:
            rate = (self._done - self._rate_from[1]) / (now - self._rate_from[0])
            if rate > 0:
                left = tqdm.format_interval((self._total - self._done) / rate)
                parts.append(f"{tqdm.format_sizeof(rate)}/s, {left} left")
        if self._note:
            parts.append(self._note)
        print(", ".join(parts), file=sys.stderr, flush=True)
        self._printed_at, self._printed_done = now, self._done
