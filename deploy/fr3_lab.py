"""An FR3 rig with someone beside it, who starts it, fills its table, and begins anew when it goes."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, TypeVar

from ddgrasp.config.deploy import DeployConfig, FrankaConfig
from ddgrasp.errors import Trouble, UserError
from deploy.clock import RobotClock
from deploy.devices.franka_faults import NO_FRANKA
from deploy.devices.franka_robot import LOST, FrankaRobot
from deploy.interfaces import CameraError, RobotError
from rig.fr3 import scene
from rig.fr3.channel import Channel, ChannelLost
from rig.fr3.process import Fr3Rig, check_ports

T = TypeVar("T")
Shapes = Literal["mesh", "primitive"]
DYNAMICS, START_DYNAMICS = 0.46, 0.3
"""Shares of the arm's limits: enough for every step that a policy may ask for, and a start of seconds."""
AWAY_M = (1.05, 0.0)
"""Where the object waits, on the table beyond the camera, while the arm goes to its start."""
SETTLE_S = 0.3
"""From when the object is put down to the first step."""
ATTEMPTS = 3
OF_THE_MACHINE = (LOST, NO_FRANKA, "does not answer", "did not end in")
"""What an error says that a busy machine makes, and a trial does not."""


class Fr3Lab:
    """One rig after the other; a rig runs as long as object and seed stay the same."""

    def __init__(self, shapes: Shapes, bare: bool = False):
        """`bare` leaves table, wall and clutter out: the arm stands on the floor."""
        self._shapes, self._bare = shapes, bare
        self.rig: Fr3Rig | None = None
        """The one that runs."""
        self._made: tuple[str, int] = ("", 0)

    def thing(self, name: str) -> scene.SceneObject:
        """The object of that name. Raises UserError for an unknown one."""
        return scene.meshed(name) if self._shapes == "mesh" else scene.primitive(name)

    def with_object(self, name: str, seed: int) -> Fr3Rig:
        """A running rig with that object, and clutter that follows from `seed`."""
        if self.rig is not None and self._made == (name, seed) and self.rig.running():
            return self.rig
        self.close()
        self.rig = Fr3Rig(free_host(), self.thing(name), seed=seed, bare=self._bare)
        self._made = name, seed
        return self.rig.__enter__()

    def repeated(self, attempt: Callable[[], T]) -> T:
        """What `attempt` returns; anew on a fresh rig where the connection is lost or the rig has gone.

        That says something of this machine and nothing of what was tried. Raises UserError if it happens
        `ATTEMPTS` times.
        """
        lost = ""
        for _ in range(ATTEMPTS):
            try:
                made = attempt()
                if self._is_up():
                    return made
                lost = "the FR3 rig has gone"
            except (ChannelLost, CameraError, RobotError, UserError) as error:
                lost = str(error)
                if self._is_up() and not any(sign in lost for sign in OF_THE_MACHINE):
                    raise
            self.close()
        raise Trouble(f"{lost} ({ATTEMPTS} times): end what else runs here, or use fewer --workers.")

    def close(self) -> None:
        """Ends the rig."""
        if self.rig is not None:
            self.rig.close()
        self.rig = None

    def _is_up(self) -> bool:
        return self.rig is None or self.rig.running()


class PlacingRobot(FrankaRobot):
    """Goes to its start with the object out of the way, which is then put down."""

    def __init__(self, config: FrankaConfig, clock: RobotClock, channel: Channel, place: dict[str, Any]):
        """`place` is what the side channel's request `place` takes."""
        super().__init__(config, clock, confirm=lambda question: None)
        self._channel, self._place, self._ticks = channel, place, clock
        clock.follow(self)

    def start(self) -> None:
        """See FrankaRobot."""
        x_m, y_m = AWAY_M
        self._channel.ask("place", x_m=x_m, y_m=y_m, yaw_rad=0.0)
        super().start()
        self._channel.ask("place", **self._place)
        self._ticks.sleep_until(self._ticks.now() + SETTLE_S)


def lab_config(config: DeployConfig, host: str) -> DeployConfig:
    """`config` for the rig at `host`."""
    franka = replace(
        config.franka, host=host, model="fr3", kernel="any", dynamics=DYNAMICS, start_dynamics=START_DYNAMICS
    )
    return replace(config, clock="robot", franka=franka)


def stopping_at(config: DeployConfig, contact: float) -> DeployConfig:
    """`config` for an arm that stops itself at `contact` newtons and newton metres at the hand, and at a
    torque on a joint that is to it as the configured ones are to each other, 1 to 100 N m.

    Raises UserError for a force that no arm takes.
    """
    torque_nm = contact * config.franka.contact_torque_nm / config.franka.contact_force_n
    torque_nm = min(max(torque_nm, 1.0), 100.0)
    franka = replace(config.franka, contact_force_n=contact, contact_torque_nm=torque_nm)
    return replace(config, franka=franka)


def free_host() -> str:
    """A loopback address at which no rig runs. Raises UserError if there is none."""
    for offset in range(200):
        host = f"127.0.{1 + os.getpid() % 200}.{2 + offset}"
        try:
            check_ports(host)
        except UserError:
            continue
        return host
    raise UserError("no loopback address is free for an FR3 rig: end the others.")
