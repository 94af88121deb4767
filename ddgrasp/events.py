"""Scalars as TensorBoard's events, written by whoever has them.

tensorboardX's own SummaryWriter hands them to a thread. On a full disk that thread ends without a word, and
ten points later the training waits for it for ever.
"""

import time
from pathlib import Path
from typing import Any

_FLUSH_PERIOD_S = 30.0
"""What TensorBoard shows is at most so old."""


class ScalarEvents:
    """One file of events in `directory`. The first error ends it, and is kept in `trouble`."""

    def __init__(self, directory: Path, suffix: str = ""):
        self.trouble = ""
        self._flushed = time.monotonic()
        try:
            from tensorboardX.event_file_writer import EventsWriter

            directory.mkdir(parents=True, exist_ok=True)
            self._file = EventsWriter(str(directory / "events"), suffix)
        except OSError as error:
            self.trouble = str(error)

    def add(self, step: int, name: str, value: float) -> None:
        """One point of the curve `name`."""
        if self.trouble:
            return
        from tensorboardX.proto import event_pb2
        from tensorboardX.summary import scalar

        event: Any = event_pb2
        try:
            self._file.write_event(event.Event(wall_time=time.time(), step=step, summary=scalar(name, value)))
            if time.monotonic() - self._flushed > _FLUSH_PERIOD_S:
                self._file.flush()
                self._flushed = time.monotonic()
        except OSError as error:
            self.trouble = str(error)

    def close(self) -> None:
        """Writes what is left."""
        try:
            if not self.trouble:
                self._file.close()
        except OSError as error:
            self.trouble = str(error)
