"""Starts the FR3 rig in a process of its own and ends it whatever happens."""

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from types import TracebackType

from ddgrasp.contract import HOME_RAD
from ddgrasp.errors import Trouble, UserError
from ddgrasp.install import FR3, check_fr3
from rig.fr3.channel import PORT, Channel
from rig.fr3.scene import SceneObject

PORTS = {1337: "robot", 1338: "gripper", PORT: "side channel"}
START_S, STOP_S = 180.0, 5.0


class Fr3Rig:
    """A running rig: `with Fr3Rig("127.0.0.1", primitive("cube")) as rig`.

    The process ends with the context, with an exception, with Ctrl-C (it is in a session of its own, so that
    the arm stays up while the loop brakes), and with the death of the process that started it.
    """

    def __init__(
        self,
        host: str,
        thing: SceneObject,
        seed: int = 0,
        speed: float = 1.0,
        q_rad: Sequence[float] = HOME_RAD,
        with_board: bool = False,
        bare: bool = False,
    ):
        """Starts nothing yet.

        `speed` is the largest share of real time, `q_rad` (7,) where the arm stands, `with_board` puts the
        calibration board into its hand, `bare` leaves table, wall and clutter out.

        Raises UserError: franky-sim is absent, a port is taken, or `speed` makes no sense.
        """
        if not 0.0 < speed <= 1.0:
            raise UserError(f"--speed is {speed:g}; expected above 0 and at most 1, real time.")
        check_fr3("the FR3 rig", FR3[:1])
        check_ports(host)
        self.host = host
        given = {"host": host, "seed": seed, "speed": speed, "q_rad": list(q_rad), "with_board": with_board}
        self._options = given | {"thing": asdict(thing), "bare": bare}
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: Channel | None = None

    def __enter__(self) -> "Fr3Rig":
        """Starts it and waits until it listens. Raises UserError if it does not."""
        command = [sys.executable, "-m", "rig.fr3.serve"]
        self._process = subprocess.Popen(
            command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )  # unbuffered: what `select` does not see is not there
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(self._options).encode() + b"\n")
            self._wait_until_ready()
            self._channel = Channel(self.host)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Ends it."""
        self.close()

    @property
    def channel(self) -> Channel:
        """The side channel; the rig must run."""
        assert self._channel is not None
        return self._channel

    @property
    def pid(self) -> int:
        """The process; the rig must run."""
        assert self._process is not None
        return self._process.pid

    def running(self) -> bool:
        """Whether the process lives."""
        return self._process is not None and self._process.poll() is None

    def close(self) -> None:
        """Ends the process: asked first, killed if it does not go."""
        if self._channel is not None:
            self._channel.close()
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()

    def kill(self) -> None:
        """End the process at once, as a power cut would."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def _wait_until_ready(self) -> None:
        assert self._process is not None and self._process.stdout is not None
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            if select.select([self._process.stdout], [], [], 0.2)[0]:
                line = self._process.stdout.readline()
                said = json.loads(line) if line.startswith(b"{") else {}
                if "ready" in said:
                    return
                if not line or "error" in said:
                    raise UserError(
                        f"the FR3 rig did not start at {self.host}: {said.get('error', 'see above')}."
                    )
        raise Trouble(f"the FR3 rig did not start at {self.host} within {START_S:g} s: is the machine busy?")


def check_ports(host: str) -> None:
    """UserError unless the rig's ports are free at `host`, which must be an address of this machine."""
    for port, purpose in PORTS.items():
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except (socket.gaierror, UnicodeError) as error:
                raise UserError(
                    f"--host {host!r} is no address of this machine: give a loopback one, 127.0.0.1 to "
                    "127.255.255.254."
                ) from error
            except OSError as error:
                raise UserError(
                    f"{host}:{port} ({purpose}) cannot be used ({os.strerror(error.errno or 0)}): stop what "
                    "listens there, or give another loopback address, --host 127.0.0.2."
                ) from error
