"""The runs behind the paper's tables: methods, ablations, and how far each has to go."""

import dataclasses
import functools
from collections.abc import Sequence

from represent_jax import config as configs
from represent_jax.errors import UsageError, unknown
from represent_jax.methods.config import MethodConfig
from represent_jax.methods.presets import PRESETS, make_config
from represent_jax.methods.registry import setting_names

GYM_DOMAINS = ("hopper", "half_cheetah", "inverted_double_pendulum")
# The paper's, driven by joint velocities, and the same driven by the hand.
KITCHENS = ("franka_kitchen", "franka_kitchen_hand")
DOMAINS = (*GYM_DOMAINS, *KITCHENS)

# Of the eight demonstrators of HalfCheetah, how many are taken: the first ones.
NUMS_STRATEGIES = (1, 2, 3, 5, 8)


@dataclasses.dataclass(frozen=True)
class Variant:
    """A method with some of its settings changed.

    Attributes:
      name: what records call it.
      method: name of the method.
      overrides: settings as `dotted.key=value`.
    """

    name: str
    method: str
    overrides: tuple[str, ...] = ()

    def config(self, preset: str, domain: str, overrides: Sequence[str] = ()) -> MethodConfig:
        """The settings of a preset, changed by `overrides` and then as the variant says.

        Overrides of stages that the method does not have are left out.

        Raises:
          UsageError: no preset of that name, or a setting that no method has, or of another kind.
        """
        config = make_config(preset, domain, self.method)
        own = {field.name for field in dataclasses.fields(config)}
        general = []
        for one in overrides:
            name = one.partition("=")[0].partition(".")[0]
            if name in own:
                general.append(one)
            elif name not in setting_names():
                raise unknown("setting", name, setting_names())
        return configs.apply_overrides(config, [*general, *self.overrides])


# Figure 5 shows how fast policies learn: from random networks, evaluated often.
_FROM_SCRATCH = (
    "policies.start=cold",
    "policies.env_steps=120_000",
    "policies.eval_env_steps=2_000",
    "policies.sac.warmup_env_steps=1_920",
    "policies.sac.critic_warmup_updates=0",
)

# SSRR appears twice: the tables' task row is on merged demonstrations, their strategy rows are on
# each strategy's own. Both are recorded as "ssrr"; their targets differ. So does BC, for Table IV.
VARIANTS = {
    "represent": Variant("represent", "represent"),
    "ssrr": Variant("ssrr", "ssrr"),
    "ssrr_separate": Variant("ssrr", "ssrr", ("grouping=separate",)),
    "msrd": Variant("msrd", "msrd"),
    "drex": Variant("drex", "drex"),
    "bc": Variant("bc", "bc"),
    "bc_strategy_1": Variant("bc", "bc", ("grouping=strategy_1",)),
    "bc_strategy_2": Variant("bc", "bc", ("grouping=strategy_2",)),
    "bc_rnn": Variant("bc_rnn", "bc_rnn"),
    "no_reg": Variant("no_reg", "represent", ("regression.lambda_reg=0",)),
    "no_bcd": Variant("no_bcd", "represent", ("regression.lambda_bcd=0",)),
    "shared": Variant("shared", "represent", ("regression.strategy_weight=0",)),
    "ensemble_1": Variant("ensemble_1", "represent", ("regression.ensemble_size=1",)),
    "literal_bcd": Variant("literal_bcd", "represent", ("regression.discrimination=literal",)),
    "equal_units": Variant("equal_units", "represent", ("regression.learn_units=false",)),
    "no_sigmoid": Variant("no_sigmoid", "represent", ("curve.targets=returns",)),
    "airl": Variant("airl", "represent", ("airl.noisy=false",)),
    "cold": Variant("cold", "represent", ("policies.start=cold",)),
    "scratch": Variant("scratch", "represent", _FROM_SCRATCH),
    "ssrr_scratch": Variant("ssrr_scratch", "ssrr", _FROM_SCRATCH),
    "ssrr_separate_scratch": Variant("ssrr_scratch", "ssrr", ("grouping=separate", *_FROM_SCRATCH)),
    "three_strategies": Variant("three_strategies", "represent", ("num_strategies=3",)),
    **{
        f"strategies_{num}": Variant(
            f"strategies_{num}",
            "represent",
            (
                "demonstrations=half_cheetah_8",
                f"num_strategies={num}",
                "policy_targets=task",
            ),
        )
        for num in NUMS_STRATEGIES
    },
}


@functools.cache
def settings_hashes(preset: str, domain: str, method: str, seed: int) -> frozenset[str]:
    """Hashes of the settings that a preset has for what records call `method`, in this version.

    Empty where records are of no preset itself, but of one with a seed of Phase 1 of its own.
    """
    if preset not in PRESETS:
        return frozenset()
    every = (variant for variant in VARIANTS.values() if variant.name == method)
    return frozenset(
        configs.config_hash(one.config(preset, domain, (f"seed={seed}",))) for one in every
    )


ABLATIONS = (
    *("no_reg", "no_bcd", "shared", "equal_units"),
    *("no_sigmoid", "ensemble_1", "literal_bcd"),
)

_REWARDS, _POLICIES = "reward_evaluation", "policy_evaluation"
_DECOMPOSING = ("represent", "ssrr", "ssrr_separate", "msrd", "drex")


@dataclasses.dataclass(frozen=True)
class TableRuns:
    """The runs of one table.

    Attributes:
      domains: of these the table speaks.
      until: by variant, the last stage that it needs.
    """

    domains: tuple[str, ...]
    until: dict[str, str]


TABLES = {
    "1": TableRuns(
        GYM_DOMAINS, dict.fromkeys(_DECOMPOSING, _REWARDS) | {"airl": "airl_evaluation"}
    ),
    "2": TableRuns(GYM_DOMAINS, dict.fromkeys((*_DECOMPOSING, "bc", "bc_rnn"), _POLICIES)),
    "3": TableRuns(
        ("hopper",),
        dict.fromkeys(("represent", "no_reg", "no_bcd", "ssrr", "ssrr_separate"), _POLICIES),
    ),
    "4": TableRuns(
        KITCHENS,
        dict.fromkeys(
            (
                *("represent", "ssrr", "ssrr_separate", "msrd"),
                *("bc", "bc_strategy_1", "bc_strategy_2"),
            ),
            _POLICIES,
        ),
    ),
    "5": TableRuns(("half_cheetah",), {"three_strategies": _POLICIES}),
    "strategies": TableRuns(
        ("half_cheetah",),
        {f"strategies_{num}": _POLICIES for num in NUMS_STRATEGIES},
    ),
    "ablations": TableRuns(GYM_DOMAINS, dict.fromkeys(("represent", *ABLATIONS), _REWARDS)),
    "figure_5": TableRuns(
        ("inverted_double_pendulum",),
        dict.fromkeys(("scratch", "ssrr_scratch", "ssrr_separate_scratch"), _POLICIES),
    ),
    "cold": TableRuns(GYM_DOMAINS, dict.fromkeys(("represent", "cold"), _POLICIES)),
}


def runs_of(
    tables: Sequence[str], domains: Sequence[str], variants: Sequence[str] = ()
) -> dict[str, dict[str, tuple[str, ...]]]:
    """The runs behind some tables: by domain and variant, the stages that have to be reached.

    Args:
      tables: names of tables.
      domains: environments to take of those a table speaks of.
      variants: those to take of a table's; all if empty.

    Raises:
      UsageError: no table, domain or variant of that name, or nothing is left.
    """
    for variant in variants:
        if variant not in VARIANTS:
            raise unknown("variant", variant, VARIANTS)
    for table in tables:
        if table not in TABLES:
            raise unknown("table", table, TABLES)
    for domain in domains:
        if domain not in DOMAINS:
            raise unknown("domain", domain, DOMAINS)
    wanted: dict[str, dict[str, tuple[str, ...]]] = {}
    for domain in domains:
        for table in tables:
            if domain not in TABLES[table].domains:
                continue
            for variant, until in TABLES[table].until.items():
                if variants and variant not in variants:
                    continue
                reached = wanted.setdefault(domain, {}).setdefault(variant, ())
                wanted[domain][variant] = tuple(dict.fromkeys((*reached, until)))
    if not wanted:
        asked = ", ".join((*domains, *variants))
        raise UsageError(f"tables {', '.join(tables)} do not speak of {asked}")
    return wanted
