"""Scalars for TensorBoard."""

import os
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.summary import scalar


class ScalarLog:
    """One new event file, in which every scalar is on the disk when `write` returns.

    It stands in for tensorboardX's SummaryWriter, which writes from a thread of its own: what is
    queued there is lost to a kill, and on a full disk the thread ends and the queue blocks.
    """

    def __init__(self, folder: str | os.PathLike, purge_step: int | None = None):
        """Opens the file.

        Args:
            folder: where the file goes; made when missing.
            purge_step: step from which on TensorBoard is to forget the folder's earlier files.
        """
        Path(folder).mkdir(parents=True, exist_ok=True)
        # The name has whole seconds only, and two files of the same second would be one.
        self._writer = EventsWriter(str(Path(folder) / "events"), f".{time.time_ns()}")
        if purge_step is not None:
            start = SessionLog(status=SessionLog.START)
            self._writer.write_event(
                Event(wall_time=time.time(), step=purge_step, session_log=start)
            )

    def write(self, step: int, scalars: Mapping[str, float]) -> None:
        """Writes the scalars of one step."""
        for tag, value in scalars.items():
            self._writer.write_event(
                Event(wall_time=time.time(), step=step, summary=scalar(tag, value))
            )
        self._writer.flush()

    def close(self) -> None:
        """Closes the file."""
        self._writer.close()
