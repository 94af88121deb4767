"""What keeps peers that speak no protocol of Franka's, or ask for nonsense, from taking the rig down.

franky-sim trusts its clients: an unknown command, a short message or a port that is none ends its loop, and
what is no number reaches the simulation. A server that is `Guarded` drops such a client and goes on.
"""

import logging
import socket
import struct
import time
from collections.abc import MutableMapping
from typing import Any

from franky_sim.franka_robot_protocol import UDPCommand
from franky_sim.franka_server import BaseCommand, FrankaServer

LARGEST = 1e9
"""In any unit: nothing that an arm is told has more, and the simulation begins anew from about 1e10."""
LONGEST = 1024
"""Bytes of a message; the longest request, of all thresholds, has 416."""
GREETED_S = 3.0
"""A client says within this that it is one of a Franka's; franky does at once. There is one place."""
_NONSENSE = (OSError, LookupError, ValueError, ArithmeticError, struct.error)

logger = logging.getLogger(__name__)


class Guarded(FrankaServer):
    """Goes before franky-sim's own server among the bases.

    Reaches into franky-sim 1.0.4 in the four places named `_Franka...` and `_Message...` below.
    """

    _silent_since_s: float | None = None

    def send_state(self) -> None:
        """See franky-sim; a client that cannot be told is dropped."""
        try:
            super().send_state()
        except BlockingIOError:  # it gets the next one
            pass
        except OSError as error:
            self._drop(error)

    def _FrankaServer__process_tcp_commands(self) -> None:
        try:
            super()._FrankaServer__process_tcp_commands()  # type: ignore[misc]
            self._check_length()
            self._check_greeting()
        except _NONSENSE as error:
            self._drop(error)

    def _setup_udp_connection(self, network_udp_port: int) -> None:
        super()._setup_udp_connection(network_udp_port)
        self._FrankaServer__udp_receiver = _Datagrams(self._FrankaServer__udp_socket)  # type: ignore[attr-defined]

    def _handle_udp_command(self, command_data: bytes) -> None:
        if is_sensible(UDPCommand.STRUCT.unpack(command_data)):
            super()._handle_udp_command(command_data)

    def _check_length(self) -> None:
        """Raises ValueError if the message that is being received will never end, or be far too long."""
        receiver = self._FrankaServer__tcp_receiver  # type: ignore[attr-defined]
        header = receiver and receiver._MessageReceiver__current_header
        if header and not 0 < header.payload_size <= LONGEST:
            raise ValueError(f"a message of {header.payload_size} bytes")

    def _check_greeting(self) -> None:
        """Raises ValueError if whoever is connected has not said for `GREETED_S` where states go."""
        if not self.tcp_connected or self.udp_connected:
            self._silent_since_s = None
        elif self._silent_since_s is None:
            self._silent_since_s = time.monotonic()
        elif time.monotonic() - self._silent_since_s > GREETED_S:
            raise ValueError(f"nothing said in {GREETED_S:g} s")

    def _drop(self, error: Exception) -> None:
        self._silent_since_s = None
        logger.warning("dropped a client that is none of a Franka's: %r", error)
        self.reset_state()


class _Datagrams:
    """Whole commands. franky-sim's own receiver takes them for a stream: a stray one would shift all that
    follow, an empty one end it."""

    def __init__(self, udp_socket: socket.socket):
        self._socket = udp_socket

    def receive(self, expected_size: int) -> bytes | None:
        """The next one of that size, None if there is none."""
        try:
            while len(data := self._socket.recv(65536)) != expected_size:
                pass
        except OSError:  # none is there
            return None
        return data


def check_numbers(commands: MutableMapping[Any, type[BaseCommand]]) -> None:
    """Has every command of a server's table raise ValueError for what is no number, or far too large."""
    commands.update({name: _checked(kind) for name, kind in commands.items()})


def is_sensible(value: Any) -> bool:
    """Whether all numbers in it, or in what it holds, are finite and of an arm's world."""
    if isinstance(value, list | tuple):
        return all(map(is_sensible, value))
    return not isinstance(value, float) or abs(value) <= LARGEST


def _checked(kind: type[BaseCommand]) -> type[BaseCommand]:
    class Checked(kind):
        @classmethod
        def from_bytes(cls, data: bytes, command_id: int, client_socket: socket.socket) -> BaseCommand:
            command = super().from_bytes(data, command_id, client_socket)
            if not all(map(is_sensible, vars(command).values())):
                raise ValueError(f"{kind.__name__} with what is no number, or too large")
            return command

    return Checked
