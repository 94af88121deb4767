"""Episodes on disk: Zarr, laid out like diffusion_policy's ReplayBuffer.

`data/<field>` holds all steps one after another, `meta/episode_ends` the index behind each episode's
last step, `meta/<field>` one row per episode. An episode counts once `episode_ends` names it, which
is written last: what a crash left behind it is cut off at the next opening.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import ArrayLike
from zarr.codecs import BloscCodec

from ddgrasp.artifacts import MANIFEST
from ddgrasp.attempts import STARTED
from ddgrasp.errors import UserError
from demos.row_reader import RowReader

_CODEC = BloscCodec(cname="zstd", clevel=3)
STORE = "episodes.zarr"
"""In the folder of stage `demos`."""
_INSIDE = (STORE, f"demos/{STORE}")
"""Where one lies in a stage's folder, and in a run's."""
_ENDS = "episode_ends"
_IMAGE_CHUNK = 16
_ROW_CHUNK = 4096
_GONE = (FileNotFoundError, NotADirectoryError)
"""What of the operating system's errors says that a store is damaged: no full disk, no lack of rights."""
_DAMAGED = (LookupError, ValueError, TypeError, ArithmeticError, RuntimeError, *_GONE)
"""What Zarr raises of damaged files: of descriptions that say what none can, it checks few."""


class EpisodeStore:
    """Append-only list of episodes; a folder.

    Args:
      create: make it if it is not there, to `append` to.
      compressed: what `append` writes; without, `reader` is quick, and pictures take up to 20 times the disk.
    """

    def __init__(self, path: Path | str, *, create: bool = False, compressed: bool = True):
        path = Path(path)
        self._codecs, self._is_whole, self._may_append = [_CODEC] if compressed else None, False, create
        if not create and not (path / "zarr.json").exists():
            inside = next((path / name for name in _INSIDE if (path / name / "zarr.json").exists()), None)
            remedy = f"open {inside}" if inside else "collect one with `ddgrasp demos collect`"
            raise UserError(f"{path} is no episode store: {remedy}.")
        try:
            self._root = zarr.open_group(str(path), mode="a" if create else "r")
            self._data = self._root.require_group("data") if create else _group(self._root, "data")
            self._meta = self._root.require_group("meta") if create else _group(self._root, "meta")
        except _DAMAGED as error:
            raise UserError(
                f"The episode store {path} is damaged ({error}): delete it and collect again."
            ) from None
        self.path = path

    @property
    def ends(self) -> np.ndarray:
        """(E,) index behind each episode's last step. Raises UserError if they are damaged."""
        with self._readable(f"meta/{_ENDS}"):
            if _ENDS not in self._meta:
                if any(_array(self._meta, name).shape[0] > 1 for name in self._meta.array_keys()):
                    raise ValueError("it is missing")
                return np.zeros(0, np.int64)
            rows = _array(self._meta, _ENDS)
            if rows.ndim != 1 or rows.dtype.kind not in "iu":
                raise ValueError(f"it is {rows.dtype} {rows.shape}, no list of numbers of steps")
            # Who is killed before the first row of a file is written leaves that row without it.
            sure = rows.shape[0] - ((rows.shape[0] - 1) % rows.chunks[0] == 0)
            _check_chunks(self.path / "meta" / _ENDS, rows, 0, sure)
            ends = np.asarray(rows[:])
        # The array grows before its row is written: who is killed in between leaves a zero.
        return ends[: np.count_nonzero(np.logical_and.accumulate(ends > 0))]

    def __len__(self) -> int:
        return len(self.ends)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the per-step arrays. Raises UserError if one is damaged."""
        with self._readable("data"):
            return tuple(sorted(self._data.array_keys()))

    def steps(self, field: str, first: int = 0, last: int | None = None) -> np.ndarray:
        """Per-step array of the complete episodes, or rows first..last of it, from 0 on.

        Raises UserError for a field that the store lacks, or if it is damaged.
        """
        count = _count(self.ends)
        if not 0 <= first <= count or (last is not None and last < first):
            end = "the end" if last is None else last
            raise UserError(f"{self.path}: no rows {first} to {end}; expected 0 to {count}.")
        return self._read("data", field, first, count if last is None else min(last, count))

    def episodes(self, field: str) -> np.ndarray:
        """Per-episode array. Raises UserError for a field that the store lacks, or if it is damaged."""
        return self._read("meta", field, 0, len(self))

    def reader(self, field: str) -> RowReader:
        """Rows of a per-step array at random; holds none of them. Raises UserError if it is damaged."""
        count = _count(self.ends)
        with self._readable(f"data/{field}"):
            rows = _array(self._data, field)
            _check_length(rows, count)
            return RowReader(self.path / "data" / field, rows)

    def _read(self, group: str, field: str, first: int, last: int) -> np.ndarray:
        with self._readable(f"{group}/{field}"):
            rows = _array(_group(self._root, group), field)
            _check_length(rows, last)
            _check_chunks(self.path / group / field, rows, first, last)
            return np.asarray(rows[first:last])

    @contextmanager
    def _readable(self, what: str) -> Iterator[None]:
        """UserError for what Zarr raises of damaged files."""
        try:
            yield
        except KeyError:
            group, _, field = what.partition("/")
            there = ", ".join(self._names(group)) or "nothing"
            raise UserError(
                f"{self.path} has no {field or group}: it has {there}. If it had, its files are gone: delete "
                f"{self._made_as()} and make it again."
            ) from None
        except _DAMAGED as error:
            raise UserError(
                f"{self.path}: {what} cannot be read ({error}). Delete {self._made_as()} and make it again."
            ) from None

    def _names(self, group: str) -> list[str]:
        try:
            return sorted(_group(self._root, group).array_keys())
        except _DAMAGED:
            return []

    def _made_as(self) -> Path:
        """What is made again as a whole: the stage that the store is of, or the store itself."""
        stage = self.path.parent
        return stage if any((stage / name).exists() for name in (MANIFEST, STARTED)) else self.path

    def append(self, steps: Mapping[str, np.ndarray], episode: Mapping[str, ArrayLike]) -> None:
        """Adds one episode: arrays (T, ...) per step and (...) per episode.

        Raises UserError, and leaves what is there, for steps of other fields, sizes or types than it has, for
        arrays of several lengths, and where the file that they go into is damaged.
        """
        self._check(steps)
        ends = self.ends
        start, length = _count(ends), len(next(iter(steps.values())))
        if start and not self._is_whole:  # what is written into, by whoever opened it
            for name in steps:
                self._read("data", name, start - 1, start)
            self._is_whole = True
        for name, value in steps.items():
            if name not in self._data:
                _create(self._data, name, value, self._codecs)
            _put(self._data, name, start, value)
        for name, value in episode.items():
            _put(self._meta, name, len(ends), np.asarray(value)[None])
        _put(self._meta, _ENDS, len(ends), np.array([start + length], np.int64))

    def _check(self, steps: Mapping[str, np.ndarray]) -> None:
        if not self._may_append:
            raise UserError(f"{self.path} was opened to be read: open it with create=True to add to it.")
        lengths = {name: len(rows) for name, rows in steps.items()}
        if len(set(lengths.values())) != 1:
            raise UserError(f"{self.path}: an episode's arrays are of one length, these are of {lengths}.")
        if len(self) and steps.keys() != set(self.fields):
            raise UserError(f"{self.path} has {', '.join(self.fields)}, not {', '.join(sorted(steps))}.")
        for name, rows in steps.items():
            with self._readable(f"data/{name}"):
                there = _array(self._data, name) if name in self._data else rows
            if there.shape[1:] != rows.shape[1:] or there.dtype != rows.dtype:
                raise UserError(
                    f"{self.path}: {name} is {there.dtype} {there.shape[1:]} per step, not {rows.dtype} "
                    f"{rows.shape[1:]}."
                )


def _group(parent: zarr.Group, name: str) -> zarr.Group:
    node = parent[name]
    if not isinstance(node, zarr.Group):
        raise ValueError(f"{name} is no group")
    return node


def _array(group: zarr.Group, name: str) -> zarr.Array:
    node = group[name]
    if not isinstance(node, zarr.Array):
        raise ValueError(f"{name} is no array")
    if node.chunks[0] < 1:
        raise ValueError(f"{name} has chunks of {node.chunks[0]} rows")
    return node


def _count(ends: np.ndarray) -> int:
    """Steps of all episodes with these ends."""
    return int(ends[-1]) if len(ends) else 0


def _check_length(rows: zarr.Array, least: int) -> None:
    """ValueError if there are fewer rows: Zarr would read those there are."""
    if rows.shape[0] < least:
        raise ValueError(f"it has {rows.shape[0]} rows of {least}")


def _check_chunks(path: Path, rows: zarr.Array, first: int, last: int) -> None:
    """ValueError if a file of rows first..last is gone: Zarr would read zeros instead."""
    size = rows.chunks[0]
    for i in range(first // size, -(-last // size)):
        name = "/".join(["c", str(i), *["0"] * (rows.ndim - 1)])
        if not (path / name).exists():
            raise ValueError(f"its file {name} is missing")


def _create(group: zarr.Group, name: str, rows: np.ndarray, codecs: list[BloscCodec] | None) -> None:
    """An empty array for rows like these."""
    image = rows.ndim >= 3
    chunks = (_IMAGE_CHUNK if image else _ROW_CHUNK, *rows.shape[1:])
    group.create_array(name, shape=(0, *rows.shape[1:]), chunks=chunks, dtype=rows.dtype, compressors=codecs)


def _put(group: zarr.Group, name: str, start: int, rows: np.ndarray) -> None:
    """Writes rows at `start`, cutting off whatever an interrupted append left from there on."""
    if name not in group:
        _create(group, name, rows, [_CODEC])
    # The setting is not kept in the store: without it Zarr drops a chunk that an append leaves all zeros.
    array = _array(group, name).with_config({"write_empty_chunks": True})
    array.resize((start + len(rows), *rows.shape[1:]))
    array[start:] = rows
