import dataclasses
import json

import pytest

from represent_jax import config, errors


@dataclasses.dataclass(frozen=True)
class Optimizer:
    learning_rate: float = 3e-4
    decay: float | None = None


@dataclasses.dataclass(frozen=True)
class Agent:
    hidden: tuple[int, ...] = (256, 256)
    bounds: tuple[float, float] = (-1.0, 1.0)
    optimizer: Optimizer = dataclasses.field(default_factory=Optimizer)
    batch_size: int = 256

    def __post_init__(self):
        config.require(self.batch_size > 0, "batch_size", "a positive int", self.batch_size)


@dataclasses.dataclass(frozen=True)
class Run:
    name: str
    agent: Agent = dataclasses.field(default_factory=Agent)
    critic: Optimizer | None = None
    state_only: bool = True
    horizon: int | None = None


RUN = Run("a", Agent(hidden=(32,), bounds=(0.0, 2.0)), Optimizer(1e-3, 0.5), False, 1000)


@pytest.mark.parametrize("original", [Run("b"), RUN])
def test_dict_round_trip_survives_json(original):
    values = config.to_dict(original)
    assert json.loads(json.dumps(values)) == values
    assert config.from_dict(Run, values) == original


def test_from_dict_fills_defaults_and_widens_ints_to_floats():
    built = config.from_dict(Run, {"name": "b", "agent": {"bounds": [0, 2]}})
    assert built == Run("b", Agent(bounds=(0.0, 2.0)))
    assert isinstance(built.agent.bounds[0], float)


@pytest.mark.parametrize(
    "values, message",
    [
        ({}, "name: expected str, found nothing"),
        ({"name": 3}, "name: expected str, found 3"),
        ({"name": "b", "state_only": 1}, "state_only: expected bool, found 1"),
        ({"name": "b", "horizon": True}, "horizon: expected int or none, found True"),
        ({"name": "b", "horizon": 1.0}, "horizon: expected int or none, found 1.0"),
        ({"name": "b", "agent": None}, "agent: expected Agent, found None"),
        (
            {"name": "b", "agent": {"hidden": [1, "x"]}},
            r"agent.hidden\[1\]: expected int, found 'x'",
        ),
        (
            {"name": "b", "agent": {"bounds": [1.0]}},
            r"agent.bounds: expected tuple\[float, float\], found \[1.0\]",
        ),
        ({"name": "b", "agent": {"hiden": []}}, "unknown setting 'agent.hiden': .*agent.hidden"),
        (
            {"name": "b", "agent": {"batch_size": 0}},
            "^agent.batch_size: expected a positive int, found 0",
        ),
    ],
)
def test_from_dict_refuses(values, message):
    with pytest.raises(errors.UsageError, match=message):
        config.from_dict(Run, values)


def test_overrides_are_read_by_the_type_of_their_field():
    overridden = config.apply_overrides(
        Run("b"),
        [
            "name=1e-3",
            "agent.hidden=64,32",
            "agent.bounds=(-2, 2)",
            "agent.optimizer.learning_rate=1e-3",
            "agent.batch_size=1_024",
            "critic.decay=0.5",
            "state_only=no",
            "horizon=2e6",
        ],
    )
    assert overridden == Run(
        "1e-3",
        Agent((64, 32), (-2.0, 2.0), Optimizer(1e-3), 1024),
        Optimizer(decay=0.5),
        False,
        2_000_000,
    )
    assert config.apply_overrides(overridden, ["horizon=none"]).horizon is None
    assert config.apply_overrides(overridden, ["agent.hidden="]).agent.hidden == ()


@pytest.mark.parametrize(
    "override, message",
    [
        ("state_only", "override 'state_only': expected key=value"),
        ("stat_only=true", "unknown setting 'stat_only': did you mean state_only"),
        ("optimizer.learning_rat=1", "did you mean agent.optimizer.learning_rate or critic.learn"),
        ("zzz=1", "known are agent.batch_size, agent.bounds"),
        (
            "agent.optimizer=1",
            "agent.optimizer is a group of settings: set one of agent.optimizer.l",
        ),
        ("agent.batch_size=1.5", "agent.batch_size: expected int, found '1.5'"),
        ("agent.batch_size=-1", "^agent.batch_size: expected a positive int, found -1"),
        ("agent.bounds=1,2,3", r"agent.bounds: expected tuple\[float, float\], found '1,2,3'"),
        ("state_only=maybe", "state_only: expected bool, found 'maybe'"),
        ("horizon=inf", "horizon: expected int or none, found 'inf'"),
    ],
)
def test_overrides_refuse(override, message):
    with pytest.raises(errors.UsageError, match=message):
        config.apply_overrides(Run("b"), [override])


def test_hash_tells_configurations_apart_and_takes_dictionaries():
    assert config.config_hash(Run("b")) == config.config_hash(Run("b"))
    assert config.config_hash(Run("b")) == config.config_hash(config.to_dict(Run("b")))
    assert config.config_hash(Run("b")) != config.config_hash(Run("c"))
    assert len(config.config_hash(RUN)) == 12


@dataclasses.dataclass(frozen=True)
class Grown(Optimizer):
    entries: tuple[int, ...] = config.later(())
    better: bool = config.later(True, before=False)


def test_identity_is_kept_by_a_later_field_at_what_was_before_alone():
    before = config.identity({"seed": 1, "each": Optimizer(), "sizes": (2, 3)})
    assert before == {
        "seed": 1,
        "each": {"learning_rate": 3e-4, "decay": None},
        "sizes": [2, 3],
    }
    as_before = Grown(better=False)
    assert config.identity({"seed": 1, "each": as_before, "sizes": (2, 3)}) == before
    changed = config.identity({"each": {"inner": Grown(entries=(4,))}})
    assert changed["each"]["inner"]["entries"] == [4]
    assert changed["each"]["inner"]["better"] is True
    assert config.to_dict(Grown())["entries"] == []


@dataclasses.dataclass(frozen=True)
class Kept:
    each: Grown = Grown()
    seed: int = 0
    extra: int | None = config.later(3, before=None)


def test_what_was_kept_before_a_later_field_is_restored_as_it_was():
    kept = config.to_dict(Kept(seed=5))
    assert config.restore(Kept, kept) == Kept(seed=5)
    del kept["extra"], kept["each"]["better"], kept["each"]["entries"]
    assert config.restore(Kept, kept) == Kept(Grown(better=False), 5, None)
    assert config.from_dict(Kept, kept) == Kept(Grown(), 5, 3)


def test_diff_names_the_dotted_keys():
    a, b = config.to_dict(Run("b")), config.to_dict(RUN)
    assert config.diff(a, a) == []
    assert config.diff(a, b) == [
        "name",
        "agent.hidden",
        "agent.bounds",
        "critic",
        "state_only",
        "horizon",
    ]
    assert config.diff({"x": (1, 2)}, {"x": [1, 2]}) == []
    assert config.diff({"x": 1}, {"y": 1}) == ["x", "y"]


def test_exit_codes():
    assert errors.RepresentError.exit_code == 1
    assert errors.unknown("environment", "crat", ["cart", "pole"]).exit_code == 2
