"""The rig's own process: `python -m rig.fr3.serve`, started by `rig.fr3.process`.

Its options are the first line of its standard input. It lives as long as that is open, so it goes with
whoever started it, however that ended.
"""

import contextlib
import json
import os
import queue
import reprlib
import socketserver
import sys
import threading
import time
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Any

import numpy as np
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MujocoSimulator

from rig.fr3 import channel, scene
from rig.fr3.reflex import ReflexServer

TICK_S = 0.001
COMMAND_WAIT_S = 0.05
SLOW_TICK_S = 0.05
"""Wall-clock time of a tick while somebody takes a picture: time nearly stands still, and the client, which
gives up after a second without a state, goes on hearing of the arm."""
FURTHEST_M, LARGEST_RAD, LONGEST_AWAY_S = 100.0, 1e3, 3600.0
"""What a request may ask for: MuJoCo begins a world anew in which something is far beyond that."""


@dataclass(frozen=True)
class Options:
    """One rig; plain values."""

    host: str
    thing: dict[str, Any]
    """Fields of `scene.SceneObject`."""
    seed: int
    speed: float
    """Largest share of real time; the machine may give less."""
    q_rad: list[float]
    """Where the arm stands when it is switched on."""
    with_board: bool = False
    """Whether the hand holds the calibration board."""
    bare: bool = False
    """Whether table, wall and clutter are left out."""


class Rig:
    """The simulated arm and what stands around it, advanced a millisecond at a time."""

    def __init__(self, options: Options):
        self._options = options
        self.thing = scene.SceneObject(**options.thing)
        self._sim = MujocoSimulator()
        self._robot = self._sim.add_robot(initial_q=options.q_rad, initial_hand_width=0.08)
        scene.furnish(self._sim.scene, self.thing, options.seed, options.bare)
        if options.with_board:
            from rig.fr3.board import hold
            from sensors.charuco_board import CharucoBoard

            hold(self._sim.scene, CharucoBoard(), options.seed)
        self._xml = ET.tostring(self._sim.scene, encoding="unicode")
        _drop_visuals(self._sim.scene)
        self._server = _Server(self._sim, options.host)
        self._requests: queue.Queue[tuple[dict[str, Any], queue.Queue[dict[str, Any]]]] = queue.Queue()
        self._away_until_s = 0.0
        self._slow = False

    def run(self, stop: threading.Event) -> None:
        """Serves until `stop` is set. Raises OSError if a port is taken."""
        with self._sim, self._server:
            self._tick()  # whoever asks finds an arm that has a state
            with _listen(self._options.host, self.request):
                print(json.dumps({"ready": self._options.host}), flush=True)
                with contextlib.suppress(OSError):  # without a stderr
                    os.dup2(2, 1)  # nobody reads on: what a library prints may not fill the pipe
                while not stop.is_set():
                    self._tick()

    def request(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Hands a request to the simulating thread and waits for what it answers."""
        answer: queue.Queue[dict[str, Any]] = queue.Queue(1)
        self._requests.put((asked, answer))
        return answer.get()

    def answer(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Requests: scene, state, place (x_m, y_m, yaw_rad), slow (on), disconnect (seconds)."""
        match asked["ask"]:
            case "scene":
                return {"xml": self._xml, "object": self.thing.name}
            case "state":
                return self._state()
            case "place":
                x_m, y_m = (_number(asked, name, FURTHEST_M) for name in ("x_m", "y_m"))
                return self._place(x_m, y_m, _number(asked, "yaw_rad", LARGEST_RAD))
            case "slow":
                self._slow = _truth(asked, "on")
                return {}
            case "disconnect":
                seconds = _number(asked, "seconds", LONGEST_AWAY_S)
                self._server.disconnect()
                self._away_until_s = time.monotonic() + seconds
                return {}
        return {channel.REFUSED: f"{reprlib.repr(asked)}, which it does not know"}

    def _tick(self) -> None:
        while not self._requests.empty():
            asked, answer = self._requests.get()
            try:
                answer.put(self.answer(asked))
            except (KeyError, TypeError, ValueError) as error:  # a request may not take the arm down
                answer.put({channel.REFUSED: f"{reprlib.repr(asked)} ({error!r})"})
        if time.monotonic() < self._away_until_s:
            self._server.hold_once()
            return
        self._server.reconnect()
        self._server.run_once(1.0 / self._options.speed)
        assert self._sim.model is not None and self._sim.data is not None
        self._server.robot_server.watch(self._sim.model, self._sim.data)
        self._server.robot_server.wait_for_command(COMMAND_WAIT_S)
        if self._slow:
            self._wait_for_request(SLOW_TICK_S)

    def _wait_for_request(self, seconds: float) -> None:
        """Somebody who is drawing may be done."""
        end = time.monotonic() + seconds
        while self._requests.empty() and time.monotonic() < end:
            time.sleep(TICK_S)

    def _state(self) -> dict[str, Any]:
        data, server = self._sim.data, self._server.robot_server
        assert data is not None
        return {
            "time_s": data.time,
            "qpos": data.qpos.tolist(),
            "q_rad": list(self._robot.inner_state.q),
            "object_position_m": data.body(scene.OBJECT_BODY).xpos.tolist(),
            "error": server.error,
            "in_motion": bool(server.current_motion_id),
        }

    def _place(self, x_m: float, y_m: float, yaw_rad: float) -> dict[str, Any]:
        """The object put down by a person: upright, at rest."""
        assert self._sim.data is not None
        joint = self._sim.data.joint(scene.OBJECT_JOINT)
        quat = (np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2))
        joint.qpos[:] = (x_m, y_m, self.thing.rest_height_m, *quat)
        joint.qvel[:] = 0.0
        return {}


class _Server(SimulationServer):
    """franky-sim's loop around one robot with reflexes, whose network can fail."""

    def __init__(self, sim: MujocoSimulator, host: str):
        super().__init__(sim, [host])
        self._host = host
        self._connected = True

    def init(self) -> None:
        self.robot_server = ReflexServer(self.sim.robots[0], [self._host])
        self.robot_server.init()
        self.robot_servers.append(self.robot_server)
        self.sim.start()

    def disconnect(self) -> None:
        """Drop the clients and listen to nobody; the arm holds."""
        gripper = self.robot_server.gripper_server
        for server in (self.robot_server, gripper):
            assert server is not None
            server.reset_state()
        self.robot_server.cleanup()
        self._connected = False

    def hold_once(self) -> None:
        """One tick of an arm that nobody can reach."""
        self.robot_server.hold()
        self.sim.step()
        time.sleep(TICK_S)

    def reconnect(self) -> None:
        """Listen again, if `disconnect` came before."""
        if not self._connected:
            self.robot_server.init()
        self._connected = True


def _drop_visuals(root: ET.Element) -> None:
    """Without the geoms that only show: compiling their meshes takes most of a start."""
    for parent in root.iter():
        for geom in [child for child in parent if child.get("class") == "visual"]:
            parent.remove(geom)
    used = {geom.get("mesh") for geom in root.iter("geom")}
    assets = root.find("asset")
    assert assets is not None
    for mesh in [mesh for mesh in assets if mesh.tag == "mesh" and mesh.get("name") not in used]:
        assets.remove(mesh)


def _number(asked: dict[str, Any], name: str, largest: float) -> float:
    """That field. Raises KeyError without it, ValueError unless it is a number of at most that size."""
    value = asked[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= largest:
        raise ValueError(f"{name} is {reprlib.repr(value)}, expected a number up to {largest:g}")
    return float(value)


def _truth(asked: dict[str, Any], name: str) -> bool:
    """That field. Raises KeyError without it, ValueError unless it is true or false."""
    if not isinstance(asked[name], bool):
        raise ValueError(f"{name} is {reprlib.repr(asked[name])}, expected true or false")
    return asked[name]


def _listen(host: str, request: Any) -> socketserver.ThreadingTCPServer:
    """The side channel's listener, running; leaving its context ends it."""

    class Handler(socketserver.StreamRequestHandler):
        slowed = False

        def handle(self) -> None:
            try:
                with contextlib.suppress(OSError):  # whoever asked has gone
                    self._serve()
            finally:
                if self.slowed:  # who asked for it has gone
                    request({"ask": "slow", "on": False})

        def _serve(self) -> None:
            while line := self.rfile.readline(channel.LONGEST_REQUEST + 1):
                self.wfile.write(json.dumps(self._answer(line)).encode() + b"\n")
                if len(line) > channel.LONGEST_REQUEST:  # what follows is the rest of it
                    return

        def _answer(self, line: bytes) -> dict[str, Any]:
            try:
                asked = channel.parsed(line)
            except ValueError as error:
                return {channel.REFUSED: f"{line[:40]!r} ({error!r})"}
            self.slowed = asked.get("on") if asked.get("ask") == "slow" else self.slowed
            return request(asked)

    class Listener(socketserver.ThreadingTCPServer):
        allow_reuse_address, daemon_threads, block_on_close = True, True, False

    listener = Listener((host, channel.PORT), Handler)
    threading.Thread(target=listener.serve_forever, args=(0.05,), daemon=True).start()
    return listener


def main() -> int:
    """Serves until standard input ends; 2 with one line of JSON if it cannot."""
    options = Options(**json.loads(sys.stdin.readline()))
    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    try:
        Rig(options).run(stop)
    except OSError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
