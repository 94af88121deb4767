"""Pictures of a rollout in a scratch file: whole episodes of many environments do not fit in memory."""

import os
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Shaped


class Spool:
    """Pictures of B environments, added step by step and read episode by episode.

    They lie in a file without a name, which is gone once nobody holds the spool, however the process ends.

    Args:
      directory: where the file is made; None takes the system's place for temporary files.
    """

    def __init__(self, directory: Path | None = None):
        self._file = tempfile.TemporaryFile(dir=directory)
        self._shape: tuple[int, ...] = ()
        self._dtype = np.dtype(np.uint16)
        self._steps = 0

    def __len__(self) -> int:
        """Steps added."""
        return self._steps

    def add(self, pictures: Shaped[np.ndarray, "B ..."]) -> None:
        """The next step's pictures, one of each environment; every step of the same shape and type."""
        self._shape, self._dtype = pictures.shape, pictures.dtype
        self._file.write(np.ascontiguousarray(pictures).data)
        self._steps += 1

    def episode(self, number: int, length: int) -> Shaped[np.ndarray, "{length} ..."]:
        """The first `length` pictures of environment `number`."""
        self._file.flush()
        made = np.empty((length, *self._shape[1:]), self._dtype)
        size = made[:1].nbytes
        for t in range(length):
            read_into(self._file.fileno(), made[t], (t * self._shape[0] + number) * size)
        return made


def read_into(file: int, array: np.ndarray, offset: int) -> None:
    """Fills the contiguous `array` from `offset` of the open `file` on; OSError if it ends before."""
    view = array.reshape(-1).view(np.uint8).data
    while view:
        if not (count := os.preadv(file, [view], offset)):
            raise OSError(f"ends before byte {offset + len(view)}")
        view, offset = view[count:], offset + count
