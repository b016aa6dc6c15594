"""Keys are summed, bounded, and shown with what they do."""

import mujoco
import numpy as np
import pytest

from represent_jax.envs.hopper import Hopper
from represent_jax.envs.inverted_double_pendulum import InvertedDoublePendulum
from represent_jax.envs.keyboard import DirectKeyboard

_PUSHES = (
    ("a", "left", 0, -0.6),
    ("d", "right", 0, 0.6),
    ("shift", "further right", 0, 0.6),
    ("w", "up", 1, 1.0),
)


@pytest.mark.parametrize(
    ("held", "expected"),
    [
        ((), [0.0, 0.0]),
        (("a",), [-0.6, 0.0]),
        (("a", "d"), [0.0, 0.0]),
        (("d", "shift", "w"), [1.0, 1.0]),
        (("unknown",), [0.0, 0.0]),
    ],
)
def test_held_keys_are_summed_and_bounded(held, expected):
    keyboard = DirectKeyboard(2, _PUSHES)
    np.testing.assert_allclose(keyboard.action(frozenset(held), None), expected)
    assert keyboard.keys["w"] == "up"


def test_a_task_names_its_keys_or_can_only_be_watched():
    task = InvertedDoublePendulum()
    keyboard = task.keyboard(task.load_model())
    assert set(keyboard.keys) == {"arrowleft", "arrowright"}
    assert keyboard.action(frozenset({"arrowleft"}), None).shape == (1,)
    assert Hopper().keyboard(mujoco.MjModel.from_xml_string("<mujoco/>")) is None
