"""A second place for what a run logs: Weights & Biases, imported only when it is asked for."""

import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from represent_jax.errors import RepresentError


class Tracker(Protocol):
    """Takes the scalars that a run logs, those of its event files."""

    def write(self, stage: str, step: int, scalars: Mapping[str, float]) -> None:
        """Takes the scalars of one step of a stage."""

    def close(self) -> None:
        """Ends the log."""


class WandbTracker:
    """Logs to a project of Weights & Biases, from the first scalars on.

    A resumed run goes on in the same log: its id is kept in the run's folder, where W&B keeps its
    own files too. `WANDB_MODE=offline` keeps everything there.
    """

    def __init__(
        self,
        project: str,
        folder: str | os.PathLike,
        name: str,
        config: Mapping[str, Any],
        group: str | None = None,
    ):
        """Checks that the package is there; nothing is sent yet.

        Args:
          project: the project.
          folder: the run's folder.
          name: what people see.
          config: settings of the run; JSON.
          group: what runs that belong together share.

        Raises:
          RepresentError: wandb is not installed.
        """
        try:
            import wandb
        except ImportError as error:
            raise RepresentError(
                "Weights & Biases needs an extra package: pip install 'represent_jax[wandb]'"
            ) from error
        self._wandb = wandb
        self._folder = Path(folder)
        self._settings = dict(project=project, name=name, config=dict(config), group=group)
        self._run: Any = None
        self._stages: set[str] = set()

    def write(self, stage: str, step: int, scalars: Mapping[str, float]) -> None:
        """Takes the scalars of one step as `<stage>/<name>`, against `<stage>/step`."""
        if self._run is None:
            self._run = self._start()
        if stage not in self._stages:
            self._run.define_metric(f"{stage}/*", step_metric=f"{stage}/step")
            self._stages.add(stage)
        tagged = {f"{stage}/{name}": value for name, value in scalars.items()}
        self._run.log({**tagged, f"{stage}/step": step})

    def close(self) -> None:
        """Ends the log, if anything was logged."""
        if self._run is not None:
            self._run.finish()
            self._run = None

    def _start(self) -> Any:
        known = self._folder / "wandb" / "id"
        known.parent.mkdir(parents=True, exist_ok=True)
        if not known.is_file():
            known.write_text(secrets.token_hex(4))
        return self._wandb.init(
            id=known.read_text(),
            resume="allow",
            dir=str(self._folder),
            reinit="finish_previous",
            **self._settings,
        )
