"""Errors a person can act on: one line that names the thing, and an exit code."""

import difflib
from collections.abc import Iterable


class RepresentError(Exception):
    """Something in the data, on the disk or in the computation is not as it has to be.

    Attributes:
        exit_code: what a launcher returns to the shell, 1.
    """

    exit_code = 1


class UsageError(RepresentError):
    """What was asked for cannot be done as it was asked.

    Attributes:
        exit_code: what a launcher returns to the shell, 2.
    """

    exit_code = 2


class SettingError(UsageError):
    """A setting is not as it has to be.

    Attributes:
        field: its name, dotted as far as is known where the error is raised.
        complaint: what it has to be and what it is.
    """

    def __init__(self, field: str, complaint: str):
        super().__init__(f"{field}: {complaint}")
        self.field = field
        self.complaint = complaint


def unknown(kind: str, name: str, known: Iterable[str]) -> UsageError:
    """Returns the error for a name that is not among the known ones, with the nearest that are.

    Args:
        kind: what the name stands for, for example "environment".
        name: the name that was given.
        known: every name that would do; dotted names are also found by their last part.
    """
    known = sorted(known)
    ends = difflib.get_close_matches(_last_part(name), {_last_part(other) for other in known})
    nearest = difflib.get_close_matches(name, known, n=2)
    nearest += [n for end in ends for n in known if _last_part(n) == end and n not in nearest]
    nearest = nearest[:4]
    if nearest:
        hint = f"did you mean {' or '.join(nearest)}?"
    else:
        hint = f"known are {', '.join(known[:20])}{', ...' if len(known) > 20 else ''}"
    return UsageError(f"unknown {kind} {name!r}: {hint}")


def _last_part(name: str) -> str:
    return name.rpartition(".")[2]
