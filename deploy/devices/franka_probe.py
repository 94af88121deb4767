"""Which control unit answers at an address, if any.

Where another program holds the arm, franky's own connection waits for ever, and stops every thread meanwhile;
and it cannot tell a Panda from an unsuitable library. So one `Connect` of Franka's published protocol
(libfranka-common, research_interface/robot/service_types.h) comes first.
"""

import socket
import struct

from ddgrasp.errors import UserError

ROBOT_PORT = 1337
ANSWER_S = 5.0
FIRST_FR3_VERSION = 6
"""Robot server version: a Panda's is at most 5, an FR3's at least this (libfranka's compatibility table)."""
_HEADER = struct.Struct("<III")
"""Command, its number, size of the whole message."""
_ANSWER = struct.Struct("<HH")
"""Status, robot server version."""
_CONNECT, _OUR_VERSION = 0, 10


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


def _server_version(host: str) -> int:
    try:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as states,
            socket.create_connection((host, ROBOT_PORT), ANSWER_S) as connection,
        ):
            states.bind(("", 0))  # where the unit sends its state
            request = struct.pack("<HH", _OUR_VERSION, states.getsockname()[1])
            connection.sendall(_HEADER.pack(_CONNECT, 0, _HEADER.size + len(request)) + request)
            answer = connection.makefile("rb").read(_HEADER.size + _ANSWER.size)
    except TimeoutError as error:
        raise UserError(
            f"the control unit at {host!r} does not answer within {ANSWER_S:g} s: end other programs that "
            "drive it (it takes one), and check --host."
        ) from error
    except OSError as error:
        raise UserError(
            f"no Franka at {host!r} ({error.strerror or error}): unlock the joints, activate FCI in Desk and "
            "check --host."
        ) from error
    if len(answer) < _HEADER.size + _ANSWER.size:
        raise UserError(f"the control unit at {host!r} refuses connections: activate FCI in Desk.")
    return _ANSWER.unpack(answer[_HEADER.size :])[1]
