"""The episode that is driven, step by step, and those that were recorded; no clock and no web."""

import enum
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from represent_jax.config import require
from represent_jax.data.trajectories import Trajectory
from represent_jax.envs.environment import Environment
from represent_jax.errors import UsageError
from represent_jax.teleoperation import recordings

# How far a replayed observation may be from the recorded one and still count as the same.
_REPLAY_TOLERANCE = 1e-4


class Phase(enum.StrEnum):
    """What the session is doing.

    Attributes:
        READY: a new episode's initial state is shown.
        DRIVING: keys drive the robot, and every step is recorded.
        PAUSED: the episode stands still and can go on.
        OVER: the episode has ended; it waits to be saved or discarded.
        PLAYING: a recorded episode is replayed.
    """

    READY = "ready"
    DRIVING = "driving"
    PAUSED = "paused"
    OVER = "over"
    PLAYING = "playing"


class Session:
    """Drives one environment and records its episodes; not for two threads at once.

    Attributes:
        env: the environment.
        path: the file of demonstrations that episodes are saved to.
        horizon: steps after which an episode is over.
        keyboard: what turns keys into actions; None where the robot can only be watched.
        phase: what the session is doing.
        notice: what happened last, in words.
        demonstrations: what the file holds, None as long as there is none.
    """

    def __init__(
        self,
        env: Environment,
        path: str | os.PathLike,
        horizon: int | None = None,
        seed: int | None = None,
        policy: Callable[[jax.Array], jax.Array] | None = None,
    ):
        """Compiles the environment and draws a first initial state.

        Args:
            env: the environment, on the `mujoco` engine.
            path: file of demonstrations; one that exists is added to.
            horizon: steps after which an episode is over; the environment's if None.
            seed: seed of the initial states; another one in every session if None.
            policy: acts in place of a driver, from `obs [obs_dim]`, and is compiled; its episodes
                are not recorded.

        Raises:
            UsageError: the horizon is no positive int, or the file is of another environment.
            RepresentError: the file is no whole file of demonstrations.
        """
        self.env, self.path = env, Path(path)
        self.horizon = env.horizon if horizon is None else horizon
        require(self.horizon > 0, "horizon", "a positive int", self.horizon)
        self.demonstrations = recordings.read(path, env)
        self.keyboard = None if policy else env.task.keyboard(env.engine.model)
        self._policy = jax.jit(policy) if policy else None
        self._seeds = np.random.default_rng(seed)
        self._reset = jax.jit(env.reset)
        self._step = jax.jit(env.step)
        self._readings = jax.jit(env.task.readings)
        self._played: Trajectory | None = None
        self._playing: int | None = None
        self._draw_initial_state()
        self._step(self._state, np.zeros(env.action_size, np.float32))
        if self._policy:
            self._policy(self._state.obs)
        self.notice = ""

    @property
    def watched(self) -> bool:
        """Whether a policy drives."""
        return self._policy is not None

    @property
    def moving(self) -> bool:
        """Whether time passes."""
        return self.phase in (Phase.DRIVING, Phase.PLAYING)

    @property
    def num_steps(self) -> int:
        """Steps of the episode that is driven or replayed."""
        return len(self._rewards)

    @property
    def total_reward(self) -> float:
        """True return of that episode so far."""
        return float(np.sum(self._rewards))

    @property
    def qpos(self) -> np.ndarray:
        """Positions to draw, `[nq]`."""
        return np.asarray(self._state.pipeline_state.qpos)

    @property
    def num_strategies(self) -> int:
        """Strategies that the file holds."""
        return self.demonstrations.num_strategies if self.demonstrations else 0

    def figures(self) -> dict[str, Any]:
        """Returns the live figures, as JSON can hold them."""
        readings = jax.device_get(self._readings(self._state.pipeline_state))
        return {
            "phase": self.phase,
            "notice": self.notice,
            "step": self.num_steps,
            "playing": self._playing,
            "horizon": self._played.length if self._played else self.horizon,
            "seconds": self.num_steps * self.env.engine.dt,
            "return": self.total_reward,
            "reward": self._rewards[-1] if self._rewards else 0.0,
            "readings": {name: float(value) for name, value in readings.items()},
            "num_recorded": len(self.demonstrations.trajectories) if self.demonstrations else 0,
            "num_strategies": self.num_strategies,
        }

    def recorded(self) -> list[dict[str, Any]]:
        """Returns a line for each episode of the file, as JSON can hold it."""
        if self.demonstrations is None:
            return []
        pairs = zip(
            self.demonstrations.trajectories,
            recordings.reset_seeds(self.demonstrations),
            strict=True,
        )
        return [
            {
                "strategy": trajectory.strategy + 1,
                "steps": trajectory.length,
                "return": None if trajectory.rewards is None else trajectory.total_reward,
                "terminated": trajectory.terminated,
                "playable": seed is not None,
            }
            for trajectory, seed in pairs
        ]

    def start(self) -> None:
        """Begins to drive from the initial state that is shown.

        Raises:
            UsageError: another episode is not finished.
        """
        self._require("start", Phase.READY)
        if self.keyboard:
            self.keyboard.reset()
        self.phase = Phase.DRIVING
        self.notice = "Recording." if self.keyboard else "Watching; nothing is recorded."

    def pause(self, notice: str = "Paused.") -> None:
        """Stands still, and says why; does nothing where no episode is driven."""
        if self.phase is Phase.DRIVING:
            self.phase, self.notice = Phase.PAUSED, notice

    def resume(self) -> None:
        """Goes on with a paused episode.

        Raises:
            UsageError: none is paused.
        """
        self._require("resume", Phase.PAUSED)
        self.phase, self.notice = Phase.DRIVING, "Recording." if self.keyboard else "Watching."

    def discard(self) -> None:
        """Forgets the episode that was driven.

        Raises:
            UsageError: there is none.
        """
        self._require("discard", Phase.DRIVING, Phase.PAUSED, Phase.OVER)
        self._draw_initial_state()
        self.notice = "Discarded."

    def save(self, strategy: int) -> None:
        """Adds the episode to the file; when this returns, it is on the disk.

        Args:
            strategy: number of the demonstrator, counted from 1.

        Raises:
            UsageError: there is no episode, it has no step, or the strategy leaves one out.
            RepresentError: the file cannot be written, or an observation is not finite. The
                episode is kept, and can be saved again.
        """
        self._require("save", Phase.DRIVING, Phase.PAUSED, Phase.OVER)
        if self.keyboard is None:
            raise UsageError("save: nobody drives here, so that there is nothing to record")
        require(strategy >= 1, "strategy", "a positive int", strategy)
        if not self._rewards:
            raise UsageError("save: expected an episode of at least 1 step, found 0")
        self.pause()
        trajectory = Trajectory(
            obs=np.stack(self._obs),
            actions=np.stack(self._actions),
            rewards=np.array(self._rewards),
            terminated=self._terminated,
            strategy=strategy - 1,
        )
        self.demonstrations = recordings.append(self.path, self.env, trajectory, self._reset_seed)
        self._draw_initial_state()
        number = len(self.demonstrations.trajectories)
        self.notice = f"Saved as episode {number}, strategy {strategy}."

    def play(self, episode: int) -> None:
        """Replays a recorded episode from its initial state.

        Args:
            episode: its number in the file, counted from 1.

        Raises:
            UsageError: an episode is not finished, there is none of that number, or it was not
                driven here.
        """
        self._require("play", Phase.READY, Phase.PLAYING)
        num = len(self.demonstrations.trajectories) if self.demonstrations else 0
        require(1 <= episode <= num, "episode", f"1 to {num}", episode)
        seed = recordings.reset_seeds(self.demonstrations)[episode - 1]
        if seed is None:
            raise UsageError(
                f"play: episode {episode} was not recorded here, and where it started is not known"
            )
        self._begin(seed)
        self._playing = episode
        self._played = self.demonstrations.trajectories[episode - 1]
        self._differs = False
        self.phase, self.notice = Phase.PLAYING, f"Playing episode {episode}."

    def stop(self) -> None:
        """Ends a replay; does nothing where there is none."""
        if self.phase is Phase.PLAYING:
            self._draw_initial_state()
            self.notice = "Stopped."

    def step(self, held: frozenset[str]) -> None:
        """Advances by one environment step; does nothing where no time passes.

        Args:
            held: names of the keys that are down.
        """
        if self.phase is Phase.DRIVING:
            self._drive(held)
        elif self.phase is Phase.PLAYING:
            self._replay()

    def _drive(self, held: frozenset[str]) -> None:
        if self._policy:
            action = np.asarray(self._policy(self._state.obs), np.float32)
        elif self.keyboard:
            action = self.keyboard.action(held, self._state.pipeline_state)
        else:
            action = np.zeros(self.env.action_size)
        self._advance(np.clip(np.asarray(action, np.float32), -1.0, 1.0))
        if self._terminated:
            self.phase, self.notice = Phase.OVER, "The task ended the episode."
        elif self.num_steps >= self.horizon:
            self.phase, self.notice = Phase.OVER, "The time limit is reached."

    def _replay(self) -> None:
        self._advance(self._played.actions[self.num_steps])
        expected = self._played.obs[self.num_steps]
        self._differs |= not np.allclose(self._obs[-1], expected, atol=_REPLAY_TOLERANCE)
        if self.num_steps == self._played.length:
            differs = self._differs
            self._draw_initial_state()
            self.notice = "Played to its end."
            if differs:
                self.notice = (
                    "Played to its end, but not as recorded: physics has changed since then."
                )

    def _advance(self, action: np.ndarray) -> None:
        self._state = self._step(self._state, action)
        obs, reward, done = jax.device_get((self._state.obs, self._state.reward, self._state.done))
        self._obs.append(obs)
        self._actions.append(action)
        self._rewards.append(float(reward))
        self._terminated = bool(done)

    def _draw_initial_state(self) -> None:
        self._begin(int(self._seeds.integers(2**31)))

    def _begin(self, reset_seed: int) -> None:
        self._reset_seed = reset_seed
        self._state = self._reset(jax.random.PRNGKey(reset_seed))
        self._obs = [np.asarray(self._state.obs)]
        self._actions: list[np.ndarray] = []
        self._rewards: list[float] = []
        self._terminated = False
        self._played, self._playing = None, None
        self.phase = Phase.READY

    def _require(self, command: str, *phases: Phase) -> None:
        if self.phase not in phases:
            raise UsageError(f"{command}: expected to be {' or '.join(phases)}, found {self.phase}")
