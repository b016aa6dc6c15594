"""Methods by name."""

from collections.abc import Callable
from typing import NamedTuple

import jax

from represent_jax.errors import unknown
from represent_jax.methods import cloning, drex, msrd, represent, ssrr
from represent_jax.methods.config import MethodConfig, RepresentConfig

Loader = Callable[..., dict[str, Callable[..., jax.Array]]]


def _unchanged(config: MethodConfig) -> MethodConfig:
    return config


class Method(NamedTuple):
    """A method.

    Attributes:
      config: class of its settings.
      run: runs its stages, `run(config, problem, directory, checkpoint_seconds, until)`.
      stages: their names, in order.
      load_rewards, load_policies: from settings, environment and run directory to functions
        `reward(obs_t, action_t, next_obs_t)` and `policy(obs)`, by target.
      configure: turns a preset's settings into those of the method.
    """

    config: type[MethodConfig]
    run: Callable
    stages: tuple[str, ...]
    load_rewards: Loader
    load_policies: Loader
    configure: Callable[[MethodConfig], MethodConfig] = _unchanged


_REPRESENT = Method(
    config=RepresentConfig,
    run=represent.run,
    stages=represent.STAGES,
    load_rewards=represent.load_rewards,
    load_policies=represent.load_policies,
)

METHODS: dict[str, Method] = {
    "represent": _REPRESENT,
    "ssrr": _REPRESENT._replace(configure=ssrr.configure),
    "drex": Method(
        config=drex.DrexConfig,
        run=drex.run,
        stages=drex.STAGES,
        load_rewards=drex.load_rewards,
        load_policies=drex.load_policies,
        configure=drex.configure,
    ),
    "msrd": Method(
        config=msrd.MsrdMethodConfig,
        run=msrd.run,
        stages=msrd.STAGES,
        load_rewards=msrd.load_rewards,
        load_policies=msrd.load_policies,
    ),
    "bc": Method(
        config=cloning.BcMethodConfig,
        run=cloning.run_bc,
        stages=cloning.STAGES,
        load_rewards=cloning.load_no_rewards,
        load_policies=cloning.load_bc_policies,
    ),
    "bc_rnn": Method(
        config=cloning.BcRnnMethodConfig,
        run=cloning.run_bc_rnn,
        stages=cloning.STAGES,
        load_rewards=cloning.load_no_rewards,
        load_policies=cloning.load_no_recurrent_policies,
    ),
}


def find_method(name: str) -> Method:
    """Finds a method.

    Raises:
      UsageError: no method of that name.
    """
    if name not in METHODS:
        raise unknown("method", name, METHODS)
    return METHODS[name]
