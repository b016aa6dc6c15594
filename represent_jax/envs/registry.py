"""Environments by name, and by the place of a class that nobody registered."""

from collections.abc import Callable

from brax.envs import base

from represent_jax import places
from represent_jax.config import require
from represent_jax.envs import playground
from represent_jax.envs.environment import Environment
from represent_jax.envs.franka_kitchen import FrankaKitchen, FrankaKitchenHand
from represent_jax.envs.half_cheetah import HalfCheetah
from represent_jax.envs.hopper import Hopper
from represent_jax.envs.inverted_double_pendulum import InvertedDoublePendulum
from represent_jax.envs.task import Task
from represent_jax.errors import UsageError, unknown
from represent_jax.physics import make_engine, resolve_backend

_TASKS: dict[str, Callable[..., Task]] = {
    task.name: task
    for task in (Hopper, HalfCheetah, InvertedDoublePendulum, FrankaKitchen, FrankaKitchenHand)
}


def names() -> tuple[str, ...]:
    """Returns the names of all registered environments."""
    return tuple(sorted(_TASKS))


def register(make_task: Callable[..., Task | playground.Adapted], name: str) -> None:
    """Makes a task, or an environment of Brax's kind in an `Adapted`, known by name.

    Raises:
      UsageError: the name is taken.
    """
    if name in _TASKS:
        raise UsageError(f"environment {name!r} is already registered")
    _TASKS[name] = make_task


def make_env(name: str, backend: str = "auto", **task_options) -> base.Env:
    """Makes a Brax environment by name.

    Args:
      name: a registered task, such as "half_cheetah"; "module:Class" of a `Task` that Python can
        import, such as "my_robots:Swimmer", or of a function that returns an `Adapted`; or
        "playground:Name" of a MuJoCo Playground environment, such as "playground:CartpoleBalance".
      backend: "mujoco" (C, for CPU hosts), "mjx" (XLA, for accelerators) or "auto", which
        picks by platform, but always "mujoco" where the task's scene for MJX is another.
      **task_options: passed to the task, such as `terminates=False`.

    Returns:
      An `Environment`, or an `Adapted`.

    Raises:
      UsageError: unknown environment, backend or option, or an extra that is not installed.
    """
    source, _, inner = name.partition(":")
    if source == "playground" and inner:
        return playground.make(inner, backend, **task_options)
    make_task = _TASKS.get(name) or (_imported(name) if inner else None)
    if make_task is None:
        raise unknown("environment", name, names())
    try:
        task = make_task(**task_options)
    except TypeError as error:
        raise UsageError(f"environment {name!r}: {error}") from error
    if isinstance(task, playground.Adapted):
        require(
            backend in ("auto", task.backend), "backend", f"{task.backend!r} or 'auto'", backend
        )
        return task
    if not isinstance(task, Task):
        raise UsageError(
            f"environment {name!r}: expected an envs.Task, or an envs.Adapted around an "
            f"environment of Brax's kind, found {task!r}"
        )
    # Episodes of a light scene are not those of the full one: they have to be asked for.
    backend = "mujoco" if backend == "auto" and task.has_light_model else resolve_backend(backend)
    model = task.load_light_model() if backend == "mjx" else task.load_model()
    engine = make_engine(backend, model, task.frame_skip, task.derived_fields, task.mjx_solver)
    return Environment(task, engine)


def _imported(name: str) -> Callable[..., Task | playground.Adapted]:
    """Finds what makes the environment of a "module:name"."""
    found = places.find("environment", name)
    if not callable(found):
        raise UsageError(
            f"environment {name!r}: expected a class of envs.Task, or a function that returns an "
            f"envs.Adapted, found {found!r}"
        )
    return found
