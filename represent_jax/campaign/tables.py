"""The paper's tables from records, beside the paper's own figures."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from represent_jax.campaign import paper
from represent_jax.campaign.statistics import Aggregate, aggregate
from represent_jax.campaign.variants import (
    ABLATIONS,
    GYM_DOMAINS,
    KITCHENS,
    NUMS_STRATEGIES,
    settings_hashes,
)
from represent_jax.errors import RepresentError, unknown
from represent_jax.report.tables import Table
from represent_jax.report.values import METHOD_NAMES, display_name, format_number

DOMAIN_NAMES = {
    "hopper": "Hopper",
    "half_cheetah": "HalfCheetah",
    "inverted_double_pendulum": "Double pendulum",
    "franka_kitchen": "Franka Kitchen",
    "franka_kitchen_hand": "Franka Kitchen, by hand",
}
VARIANT_NAMES = {
    **METHOD_NAMES,
    "phase_1": "Phase 1",
    "demonstrators": "Demonstrators",
    "no_reg": "without L_reg",
    "no_bcd": "without L_BCD",
    "shared": "R^0 alone",
    "equal_units": "curves in one unit",
    "no_sigmoid": "without the sigmoid",
    "ensemble_1": "ensemble of one",
    "literal_bcd": "Eq. 5 literally",
    "cold": "cold start",
    "scratch": "REPRESENT",
    "ssrr_scratch": "SSRR",
    "three_strategies": "REPRESENT",
    "strategies_1": "1 strategy",
    **{f"strategies_{num}": f"{num} strategies" for num in NUMS_STRATEGIES if num > 1},
}
_TARGETS = ("task", "strategy_1", "strategy_2")
_RETURNS = ("return_best", "return_final")
_OTHER_SETTINGS = " \N{DAGGER}"
_OUTCOMES = ("kettle_distance", "success")


class Cell(NamedTuple):
    """One figure of a table.

    Attributes:
      domain, target, method, quantity: what was measured.
      found: over seeds; None where there are no records.
      paper: mean, and standard deviation where there is one, in the paper; None if not there.
      other_settings: of how many seeds the records are of settings that the preset no longer has.
    """

    domain: str
    target: str
    method: str
    quantity: str
    found: Aggregate | None
    paper: tuple[float, ...] | None
    other_settings: int = 0


class Select:
    """Records of one preset, by what they measured; of several of one run the newest counts.

    Attributes:
      preset: the preset.
      beside: methods of one's own, to be shown beside those that tables have.
    """

    def __init__(
        self, records: Iterable[Mapping[str, Any]], preset: str, beside: Sequence[str] = ()
    ):
        """Sorts the records."""
        self.preset, self.beside = preset, tuple(beside)
        self._values: dict[tuple[str, str, str, str], dict[int, float | None]] = {}
        self._hashes: dict[tuple[str, str, str, str], dict[int, str | None]] = {}
        for record in records:
            if record["preset"] == preset:
                where = tuple(record[n] for n in ("domain", "target", "method", "quantity"))
                self._values.setdefault(where, {})[record["seed"]] = record["value"]
                self._hashes.setdefault(where, {})[record["seed"]] = record.get("config_hash")

    def values(self, domain: str, target: str, method: str, quantity: str) -> dict[int, float]:
        """Returns the value of every seed that has one."""
        held = self._values.get((domain, target, method, quantity), {})
        return {seed: value for seed, value in held.items() if value is not None}

    def cell(
        self,
        domain: str,
        target: str,
        method: str,
        quantity: str,
        published: tuple[float, ...] | float | None = None,
    ) -> Cell:
        """Aggregates the seeds of one figure."""
        values = self.values(domain, target, method, quantity)
        found = aggregate(list(values.values())) if values else None
        if published is not None and not isinstance(published, tuple):
            published = (published,)
        other = sum(self._has_other_settings(domain, target, method, quantity, s) for s in values)
        return Cell(domain, target, method, quantity, found, published, other)

    def _has_other_settings(
        self, domain: str, target: str, method: str, quantity: str, seed: int
    ) -> bool:
        held = self._hashes[domain, target, method, quantity][seed]
        known = settings_hashes(self.preset, domain, method, seed)
        return held is not None and bool(known) and held not in known


def correlations(select: Select) -> list[Cell]:
    """Table I: learned against true return, pooled as in the paper, and on unseen trajectories."""
    cells = []
    for domain in GYM_DOMAINS:
        for target in _TARGETS:
            methods = ["represent", "ssrr", "msrd"] + ["drex"] * (target == "task")
            for method in (*methods, *select.beside):
                published = paper.CORRELATIONS.get((domain, target, method))
                cells.append(select.cell(domain, target, method, "pearson_pooled", published))
                cells.append(select.cell(domain, target, method, "pearson_test"))
            if target != "task":
                cells += _imitation(select, domain, target, "pearson_test")
    return cells


def returns(select: Select) -> list[Cell]:
    """Table II: true return of policies, the highest as in the paper, and of the one kept."""
    cells = []
    for domain in GYM_DOMAINS:
        for target in _TARGETS:
            cells.append(_demonstrated(select, domain, target))
            merged = ["drex", "bc", "bc_rnn"] if target == "task" else ["msrd"]
            for method in ["represent", "ssrr", *merged, *select.beside]:
                published = paper.RETURNS.get((domain, target, method))
                cells.append(select.cell(domain, target, method, "return_best", published))
                cells.append(select.cell(domain, target, method, "return_final"))
            if target != "task":
                cells += _imitation(select, domain, target, "return_final")
    return cells


def ablations(select: Select) -> list[Cell]:
    """Table III: policies on Hopper where one of the losses is left out."""
    return [
        select.cell("hopper", target, method, quantity, published)
        for target in _TARGETS
        for method in ("represent", *ABLATIONS, "ssrr")
        for quantity in _RETURNS
        for published in [
            paper.ABLATIONS.get((target, method)) if quantity == "return_best" else None
        ]
    ]


def kitchen(select: Select) -> list[Cell]:
    """Table IV: policies in Franka Kitchen, what their episodes come to, and the rewards."""
    cells = []
    for domain, target in itertools.product(KITCHENS, _TARGETS):
        cells.append(_demonstrated(select, domain, target))
        for method in ("represent", "ssrr", "msrd", "bc", *select.beside):
            published = paper.KITCHEN.get((target, method))
            cells.append(select.cell(domain, target, method, "return_best", published))
            for quantity in ("return_final", *_OUTCOMES, "pearson_test"):
                cells.append(select.cell(domain, target, method, quantity))
        if target != "task":
            # By the joints it is a clone that does not learn.
            first = select.cell(domain, target, "represent", "airl_return")
            cells.append(first._replace(method="phase_1", quantity="return_final"))
    return cells


def three_strategies(select: Select) -> list[Cell]:
    """Table V: three strategies on HalfCheetah."""
    cells = []
    for target in ("strategy_1", "strategy_2", "strategy_3", "task"):
        cells.append(_demonstrated(select, "half_cheetah", target, "three_strategies", 3))
        published = paper.THREE_STRATEGIES.get((target, "represent"))
        for quantity, beside in (("return_best", published), ("return_final", None)):
            cells.append(select.cell("half_cheetah", target, "three_strategies", quantity, beside))
        cells.append(select.cell("half_cheetah", target, "three_strategies", "pearson_test"))
    return cells


def growing_strategies(select: Select) -> list[Cell]:
    """One step past the paper: what the task reward gains from more demonstrators."""
    return [
        select.cell("half_cheetah", "task", f"strategies_{num}", quantity)
        for num in NUMS_STRATEGIES
        for quantity in ("pearson_pooled", "pearson_test", *_RETURNS)
    ]


def _grid(
    select: Select, domains: Sequence[str], methods: Sequence[str], quantities: Sequence[str]
) -> list[Cell]:
    """Every quantity of every method, target and domain."""
    return [
        select.cell(domain, target, method, quantity)
        for domain in domains
        for target in _TARGETS
        for method in methods
        for quantity in quantities
    ]


def further_ablations(select: Select) -> list[Cell]:
    """Where the gain comes from: rewards without parts of the method."""
    return _grid(select, GYM_DOMAINS, ("represent", *ABLATIONS), ("pearson_pooled", "pearson_test"))


def cold_starts(select: Select) -> list[Cell]:
    """What starting from Phase 1's policies does."""
    return _grid(select, GYM_DOMAINS, ("represent", "cold"), _RETURNS)


def speeds(select: Select) -> list[Cell]:
    """Figure 5 in numbers: env steps after which 90 % of the last return was first reached."""
    quantities = ("env_steps_to_90_percent", "return_last")
    return _grid(select, ("inverted_double_pendulum",), ("scratch", "ssrr_scratch"), quantities)


TABLES: dict[str, tuple[str, Callable[[Select], list[Cell]]]] = {
    "1": ("Table I. Correlation of learned with true return", correlations),
    "2": ("Table II. True return of policies", returns),
    "3": ("Table III. Hopper without one of the losses: true return of policies", ablations),
    "4": ("Table IV. Franka Kitchen", kitchen),
    "5": ("Table V. Three strategies on HalfCheetah", three_strategies),
    "strategies": ("HalfCheetah with more and more demonstrators", growing_strategies),
    "ablations": ("Where the gain comes from", further_ablations),
    "figure_5": ("Figure 5. How fast policies learn from random networks", speeds),
    "cold": ("Policies from Phase 1's and from random networks: true return", cold_starts),
}


def make(
    name: str, records: Iterable[Mapping[str, Any]], preset: str, beside: Sequence[str] = ()
) -> tuple[str, list[Cell]]:
    """The cells of a table for which there are records, and the table's title.

    Args:
      name: of `TABLES`.
      records: of any runs.
      preset: those of this one count.
      beside: methods of one's own, shown beside those of Tables I, II and IV.

    Raises:
      UsageError: no table of that name, or no record of a method of one's own.
      RepresentError: no record belongs to the table.
    """
    if name not in TABLES:
        raise unknown("table", name, TABLES)
    title, cells_of = TABLES[name]
    records = list(records)
    held = {record["method"] for record in records if record["preset"] == preset}
    for method in beside:
        if method not in held:
            raise unknown(f"method among records of preset {preset!r}", method, held)
    select = Select(records, preset, beside)
    cells = [cell for cell in cells_of(select) if cell.found is not None]
    if not cells:
        held = ", ".join(dict.fromkeys(record["preset"] for record in records)) or "none"
        raise RepresentError(
            f"table {name}: no record of preset {preset!r} belongs to it; records are of: {held}"
        )
    return title, cells


def to_table(title: str, cells: Sequence[Cell]) -> Table:
    """The cells as text, a line for each with all that is known of it."""
    rows = []
    for cell in cells:
        digits, found = _digits(cell), cell.found
        rows.append(
            (
                _row_name(cell),
                VARIANT_NAMES.get(cell.method, cell.method),
                _QUANTITY_NAMES[cell.quantity],
                _plus_minus(found.mean, found.std, digits),
                format_number(found.iqm, digits),
                _interval(found.low, found.high, digits),
                str(found.num) + _mark(cell),
                _plus_minus(*cell.paper, digits=digits) if cell.paper else "-",
            )
        )
    return Table(
        title=title,
        columns=(
            "reward or policy",
            "method",
            "quantity",
            "mean +- std",
            "IQM",
            "95 % interval",
            "seeds",
            "paper",
        ),
        rows=tuple(rows),
        note="IQM: interquartile mean over seeds, with its bootstrap interval." + _marks(cells),
    )


def to_grids(title: str, cells: Sequence[Cell]) -> list[Table]:
    """The cells at a glance: a table for each quantity, a column for each method.

    Demonstrators have no quantity but their return, and stand in the first column of tables of it.
    """
    shown = [cell for cell in cells if cell.method == "demonstrators"]
    measured = [cell for cell in cells if cell.method != "demonstrators"]
    return [
        _to_grid(
            title,
            quantity,
            shown if quantity in _RETURNS else [],
            [cell for cell in measured if cell.quantity == quantity],
        )
        for quantity in dict.fromkeys(cell.quantity for cell in measured)
    ]


def _to_grid(
    title: str, quantity: str, demonstrated: Sequence[Cell], measured: Sequence[Cell]
) -> Table:
    rows = {_row_name(cell) for cell in measured}
    cells = [*(cell for cell in demonstrated if _row_name(cell) in rows), *measured]
    methods = list(dict.fromkeys(cell.method for cell in cells))
    most_seeds = max(cell.found.num for cell in measured)
    shown: dict[str, dict[str, str]] = {}
    for cell in cells:
        digits = _digits(cell)
        text = _plus_minus(cell.found.mean, cell.found.std, digits)
        if cell.paper:
            text += f" ({_plus_minus(*cell.paper, digits=digits)})"
        if cell.found.num < most_seeds and cell.method != "demonstrators":
            text += f" [{cell.found.num}]"
        text += _mark(cell)
        shown.setdefault(_row_name(cell), {})[cell.method] = text
    note = f"Mean +- standard deviation over {most_seeds} seeds" if most_seeds > 1 else "One seed"
    if any(cell.found.num < most_seeds for cell in measured):
        note += ", or as many as square brackets say"
    if any(cell.paper for cell in cells):
        note += "; in round brackets the paper's"
    return Table(
        title=f"{title}: {_QUANTITY_NAMES[quantity]}",
        columns=("", *(VARIANT_NAMES.get(method, method) for method in methods)),
        rows=tuple(
            (name, *(row.get(method, "-") for method in methods)) for name, row in shown.items()
        ),
        note=f"{note}.{_marks(cells)}",
    )


def _mark(cell: Cell) -> str:
    return _OTHER_SETTINGS if cell.other_settings and cell.method != "demonstrators" else ""


def _marks(cells: Iterable[Cell]) -> str:
    """What the mark means, where a cell has it."""
    if not any(_mark(cell) for cell in cells):
        return ""
    return f" {_OTHER_SETTINGS.strip()}: of settings that the preset has no longer."


def _digits(cell: Cell) -> int:
    if cell.quantity.startswith("pearson") or cell.quantity in _OUTCOMES:
        return 3
    # Returns of the kitchen are a hundredth of the others'.
    return 2 if cell.domain in KITCHENS else 0


def _row_name(cell: Cell) -> str:
    return f"{DOMAIN_NAMES[cell.domain]}, {display_name(cell.target).lower()}"


_QUANTITY_NAMES = {
    "pearson_pooled": "r, pooled",
    "pearson_test": "r, unseen",
    "return_best": "highest",
    "return_final": "kept",
    "return_last": "last",
    "env_steps_to_90_percent": "env steps to 90 %",
    "demo_return": "demonstrated",
    "kettle_distance": "kettle from goal, m",
    "success": "success",
}


def _imitation(select: Select, domain: str, target: str, quantity: str) -> list[Cell]:
    """Phase 1 by itself, with and without noise in its training."""
    recorded = {"pearson_test": "airl_pearson_test", "return_final": "airl_return"}[quantity]
    return [
        select.cell(domain, target, variant, recorded)._replace(method=method, quantity=quantity)
        for variant, method in (("represent", "noisy_airl"), ("airl", "airl"))
    ]


def _demonstrated(
    select: Select, domain: str, target: str, method: str = "represent", num_strategies: int = 2
) -> Cell:
    """True return of a strategy's demonstrators, for the task the mean of all strategies."""
    names = [f"strategy_{i + 1}" for i in range(num_strategies)] if target == "task" else [target]
    means = []
    for name in names:
        values = list(select.values(domain, name, method, "demo_return").values())
        means += values[:1]
    # Demonstrations are the same for all seeds.
    found = aggregate([sum(means) / len(means)]) if len(means) == len(names) else None
    given = paper.THREE_STRATEGIES.get((target, "demonstrators"))
    if num_strategies == 2:
        given = paper.RETURNS.get((domain, target, "demonstrators"))
    if domain in KITCHENS:
        given = paper.KITCHEN.get((target, "demonstrators"))
    published = None if given is None else (given,)
    return Cell(domain, target, "demonstrators", "demo_return", found, published)


def _plus_minus(mean: float, std: float = float("nan"), digits: int = 3) -> str:
    spread = format_number(std, digits)
    return format_number(mean, digits) + ("" if spread == "-" else f" +- {spread}")


def _interval(low: float, high: float, digits: int) -> str:
    return "-" if low != low else f"{format_number(low, digits)} to {format_number(high, digits)}"
