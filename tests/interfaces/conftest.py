"""Runs for the wrappers: rewards as they were drawn, which is all that a wrapper has to know."""

import dataclasses

import jax
import pytest

from represent_jax.envs import make_env
from represent_jax.methods.presets import make_config
from represent_jax.runs import open_run
from represent_jax.stages import regression


@pytest.fixture(scope="session")
def make_run(tmp_path_factory):
    """Returns a function that makes the run of an environment, as if its regression had ended."""

    def make(env_name):
        config = dataclasses.replace(make_config("smoke", env_name), backend="auto")
        env = make_env(config.env)
        path = tmp_path_factory.mktemp("run") / "drawn"
        key = jax.random.PRNGKey(0)
        sizes = (env.observation_size, env.action_size, config.num_groups)
        state = jax.jit(lambda key: regression.init(key, *sizes, config.regression))(key)
        with open_run(path, config) as run:
            run.save_output("regression", state.rewards)
        return path

    return make


@pytest.fixture(scope="session")
def half_cheetah_run(make_run):
    return make_run("half_cheetah")
