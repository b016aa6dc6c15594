"""Tables of a run against its demonstrators, as plain text and for the page."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from represent_jax.report.values import display_name, format_number


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of text.

    Attributes:
        title: what it shows.
        columns: heads of the columns; the first column names the row.
        rows: the cells.
        note: how to read it, in a sentence or two.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str


_MISSING = {
    "actions": "The demonstrations hold no actions: imitation began from random policies and "
    "matched states alone.",
    "rewards": "The demonstrations hold no true rewards: nothing here is compared with the "
    "demonstrators. Rollouts and policies are judged by the environment's own reward.",
    "test": "There are no unseen trajectories: how far the rewards hold beyond what they were "
    "trained on is not judged.",
}


def missing(results: Mapping[str, Any]) -> list[str]:
    """Returns what the run was not given, a sentence each that says what follows from it."""
    return [text for what, text in _MISSING.items() if what in (results.get("missing") or ())]


def lengths(results: Mapping[str, Any]) -> list[str]:
    """Returns what there is to say of demonstrations whose length is not that of an episode."""
    said, short, cut = [], results.get("cut_short", 0), results.get("cut_off", 0)
    if short:
        said.append(
            f"{short} of {_num_demonstrations(results)} demonstrations stop before the horizon of "
            f"{results['horizon']} steps though nothing ended them: their returns are of fewer "
            "steps than those of the policies beside them."
        )
    if cut:
        said.append(
            f"{cut} of {_num_demonstrations(results)} demonstrations go on beyond the horizon of "
            f"{results['horizon']} steps, and were cut there: nothing was learned from what they "
            "came to later. The setting `horizon` makes episodes longer."
        )
    return said


def _num_demonstrations(results: Mapping[str, Any]) -> int:
    return sum(one["num"] for one in results["demonstrators"])


def targets(results: Mapping[str, Any]) -> list[str]:
    """Returns the names of the learned rewards: "task", "strategy_1", ..."""
    return list(results.get("targets") or ("task", *groups(results)))


def groups(results: Mapping[str, Any]) -> list[str]:
    """Returns the names of the groups of demonstrations: "strategy_1", ..., or "merged"."""
    return [one["name"] for one in results.get("demonstrators") or ()]


def demonstrator_levels(results: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Returns, by target, its demonstrators' mean true return and that of the best demonstrator."""
    returns = {one["name"]: one["return_mean"] for one in results.get("demonstrators") or ()}
    if not returns or any(value is None for value in returns.values()):
        return {}
    best = max(returns.values())
    levels = {"task": (sum(returns.values()) / len(returns), best)}
    return levels | {name: (value, best) for name, value in returns.items()}


def returns_table(results: Mapping[str, Any]) -> Table | None:
    """Returns the true returns of demonstrators, imitation and policies, or None without any."""
    demonstrators = results.get("demonstrators") or ()
    if not demonstrators:
        return None
    levels = demonstrator_levels(results)
    names = groups(results)
    imitation = results.get("airl") or ()
    policies = results.get("policies") or {}
    rows = []
    for target in targets(results):
        policy = policies.get(target) or {}
        index = names.index(target) if target in names else -1
        shown, imitated = format_number(levels.get(target, (None,))[0]), "-"
        if 0 <= index < len(demonstrators) and demonstrators[index].get("return_std") is not None:
            shown += f" +- {format_number(demonstrators[index]['return_std'])}"
        if 0 <= index < len(imitation):
            imitated = format_number(imitation[index].get("return"))
        ratio = policy.get("ratio_to_demonstrators")
        rows.append(
            (
                display_name(target),
                shown,
                imitated,
                format_number(policy.get("return_final")),
                format_number(policy.get("return_best")),
                "-" if ratio is None else f"{format_number(ratio, 2)}x",
                format_number(policy.get("learned_return_final")),
                _percent(policy.get("style_kept")),
            )
        )
    return Table(
        title="True return against the demonstrators",
        columns=(
            "target",
            "demonstrators",
            "imitation",
            "kept",
            "best",
            "vs demos",
            "learned",
            "style",
        ),
        rows=tuple(rows),
        note=_handed_on(results)
        + "Mean episode return under the environment's own reward, which the method never sees, "
        "of the demonstrators (the task's are all of them), of their imitation, and of the policy "
        "trained on the learned reward: the one kept for its learned return, and the best met "
        "along the way. Vs demos: kept over demonstrators. Learned: the kept policy's return under "
        "the learned reward, in its own units. Style: share of states in which a strategy's policy "
        "is still recognised as that strategy.",
    )


def _handed_on(results: Mapping[str, Any]) -> str:
    """Says which targets have another's policy, empty where none has."""
    others = {
        name: found["trained_for"]
        for name, found in (results.get("selection") or {}).items()
        if found["trained_for"] != name
    }
    return "".join(
        f"{display_name(name)} has the policy of {display_name(of).lower()}, which its reward pays "
        "more. "
        for name, of in others.items()
    )


def rewards_table(results: Mapping[str, Any]) -> Table | None:
    """Returns the correlations of learned with true return, or None without any."""
    rewards = {name: found for name, found in (results.get("rewards") or {}).items() if found}
    if not rewards:
        return None
    keys = (
        "pearson_test",
        "spearman_test",
        "pearson_noisy",
        "pearson_pooled",
        "pearson_above_demonstrators",
    )
    rows = [
        (display_name(target), *(format_number(rewards[target].get(key), 3) for key in keys))
        for target in targets(results)
        if rewards.get(target)
    ]
    return Table(
        title="Learned against true return",
        columns=("reward", "r, test", "rho, test", "r, noisy", "r, pooled", "r, above demos"),
        rows=tuple(rows),
        note="Pearson's r and Spearman's rho over whole trajectories: unseen test ones, the noisy "
        "ones the reward was trained on, all pooled (as the paper reports it), and only the test "
        "ones better than every demonstrator.",
    )


def summary(results: Mapping[str, Any]) -> str:
    """Returns the tables of a run as plain text for the terminal, ASCII only.

    Args:
        results: what results.json holds; stages that are missing are left out.
    """
    tables = [returns_table(results), rewards_table(results)]
    parts = [to_text(table) for table in tables if table is not None]
    return "\n\n".join([*parts, *missing(results)])


def to_text(table: Table) -> str:
    """Returns the table with aligned columns, the first to the left and the others to the right."""
    lines = [table.columns, *table.rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.columns))]

    def join(cells: Sequence[str]) -> str:
        padded = [cells[0].ljust(widths[0])]
        padded += [cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True)]
        return "  ".join(padded).rstrip()

    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    return "\n".join([table.title, rule, join(lines[0]), rule, *map(join, lines[1:]), rule])


def _percent(share: float | None) -> str:
    return "-" if share is None or not math.isfinite(share) else f"{100 * share:.0f} %"
