"""Whether a control unit answers at all.

Where another program holds the arm, franky's own connection waits for
ever and stops every thread meanwhile.

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
    try:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as states,
            socket.create_connection((host, ROBOT_PORT), ANSWER_S) as connection,
        ):
            states.bind(("", 0))  # where the unit sends its state
            request = struct.pack("<HH", _VERSION, states.getsockname()[1])
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
