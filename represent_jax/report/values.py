"""Numbers and names as a reader sees them."""

import math

import numpy as np

METHOD_NAMES = {
    "represent": "REPRESENT",
    "ssrr": "SSRR",
    "msrd": "MSRD",
    "drex": "D-REX",
    "noisy_airl": "Noisy-AIRL",
    "airl": "AIRL",
    "bc": "BC",
    "bc_rnn": "BC-RNN",
}


def display_name(target: str) -> str:
    """Returns "Task" or "Strategy 1" for the target "task" or "strategy_1"."""
    return target.replace("_", " ").capitalize()


def format_number(value: float | None, digits: int | None = None) -> str:
    """Returns the number with as many decimals as a reader needs, a dash for none or NaN.

    Args:
        value: the number.
        digits: decimals; by default none from 1000 on, one from 10 on and three below.
    """
    if value is None or not math.isfinite(value):
        return "-"
    if digits is None:
        digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 3
    return f"{value:,.{digits}f}"


def format_correlation(value: float) -> str:
    """Returns the correlation with two digits, three very close to one, a dash if undefined."""
    if not np.isfinite(value):
        return "\N{EN DASH}"
    return f"{value:.3f}" if abs(value) >= 0.995 else f"{value:.2f}"


def pearson(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the correlation of a [n] and b [n], NaN where it is not defined."""
    finite = np.isfinite(a) & np.isfinite(b)
    a, b = np.asarray(a, np.float64)[finite], np.asarray(b, np.float64)[finite]
    if a.size < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])


def format_duration(seconds: float) -> str:
    """Returns seconds as "12 s", "3 min 20 s" or "2 h 05 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
