"""What all launchers share: one-line errors, quiet libraries, several processes for one program.

On a cluster that tells JAX of its processes (Slurm, Open MPI, a TPU pod) `--distributed` will do:

    srun python -m experiments.represent --env=hopper --distributed --out=/shared/run

Elsewhere each process is told where the first one listens, how many there are and which it is:

    python -m experiments.represent --out=/shared/run --distributed \\
        --coordinator=host:1234 --num_processes=2 --process=0
"""

import os
import sys
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path

from absl import app, flags, logging

from represent_jax.data.atomic import disk_errors
from represent_jax.errors import RepresentError, UsageError

_TRACEBACK = flags.DEFINE_bool("traceback", False, "Show where an error came from.")
_DISTRIBUTED = flags.DEFINE_bool("distributed", False, "Be one of several processes of a run.")
_COORDINATOR = flags.DEFINE_string("coordinator", "", "Host and port of the first process.")
_NUM_PROCESSES = flags.DEFINE_integer("num_processes", 0, "Number of processes.")
_PROCESS = flags.DEFINE_integer("process", -1, "Number of this process, from 0.")


def run(main: Callable[[list[str]], None], distributed: bool = False) -> None:
    """Runs a launcher; errors of use and of data end it with one line and their exit code.

    Args:
      main: what it does.
      distributed: whether several processes may do it together.
    """
    logging.set_verbosity(logging.WARNING)
    app.run(lambda argv: _guarded(main, argv, distributed))


def _guarded(main: Callable[[list[str]], None], argv: list[str], distributed: bool) -> None:
    try:
        if _DISTRIBUTED.value:
            if not distributed:
                raise UsageError("--distributed: expected experiments.represent, others run alone")
            from represent_jax.runs import processes

            processes.join(_COORDINATOR.value, _NUM_PROCESSES.value, _PROCESS.value)
        else:
            refuse_beside("without --distributed", ("coordinator", "num_processes", "process"))
        main(argv)
    except RepresentError as error:
        if _TRACEBACK.value:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


def compile_quickly(preset: str) -> None:
    """With `smoke`, whose programs are small and run once, has XLA optimise nothing.

    Their time is the compiler's, of which this leaves a third to a half. Whoever sets XLA_FLAGS is
    left alone. Has to come before JAX is first asked for a device.
    """
    if preset == "smoke":
        os.environ.setdefault(
            "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
        )


def overrides(values: Sequence[str]) -> list[str]:
    """Returns the overrides, none of which may say what a flag says: other things follow from it.

    Raises:
        UsageError: one does.
    """
    for one in values:
        name = one.partition("=")[0]
        if name in ("method", "env", "preset", "seed"):
            raise UsageError(f"--override {one}: expected a flag for {name}, it has one of its own")
    return list(values)


def refuse_beside(cause: str, names: Sequence[str]) -> None:
    """Refuses flags that were given and would do nothing.

    Args:
        cause: why they would do nothing.
        names: of the flags.

    Raises:
        UsageError: one of them was given.
    """
    given = [f"--{name}" for name in names if flags.FLAGS[name].present]
    if given:
        raise UsageError(f"{', '.join(given)}: without effect {cause}")


def refuse_to_replace(path: str | os.PathLike) -> None:
    """Refuses to write a file over what is there.

    Raises:
        UsageError: there is something.
    """
    if os.path.exists(path):
        raise UsageError(f"out: {path} exists already; give another name, or --overwrite")


def require_writable(path: str | os.PathLike) -> None:
    """Refuses a file that could not be written in the end, before what is to be in it is computed.

    Raises:
        RepresentError: it cannot be written.
    """
    path = Path(path)
    existed = path.exists()
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab"):
            pass
        if not existed:
            path.unlink()


def open_page(page: Path) -> None:
    """Shows a page in a browser, or says that there is none."""
    if not webbrowser.open(page.resolve().as_uri()):
        print(f"no browser here; open {page} in one")


def refuse_arguments(argv: list[str]) -> None:
    """Refuses words on the command line that are no flags.

    Raises:
        absl.app.UsageError: there are some.
    """
    if len(argv) > 1:
        raise app.UsageError(f"unexpected arguments: {' '.join(argv[1:])}")
