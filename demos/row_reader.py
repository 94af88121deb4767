"""Single rows of a store's field, anywhere in it, read without the rest of their chunk.

A batch of stacks of three frames at random places took 210 ms from compressed chunks of 16 frames, which are
decoded whole for each stack, 10 ms from chunks without compression and 11 ms from memory (64 stacks of
180 x 320 pixels, two busy AMD EPYC cores, 2026-11-22, provisional). What was read lately stays in the
system's file cache as far as there is room.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import zarr
from jaxtyping import Int, Shaped

from ddgrasp.errors import UserError
from demos.spool import read_into


class RowReader:
    """Random access to a Zarr array (N, ...) that is chunked along its first axis alone.

    Compressed arrays are read by Zarr, and slowly. May be used in several threads at once.
    """

    def __init__(self, path: Path, array: zarr.Array):
        self._path, self._array = path, array
        self._chunk = array.chunks[0]
        self._plain = not array.compressors and array.shards is None and array.dtype.byteorder != ">"

    @property
    def shape(self) -> tuple[int, ...]:
        """(N, ...)."""
        return self._array.shape

    def __len__(self) -> int:
        return self._array.shape[0]

    def read(self, index: Int[np.ndarray, " n"]) -> Shaped[np.ndarray, "n ..."]:
        """Rows `index` (n,) in that order; UserError if a file of them is gone or cut short, IndexError for a
        row that there is none of."""
        if len(index) and not 0 <= index.min() <= index.max() < len(self):
            raise IndexError(f"rows {index.min()} to {index.max()} of {len(self)}")
        made = np.empty((len(index), *self._array.shape[1:]), self._array.dtype)
        for first, last in self._runs(index):
            row = int(index[first])
            if self._plain:
                self._read_plain(row, made[first:last])
            else:
                made[first:last] = self._array[row : row + last - first]
        return made

    def _runs(self, index: np.ndarray) -> Iterator[tuple[int, int]]:
        """(first, last) positions in `index` of rows that follow each other within one chunk."""
        if not len(index):
            return
        new = (np.diff(index) != 1) | (index[1:] % self._chunk == 0)
        bounds = [0, *(np.flatnonzero(new) + 1).tolist(), len(index)]
        yield from zip(bounds[:-1], bounds[1:], strict=True)

    def _read_plain(self, row: int, made: np.ndarray) -> None:
        number, within = divmod(row, self._chunk)
        path = self._path.joinpath("c", str(number), *["0"] * (made.ndim - 1))
        try:
            file = os.open(path, os.O_RDONLY)
            try:
                read_into(file, made, within * made[:1].nbytes)
            finally:
                os.close(file)
        except OSError as error:
            raise UserError(
                f"{path} cannot be read ({error.strerror or error}): delete the store, or the stage that "
                "it is of, and make it again."
            ) from None
