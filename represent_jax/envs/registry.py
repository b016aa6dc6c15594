"""Environments by name."""

from collections.abc import Callable

from represent_jax.envs.environment import Environment
from represent_jax.envs.franka_kitchen import FrankaKitchen
from represent_jax.envs.half_cheetah import HalfCheetah
from represent_jax.envs.hopper import Hopper
from represent_jax.envs.inverted_double_pendulum import InvertedDoublePendulum
from represent_jax.envs.task import Task
from represent_jax.errors import UsageError, unknown
from represent_jax.physics import make_engine, resolve_backend

_TASKS: dict[str, Callable[..., Task]] = {
    task.name: task for task in (Hopper, HalfCheetah, InvertedDoublePendulum, FrankaKitchen)
}


def names() -> tuple[str, ...]:
    """Returns the names of all registered environments."""
    return tuple(sorted(_TASKS))


def register(make_task: Callable[..., Task], name: str) -> None:
    """Makes a task known by name.

    Raises:
      UsageError: the name is taken.
    """
    if name in _TASKS:
        raise UsageError(f"environment {name!r} is already registered")
    _TASKS[name] = make_task


def make_env(name: str, backend: str = "auto", **task_options) -> Environment:
    """Makes a Brax environment by name.

    Args:
      name: a registered task, such as "half_cheetah".
      backend: "mujoco" (C, for CPU hosts), "mjx" (XLA, for accelerators) or "auto".
      **task_options: passed to the task, such as `terminates=False`.

    Raises:
      UsageError: unknown environment, backend or option.
    """
    if name not in _TASKS:
        raise unknown("environment", name, names())
    try:
        task = _TASKS[name](**task_options)
    except TypeError as error:
        raise UsageError(f"environment {name!r}: {error}") from error
    backend = resolve_backend(backend)
    model = task.load_light_model() if backend == "mjx" else task.load_model()
    engine = make_engine(backend, model, task.frame_skip, task.derived_fields, task.mjx_solver)
    return Environment(task, engine)
