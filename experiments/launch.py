"""What all launchers share: one-line errors, and quiet libraries."""

import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path

from absl import app, flags, logging

from represent_jax.errors import RepresentError

_TRACEBACK = flags.DEFINE_bool("traceback", False, "Show where an error came from.")


def run(main: Callable[[list[str]], None]) -> None:
    """Runs a launcher; errors of use and of data end it with one line and their exit code."""
    logging.set_verbosity(logging.WARNING)
    app.run(lambda argv: _guarded(main, argv))


def _guarded(main: Callable[[list[str]], None], argv: list[str]) -> None:
    try:
        main(argv)
    except RepresentError as error:
        if _TRACEBACK.value:
            raise
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


def open_page(page: Path) -> None:
    """Shows a page in a browser, or says that there is none."""
    if not webbrowser.open(page.resolve().as_uri()):
        print(f"no browser here; open {page} in one")


def refuse_arguments(argv: list[str]) -> None:
    """Refuses words on the command line that are no flags."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected arguments: {' '.join(argv[1:])}")
