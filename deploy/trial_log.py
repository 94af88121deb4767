"""Finished trials on disk, so that an interrupted series goes on where it was."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ddgrasp.config_hash import differences
from ddgrasp.errors import UserError
from ddgrasp.files import DAMAGED_JSON, atomic_write_text
from deploy.trials import TrialResult

CONFIG_HASH = "config_hash"
"""What a header calls the hash of the configuration, or those that it may have."""


class TrialLog:
    """Finished trials on disk, one JSON line each behind a header; a torn last line is dropped.

    The file comes with the first trial: one without any, as it was written once, belongs to nobody.
    """

    def __init__(self, path: Path, header: dict[str, Any]):
        """Read what is there. Raises UserError, which says what differs, if it belongs to another policy,
        configuration or rule.

        Args:
            header: what the trials belong to: the policy and the configuration, whose hash may be several,
                of which a new log has the first, one that is there its own (`config_hashes`).
        """
        there, results = read_log(path)
        self._path, self._header = path, _as_had(header, there)
        _check_own(path, self._header, there, results)
        self.results = {result.key: result for result in results}
        if self.results:
            self._write(self.results)  # so that the next line starts on a line of its own

    def append(self, result: TrialResult) -> None:
        """Add a finished trial; it is on the disk when this returns.

        Raises UserError if others have begun the file meanwhile, as `__init__` does.
        """
        if not self.results:
            results = {**self._read(), result.key: result}
            self._write(results)
            self.results = results  # not before: a write that was interrupted has left no file to add to
            return
        with open(self._path, "a") as file:
            file.write(_line(asdict(result)))
            file.flush()
            os.fsync(file.fileno())
        self.results[result.key] = result

    def _read(self) -> dict[tuple[int, bool], TrialResult]:
        return {result.key: result for result in read_own(self._path, self._header)}

    def _write(self, results: Mapping[tuple[int, bool], TrialResult]) -> None:
        lines = [self._header, *map(asdict, results.values())]
        atomic_write_text(self._path, "".join(map(_line, lines)))


def _as_had(header: dict[str, Any], there: Mapping[str, Any]) -> dict[str, Any]:
    """`header` with one hash of its configuration: that of the log, where it is one of them."""
    hashes, had = header.get(CONFIG_HASH), there.get(CONFIG_HASH)
    if not isinstance(hashes, list):
        return header
    return header | {CONFIG_HASH: had if had in hashes else hashes[0]}


def load(path: Path | str) -> tuple[dict[str, Any], list[TrialResult]]:
    """`read_log` of a log that is to be there; UserError without one."""
    if not Path(path).is_file():
        raise UserError(f"{path} is no log of trials: name a trials.jsonl, of `ddgrasp deploy trials`.")
    return read_log(Path(path))


def read_own(path: Path, header: dict[str, Any]) -> list[TrialResult]:
    """The finished trials in a log. Raises UserError, which says what differs, if they belong to something
    else than `header` says."""
    there, results = read_log(path)
    _check_own(path, _as_had(header, there), there, results)
    return results


def _check_own(
    path: Path, header: Mapping[str, Any], there: Mapping[str, Any], results: Sequence[TrialResult]
) -> None:
    if results and there != header:
        others = ", ".join(differences(there, header))
        raise UserError(
            f"{path} was begun otherwise: {others}. Choose another --out, or delete {path.parent} and its "
            f"{len(results)} trials."
        )


def read_log(path: Path) -> tuple[dict[str, Any], list[TrialResult]]:
    """(what the trials in a log belong to, the finished ones, each once); empty both if there is no log.

    Raises UserError if the file holds something else.
    """
    lines = _complete_lines(path)
    try:
        header, results = dict(next(lines, {})), [TrialResult(**line) for line in lines]
        return header, list({result.key: result for result in results}.values())
    except (TypeError, ValueError):  # no mapping, or one with other fields
        raise UserError(
            f"{path} is no log of trials (other fields than `ddgrasp deploy trials` writes): name another "
            "folder, or move the file away."
        ) from None


def _line(value: dict[str, Any]) -> str:
    return json.dumps(value, allow_nan=False) + "\n"


def _complete_lines(path: Path) -> Iterator[dict[str, Any]]:
    """All but the last if it is torn. Raises UserError for one torn before it: nothing is thrown away."""
    if not path.exists():
        return
    lines = path.read_text(errors="replace").splitlines()
    for number, text in enumerate(lines, 1):
        try:
            yield json.loads(text)
        except DAMAGED_JSON:
            if number == len(lines):
                return
            raise UserError(
                f"{path}: line {number} of {len(lines)} is damaged, as by two series at once: take it out, "
                "and its trial is run again."
            ) from None
