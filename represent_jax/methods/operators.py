"""Scripted operators of the kitchen's keys, in place of the people who drove it in the paper.

An operator presses keys like a person: it sees what was true a reaction time ago, decides a few
times a second, presses at most two keys, aims a little beside what it wants and pauses. It knows
where hand and kettle are and has a plan of stretches; what the keys do is the keyboard's to say.
"""

import dataclasses
from collections import deque
from collections.abc import Callable, Generator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs import base

from represent_jax.config import require
from represent_jax.data.trajectories import Trajectory
from represent_jax.envs import Environment

STRATEGIES = ("push", "hold")

# Height of the middle of the kettle's body and of its handle above the kettle's own position.
_BODY, _HANDLE = 0.09, 0.259
_GOAL = np.array([-0.23, 0.75])
# How far the kettle has to go to the right for every metre forward.
_SLANT = 0.1
# The fingers close this far in front of the point of the hand that keys move.
_REACH = 0.025
# The kettle is touched where it is this near in front of the hand.
_TOUCHING = 0.175
# What the slow key moves the hand by in one step, in m.
_SLOW_STEP = 0.003
_LONG = 1_000
# Observations are stored in these parts of a m, rad or second.
_PER_UNIT = 2.0**15
_SHIFT, _SPACE = frozenset({"shift"}), frozenset({" "})
# Errors above this are gone about without the slow key, sometimes.
_FAR = 0.06
# The keys that lower and raise each coordinate of the hand.
_KEYS = (("a", "d"), ("s", "w"), ("e", "q"))


@dataclasses.dataclass(frozen=True)
class Operator:
    """How one person drives.

    Attributes:
      strategy: "push" shoves the kettle's body, "hold" grips its handle and carries it along.
      reaction_steps: environment steps between what is true and what is seen.
      decision_steps: environment steps for which keys stay as they are.
      aim_error: standard deviation of where a stretch ends, in m, drawn once a stretch.
      pause_rate: chance to pause at a decision.
      pause_steps: mean length of a pause.
      think_steps: mean length of the pause before every stretch.
      fast_share: share of decisions far from the aim that are taken without the slow key.
      lapse_rate: chance that a decision is to press a random key.
    """

    strategy: str = "push"
    reaction_steps: int = 3
    decision_steps: int = 3
    aim_error: float = 0.008
    pause_rate: float = 0.03
    pause_steps: float = 10.0
    think_steps: float = 12.0
    fast_share: float = 0.5
    lapse_rate: float = 0.0

    def __post_init__(self) -> None:
        require(self.strategy in STRATEGIES, "strategy", "push or hold", self.strategy)
        require(self.reaction_steps >= 0, "reaction_steps", "at least 0", self.reaction_steps)
        require(self.decision_steps >= 1, "decision_steps", "at least 1", self.decision_steps)
        for field in ("aim_error", "pause_steps", "think_steps"):
            require(getattr(self, field) >= 0.0, field, "at least 0", getattr(self, field))
        for field in ("pause_rate", "fast_share", "lapse_rate"):
            require(0.0 <= getattr(self, field) <= 1.0, field, "in [0, 1]", getattr(self, field))


@dataclasses.dataclass(frozen=True)
class OperatorsConfig:
    """Who demonstrates, and who drives for the test set.

    Attributes:
      env: the environment's name.
      push, hold: the operators of strategies 1 and 2.
      target_returns: the paper's mean true returns of the two.
      seed: seed of the demonstrators' first episode; the next ones count on.
      episodes: driven by each demonstrator.
      demonstrations: of these taken, those whose returns are nearest to the wanted one.
      test_seed: seed of the test set's operators.
      test_trajectories: episodes in the test set, each by another operator.
    """

    env: str = "franka_kitchen"
    push: Operator = Operator(fast_share=0.2)
    hold: Operator = Operator("hold", fast_share=0.6, think_steps=30.0)
    target_returns: tuple[float, float] = (-122.86, -174.46)
    seed: int = 0
    episodes: int = 12
    demonstrations: int = 5
    test_seed: int = 1_000
    test_trajectories: int = 50

    def __post_init__(self) -> None:
        require(
            2 <= self.demonstrations <= self.episodes,
            "demonstrations",
            f"2 (one to fit styles to, one to judge them) to {self.episodes}, the episodes driven",
            self.demonstrations,
        )
        require(
            self.test_trajectories >= 2,
            "test_trajectories",
            "at least 2, from deft to hopeless",
            self.test_trajectories,
        )


OPERATORS = {name: OperatorsConfig(env=name) for name in ("franka_kitchen", "franka_kitchen_hand")}


class View(NamedTuple):
    """What an operator sees; positions in m, in the axes of the kitchen.

    Attributes:
      hand: `[3]`.
      kettle: `[3]`.
      roll: of the hand about its own axis, in rad; a quarter turn suits the handle.
    """

    hand: np.ndarray
    kettle: np.ndarray
    roll: float


class Stretch(NamedTuple):
    """A part of an operator's plan.

    Attributes:
      aim: from what is seen to where the hand should be, `[3]`; None where it stays.
      going: from what is seen to how far the stretch is from its end, in its own unit; None where
        it ends as soon as the hand is where it should be.
      tolerance: error of the hand in m that is left alone.
      keys: pressed in any case.
      slow: whether the slow key is held throughout.
    """

    aim: Callable[[View], np.ndarray] | None = None
    going: Callable[[View], float] | None = None
    tolerance: float = 0.01
    keys: frozenset[str] = frozenset()
    slow: bool = False


def _push() -> list[Stretch]:
    """Behind the kettle, then forward against its body, then away."""

    def behind(view: View) -> np.ndarray:
        return np.array([view.kettle[0], 0.12, view.kettle[2] + _BODY])

    def forward(view: View) -> np.ndarray:
        x, y = _carried(view) if view.kettle[1] - view.hand[1] < _TOUCHING else view.kettle[:2]
        return np.array([x, y, view.kettle[2] + _BODY])

    return [
        Stretch(behind),
        Stretch(forward, _short_of_goal),
        _retreat(),
    ]


def _hold() -> list[Stretch]:
    """Turn the hand, reach for the handle, close the fingers, carry, open them, away."""

    def before(view: View) -> np.ndarray:
        return np.array([view.kettle[0], 0.18, view.kettle[2] + _HANDLE])

    def around(view: View) -> np.ndarray:
        return np.array([view.kettle[0], view.kettle[1] - _REACH, view.kettle[2] + _HANDLE])

    def along(view: View) -> np.ndarray:
        return np.array([*_carried(view), view.hand[2]])

    turn = frozenset({"z"})
    return [
        Stretch(None, lambda view: np.pi / 2 - view.roll - 0.15, keys=turn),
        Stretch(before, tolerance=0.006),
        Stretch(around, tolerance=0.006, slow=True),
        Stretch(keys=_SPACE),
        Stretch(along, _short_of_goal, tolerance=0.015),
        Stretch(keys=_SPACE),
        _retreat(),
    ]


def _retreat() -> Stretch:
    """Back until the hand is well away from the kettle."""
    return Stretch(
        lambda view: view.hand - np.array([0.0, 0.1, 0.0]),
        lambda view: view.hand[1] - (view.kettle[1] - 0.3),
    )


def _short_of_goal(view: View) -> float:
    return _GOAL[1] - view.kettle[1]


def _carried(view: View) -> np.ndarray:
    """Where the hand has to be to bring the kettle onto a straight line to its goal, `[2]`."""
    missing = _GOAL - view.kettle[:2]
    return view.hand[:2] + np.array([missing[0] - _SLANT * missing[1], missing[1]])


_PLANS = {"push": _push, "hold": _hold}


def keys_of(operator: Operator, rng: np.random.Generator) -> Generator[frozenset[str], View, None]:
    """The keys that an operator holds in each environment step; it is sent what it sees.

    Args:
      operator: who drives.
      rng: of everything that people do not do twice alike.
    """
    view = yield frozenset()
    for stretch in _PLANS[operator.strategy]():
        for _ in range(rng.poisson(operator.think_steps)):
            view = yield frozenset()
        # Where the stretch goes too far or not far enough.
        aim_error = rng.normal(0.0, operator.aim_error, 3) * stretch.tolerance / 0.01
        end = rng.normal(0.0, operator.aim_error)
        while True:
            off = np.zeros(3)
            if stretch.aim is not None:
                off = stretch.aim(view) + aim_error - view.hand
            keys = _wanted_keys(operator, stretch, off, rng)
            in_place = not keys - _SHIFT - stretch.keys
            if stretch.going is None and in_place:
                # What is pressed in any case is pressed once.
                for _ in range(operator.decision_steps):
                    view = yield stretch.keys
                break
            if stretch.going is not None and (
                stretch.going(view) <= end or (in_place and stretch.aim is not None)
            ):
                break
            if rng.random() < operator.lapse_rate:
                keys = frozenset({str(rng.choice(np.ravel(_KEYS)))})
            if rng.random() < operator.pause_rate:
                for _ in range(rng.poisson(operator.pause_steps)):
                    view = yield frozenset()
            # Close to the aim a key is tapped, and then its effect awaited.
            steps = _tap_steps(off, keys)
            for _ in range(min(steps, operator.decision_steps)):
                view = yield keys
            if steps < operator.decision_steps:
                for _ in range(operator.reaction_steps):
                    view = yield frozenset()
    while True:
        yield frozenset()


def _wanted_keys(
    operator: Operator, stretch: Stretch, off: np.ndarray, rng: np.random.Generator
) -> frozenset[str]:
    """Keys of the two axes that are furthest off, and those that are pressed in any case."""
    axes = [i for i in np.argsort(-np.abs(off)) if abs(off[i]) > stretch.tolerance][:2]
    keys = {_KEYS[i][int(off[i] > 0.0)] for i in axes}
    near = any(abs(off[i]) < _FAR for i in axes)
    if stretch.slow or near or (axes and rng.random() > operator.fast_share):
        keys |= _SHIFT
    return frozenset(keys | stretch.keys)


def _tap_steps(off: np.ndarray, keys: frozenset[str]) -> int:
    """Steps after which the slow key has closed the smallest of the gaps that keys work on."""
    gaps = [abs(off[i]) for i, pair in enumerate(_KEYS) if keys & set(pair)]
    if not gaps or "shift" not in keys:
        return _LONG
    return max(1, round(min(gaps) / _SLOW_STEP))


class Driver:
    """Drives the full kitchen with operators, one episode after the other.

    Attributes:
      env: the environment, on the engine "mujoco".
    """

    def __init__(self, env: Environment):
        self.env = env
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)
        self._keyboard = env.task.keyboard(env.engine.model)
        self._data = mujoco.MjData(env.engine.model)

    def episode(self, operator: Operator, seed: int, strategy: int = 0) -> Trajectory:
        """One episode of the environment's horizon.

        Args:
          operator: who drives.
          seed: of what it does by chance.
          strategy: its number in the trajectory.
        """
        rng = np.random.default_rng(seed)
        hands = keys_of(operator, rng)
        next(hands)
        self._keyboard.reset()
        state = self._reset(jax.random.PRNGKey(seed))
        seen = deque(maxlen=operator.reaction_steps + 1)
        obs, actions, rewards = [state.obs], [], []
        for _ in range(self.env.horizon):
            seen.append(self._look(state))
            action = self._keyboard.action(hands.send(seen[0]), state.pipeline_state)
            state = self._step(state, jnp.asarray(action))
            obs.append(state.obs)
            actions.append(action)
            rewards.append(state.reward)
        obs, rewards = jax.device_get((jnp.stack(obs), jnp.stack(rewards)))
        return Trajectory(obs, np.stack(actions), rewards, False, strategy)

    def _look(self, state: base.State) -> View:
        data = self._data
        data.qpos[:] = state.pipeline_state.qpos
        mujoco.mj_kinematics(self.env.engine.model, data)
        hand = data.site("end_effector")
        # The fingers open along the second axis of the hand.
        across = hand.xmat.reshape(3, 3)[:, 1]
        roll = float(np.arctan2(across[2], across[0]))
        return View(hand.xpos.copy(), data.body("kettle").xpos.copy(), roll)


def demonstrate(driver: Driver, config: OperatorsConfig) -> list[Trajectory]:
    """Demonstrations of both strategies, those nearest to the paper's level."""
    chosen = []
    for strategy, operator in enumerate((config.push, config.hold)):
        seeds = config.seed + np.arange(config.episodes)
        driven = [driver.episode(operator, int(seed), strategy) for seed in seeds]
        wanted = config.target_returns[strategy]
        driven.sort(key=lambda t, wanted=wanted: abs(t.total_reward - wanted))
        chosen += driven[: config.demonstrations]
    return [_rounded(t) for t in chosen]


def make_test_set(driver: Driver, config: OperatorsConfig) -> list[Trajectory]:
    """Episodes of operators from deft to hopeless, both strategies in turn."""
    trajectories = []
    for i in range(config.test_trajectories):
        rng = np.random.default_rng(config.test_seed + i)
        trouble = i / (config.test_trajectories - 1)
        operator = Operator(
            strategy=STRATEGIES[i % 2],
            reaction_steps=int(rng.integers(1, 5)),
            aim_error=0.004 + 0.03 * trouble * rng.random(),
            think_steps=2.0 + 40.0 * trouble * rng.random(),
            fast_share=float(rng.random()),
            lapse_rate=0.6 * max(0.0, trouble - 0.4) * rng.random(),
        )
        driven = driver.episode(operator, config.test_seed + i, i % 2)
        trajectories.append(_rounded(driven))
    return trajectories


def _rounded(trajectory: Trajectory) -> Trajectory:
    """Observations to a 30th of FrankaKitchen-v1's own noise, which halves the file."""
    obs = np.round(trajectory.obs * _PER_UNIT) / _PER_UNIT
    return dataclasses.replace(trajectory, obs=obs)
