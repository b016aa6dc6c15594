"""How a person drives a robot with keys; scripted operators go through the same interface."""

import abc
from collections.abc import Mapping, Sequence

import numpy as np

from represent_jax.physics.engine import PhysicsState


class Keyboard(abc.ABC):
    """Turns the keys that are held into actions.

    Attributes:
      keys: what each key does, as shown to the driver, by its name in a browser
        (`KeyboardEvent.key` in lower case: "w", "arrowleft", " ").
    """

    keys: Mapping[str, str]

    @abc.abstractmethod
    def action(self, held: frozenset[str], physics: PhysicsState) -> np.ndarray:
        """Returns the action of one environment step, in [-1, 1], `[action_dim]`.

        Args:
          held: names of the keys that are down; names it does not know are ignored.
          physics: the state before the step.
        """

    def reset(self) -> None:
        """Forgets what was switched on (such as a speed) before a new episode; often nothing."""
        return None


class DirectKeyboard(Keyboard):
    """Keys that push single entries of the action.

    Attributes:
      action_dim: entries of the action.
    """

    def __init__(self, action_dim: int, pushes: Sequence[tuple[str, str, int, float]]):
        """Names the keys.

        Args:
          action_dim: entries of the action.
          pushes: for each key its name, what it does, the entry it pushes and how far; entries
            that several held keys push are summed and bounded.
        """
        self.action_dim = action_dim
        self.keys = {key: does for key, does, _, _ in pushes}
        self._pushes = {key: (entry, value) for key, _, entry, value in pushes}

    def action(self, held: frozenset[str], physics: PhysicsState) -> np.ndarray:
        del physics
        action = np.zeros(self.action_dim, np.float32)
        for key in held & self._pushes.keys():
            entry, value = self._pushes[key]
            action[entry] += value
        return np.clip(action, -1.0, 1.0)
