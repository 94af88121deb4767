"""Whether a control unit answers at all: franky's own connection waits for ever, and stops every thread, where
another program holds the arm.

One `Connect` of Franka's published protocol (libfranka-common, research_interface/robot/service_types.h).
"""

import socket
import struct

from ddgrasp.errors import UserError

ROBOT_PORT = 1337
ANSWER_S = 5.0
_HEADER = struct.Struct("<III")
"""Command, its number, size of the whole message."""
_CONNECT, _VERSION = 0, 10


def check_answers(host: str) -> None:
    """UserError unless a control unit at `host` answers a connection, whatever it says.

    The connection is given up at once: franky makes its own.
    """
    request = struct.pack("<HH", _VERSION, 0)
    try:
        with socket.create_connection((host, ROBOT_PORT), ANSWER_S) as connection:
            connection.sendall(_HEADER.pack(_CONNECT, 0, _HEADER.size + len(request)) + request)
            answered = bool(connection.recv(_HEADER.size))
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
    if not answered:
        raise UserError(f"the control unit at {host!r} refuses connections: activate FCI in Desk.")
