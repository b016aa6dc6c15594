"""The environment that the tests drive."""

import pytest

from represent_jax.envs import make_env


@pytest.fixture(scope="session")
def env():
    return make_env("inverted_double_pendulum", backend="mujoco")
