"""Methods by name."""

from collections.abc import Callable
from typing import NamedTuple

from represent_jax.errors import unknown
from represent_jax.methods import cloning, drex, msrd, represent, ssrr
from represent_jax.methods.config import MethodConfig, RepresentConfig


def _unchanged(config: MethodConfig) -> MethodConfig:
    return config


class Method(NamedTuple):
    """A method.

    Attributes:
      config: class of its settings.
      run: runs its stages, `run(config, problem, directory, checkpoint_seconds, until)`.
      stages: their names, in order.
      configure: turns a preset's settings into those of the method.
    """

    config: type[MethodConfig]
    run: Callable
    stages: tuple[str, ...]
    configure: Callable[[MethodConfig], MethodConfig] = _unchanged


METHODS: dict[str, Method] = {
    "represent": Method(RepresentConfig, represent.run, represent.STAGES),
    "ssrr": Method(RepresentConfig, represent.run, represent.STAGES, ssrr.configure),
    "drex": Method(drex.DrexConfig, drex.run, drex.STAGES, drex.configure),
    "msrd": Method(msrd.MsrdMethodConfig, msrd.run, msrd.STAGES),
    "bc": Method(cloning.BcMethodConfig, cloning.run_bc, cloning.STAGES),
    "bc_rnn": Method(cloning.BcRnnMethodConfig, cloning.run_bc_rnn, cloning.STAGES),
}


def find_method(name: str) -> Method:
    """Finds a method.

    Raises:
      UsageError: no method of that name.
    """
    if name not in METHODS:
        raise unknown("method", name, METHODS)
    return METHODS[name]
