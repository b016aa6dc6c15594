"""Methods by name: what turns a preset's settings into those of the method."""

from collections.abc import Callable

from represent_jax.errors import unknown
from represent_jax.methods import ssrr
from represent_jax.methods.config import RepresentConfig

METHODS: dict[str, Callable[[RepresentConfig], RepresentConfig]] = {
    "represent": lambda config: config,
    "ssrr": ssrr.configure,
}


def configure(method: str, config: RepresentConfig) -> RepresentConfig:
    """Turns a preset's settings into those of a method.

    Raises:
      UsageError: no method of that name.
    """
    if method not in METHODS:
        raise unknown("method", method, METHODS)
    return METHODS[method](config)
