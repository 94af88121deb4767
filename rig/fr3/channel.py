"""The rig's side channel: the scene, its true state, and what a person beside an arm can do to it.

One line of JSON asks, one answers. The loop, the driver and the safety filter never see it: it is for the
rig's camera, for judging success and for the tests.
"""

import contextlib
import json
import reprlib
import socket
from collections.abc import Iterator
from typing import Any, TypeGuard

from ddgrasp.errors import UserError
from ddgrasp.files import is_number

PORT = 1339
"""Beside the protocol's own: 1337 is the robot's, 1338 the gripper's."""
CONNECT_S, ANSWER_S = 2.0, 20.0
LONGEST_REQUEST = 65536
"""Bytes of a line that asks."""
LONGEST_ANSWER = 2**24
"""Bytes of a line that answers; the scene of a meshed object has some 150,000."""
_LONGEST_REFUSAL = 300
"""Letters of one that are repeated."""
REFUSED = "refused"
"""The key of an answer that is none: what was asked, and why not."""


def parsed(line: bytes) -> dict[str, Any]:
    """The object that a line of JSON says. Raises ValueError for a line that says none."""
    try:
        said = json.loads(line.decode())
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(said, dict):
        raise ValueError("it is no object")
    return said


class ChannelLost(Exception):
    """The rig does not answer any more."""


class Channel:
    """A connection to a running rig. Raises UserError if there is none at `host`."""

    def __init__(self, host: str):
        self._host = host
        try:
            self._socket = socket.create_connection((host, PORT), CONNECT_S)
        except (OSError, UnicodeError) as error:
            raise UserError(
                f"no FR3 rig at {host!r} ({getattr(error, 'strerror', None) or error}): start one, "
                f"`ddgrasp rig fr3 --host {host}`."
            ) from error
        self._socket.settimeout(ANSWER_S)
        self._file = self._socket.makefile("rwb")
        self._holding = 0

    def scene(self) -> dict[str, Any]:
        """What stands in the rig, to be pictured. Raises UserError if the rig does not answer."""
        try:
            return self.ask("scene")
        except ChannelLost as error:
            raise UserError(f"{error}: start it again, `ddgrasp rig fr3 --host {self._host}`.") from error

    def ask(self, what: str, **values: Any) -> dict[str, Any]:
        """The answer to one request; see `rig.fr3.serve.Rig.answer`.

        Raises ChannelLost; UserError for a request that the rig refuses, or if what answers is no rig.
        """
        try:
            self._file.write(json.dumps({"ask": what, **values}).encode() + b"\n")
            self._file.flush()
            line = self._file.readline(LONGEST_ANSWER + 1)
        except OSError as error:
            raise ChannelLost(f"the FR3 rig does not answer ({error})") from error
        if not line:
            raise ChannelLost("the FR3 rig has gone")
        answer = _answer(line)
        if answer is not None and REFUSED in answer:
            raise UserError(f"the FR3 rig refuses {_one_line(answer[REFUSED])}: is it of another version?")
        if answer is None or not _is_whole(what, answer):
            raise UserError(
                "What answers there is no FR3 rig: name its address, on this machine --host 127.0.0.1."
            )
        return answer

    @contextlib.contextmanager
    def time_held(self) -> Iterator[None]:
        """The rig's time nearly stands still meanwhile: a picture takes long, which is not the arm's doing.

        One within another ends with that. That the rig is gone, whoever asks for something next hears.
        """
        self._holding += 1
        try:
            if self._holding == 1:
                with contextlib.suppress(ChannelLost):
                    self.ask("slow", on=True)
            yield
        finally:
            self._holding -= 1
            if not self._holding:
                with contextlib.suppress(ChannelLost):
                    self.ask("slow", on=False)

    def close(self) -> None:
        """Ends the connection."""
        with contextlib.suppress(OSError):
            self._file.close()  # which holds it open as well
        self._socket.close()


def _answer(line: bytes) -> dict[str, Any] | None:
    """What the line says, None if it is too long or says no object."""
    if len(line) > LONGEST_ANSWER:
        return None
    try:
        return parsed(line)
    except ValueError:
        return None


def _one_line(refusal: Any) -> str:
    text = refusal if isinstance(refusal, str) else reprlib.repr(refusal)
    return " ".join(text.split())[:_LONGEST_REFUSAL]


def _is_whole(what: str, answer: dict[str, Any]) -> bool:
    """Whether the answer to `what` has what a camera looks for."""
    match what:
        case "scene":
            return all(isinstance(answer.get(name), str) for name in ("xml", "object"))
        case "state":
            place = answer.get("object_position_m")
            return _are_numbers(answer.get("qpos")) and _are_numbers(place) and len(place) == 3
    return True


def _are_numbers(values: Any) -> TypeGuard[list[float]]:
    """Whether it is a list of numbers that a float can hold."""
    return isinstance(values, list) and all(map(is_number, values))
