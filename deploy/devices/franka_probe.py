"""Which control unit answers at an address, if any, and whether its hand does.

Where another program holds the arm, or what answers is no Franka, franky's own connection waits for ever, and
stops every thread meanwhile; and it cannot tell a Panda from an unsuitable library. So one `Connect` of
Franka's published protocol (libfranka-common, research_interface/robot/service_types.h and gripper/types.h)
comes first.
"""

import socket
import struct

from ddgrasp.errors import UserError

ROBOT_PORT, GRIPPER_PORT = 1337, 1338
ANSWER_S = 5.0
FIRST_FR3_VERSION = 6
"""Robot server version: a Panda's is at most 5, an FR3's at least this (libfranka's compatibility table)."""
_HEADER, _GRIPPER_HEADER = struct.Struct("<III"), struct.Struct("<HII")
"""Command, its number, size of the whole message."""
_ANSWER = struct.Struct("<HH")
"""Status, server version."""
_STATUSES = (0, 1)
"""Success, incompatible version."""
_LONGEST = 256
"""Bytes of an answer to `Connect`; a control unit's has two dozen."""
_CONNECT, _NUMBER, _OUR_VERSION, _OUR_GRIPPER_VERSION = 0, 0, 10, 3


def check_arm(host: str, model: str) -> None:
    """UserError unless a control unit answers at `host` that can be `model`'s (fr3 or panda).

    The connection is given up at once: franky makes its own.
    """
    version = _server_version(host)
    found = "fr3" if version >= FIRST_FR3_VERSION else "panda"
    if found != model:
        raise UserError(
            f"the arm at {host!r} is a {found!r} (robot server version {version}), deploy.franka.model is "
            f"{model!r}: set deploy.franka.model {found}; joint limits differ."
        )


def check_hand(host: str) -> None:
    """Raises OSError unless the gripper of the control unit at `host` answers, UserError if what answers is
    none; given up at once as well."""
    if len(_answer(host, GRIPPER_PORT, _GRIPPER_HEADER, _OUR_GRIPPER_VERSION)) < _ANSWER.size:
        raise OSError("it refuses connections")


def _answer(host: str, port: int, header: struct.Struct, version: int) -> bytes:
    """What the server at `port` answers to `Connect`, without its header; nothing if it hangs up.

    Raises OSError; UserError for an answer that is none of a Franka's.
    """
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as states,
        socket.create_connection((host, port), ANSWER_S) as connection,
    ):
        states.bind(("", 0))  # where the server sends its state
        request = struct.pack("<HH", version, states.getsockname()[1])
        connection.sendall(header.pack(_CONNECT, _NUMBER, header.size + len(request)) + request)
        said = connection.makefile("rb").read(header.size + _ANSWER.size)
    if said and not _is_answer(said, header):
        raise UserError(
            f"what answers at {host}:{port} is no Franka (it said {said!r}): check --host, which "
            "has to be the address of the arm's control unit."
        )
    return said[header.size :]


def _is_answer(said: bytes, header: struct.Struct) -> bool:
    """Whether it begins as an answer to our `Connect`: its command and number, a fitting size, a status."""
    shortest = header.size + _ANSWER.size
    if len(said) < shortest:
        return False
    command, number, size = header.unpack_from(said)
    status, _ = _ANSWER.unpack_from(said, header.size)
    return (command, number) == (_CONNECT, _NUMBER) and shortest <= size <= _LONGEST and status in _STATUSES


def _server_version(host: str) -> int:
    try:
        answer = _answer(host, ROBOT_PORT, _HEADER, _OUR_VERSION)
    except TimeoutError as error:
        raise UserError(
            f"the control unit at {host!r} does not answer within {ANSWER_S:g} s: end other programs that "
            "drive it (it takes one), and check --host."
        ) from error
    except (OSError, UnicodeError) as error:  # a name with two dots in a row is no text that IDNA knows
        said = getattr(error, "strerror", None) or error
        raise UserError(
            f"no Franka at {host!r} ({said}): unlock the joints, activate FCI in Desk and check --host."
        ) from error
    if len(answer) < _ANSWER.size:
        raise UserError(f"the control unit at {host!r} refuses connections: activate FCI in Desk.")
    return _ANSWER.unpack(answer)[1]
