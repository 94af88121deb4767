"""ddgrasp rig: the test rig's simulated arm, to be driven as one drives a real arm, and pictures of it."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from app.commands.checks import check_file
from ddgrasp.config.checks import Range, Seed
from ddgrasp.errors import Trouble
from ddgrasp.files import atomic_write_bytes
from ddgrasp.install import FR3, check_fr3
from deploy.devices.options import RIG_HOST

PRACTICE, PRACTISED = Path("runs/practice"), "calibration.json"
"""Folder of what is done on the rig, apart from an arm's own; a calibration in it."""


@dataclass(frozen=True)
class RigFr3:
    """Serve an FR3 with table, wall, clutter and one object on this machine, until Ctrl-C."""

    object_name: str = "cube"
    """What lies on the table: `ddgrasp objects list --meshes` names them (with --shapes primitive `ddgrasp
    objects list`)."""
    shapes: Literal["mesh", "primitive"] = "mesh"
    """mesh, or the development rig's primitives."""
    host: str = RIG_HOST
    """Address of this machine to listen on: ports 1337 to 1339."""
    seed: Seed = 0
    """Where object and clutter stand."""
    speed: Annotated[float, Range(0, 1, above=True)] = 1.0
    """Largest share of real time."""
    board: bool = False
    """The hand holds the board of `ddgrasp calibrate`."""

    def run(self) -> None:
        """Serves, and says how to drive it."""
        from rig.fr3 import scene
        from rig.fr3.process import Fr3Rig

        thing = (scene.meshed if self.shapes == "mesh" else scene.primitive)(self.object_name)
        with Fr3Rig(self.host, thing, self.seed, self.speed, with_board=self.board) as rig:
            drive = drive_command(self.host, self.board)
            print(f"FR3 at {self.host} before {self.object_name!r}. Drive it: {drive}", flush=True)
            while rig.running():
                time.sleep(0.2)
            raise Trouble(f"the FR3 rig at {self.host} has ended; what it said is above.")


def drive_command(host: str, board: bool) -> str:
    """How to drive the rig at `host`; what comes of it lies apart from an arm's own and another rig's."""
    kept = PRACTICE if host == RIG_HOST else PRACTICE / host
    calibration = kept / PRACTISED
    if board:
        return f"ddgrasp calibrate --host {host} --camera rig --out {calibration}"
    place = f" --calibration {calibration}" if calibration.exists() else ""
    deploy = f"ddgrasp deploy --policy FILE.onnx --robot franka --host {host} --camera rig"
    return f"{deploy} --out {kept}{place}"


@dataclass(frozen=True)
class RigPictures:
    """Draw the test rig for whoever sets up an arm: where the camera stands and what it sees, the board."""

    object_name: str = "apple"
    """What lies on the table; `ddgrasp objects list --meshes` names them."""
    out: Path = Path("mounting.png")
    """The picture's file."""

    def run(self) -> None:
        """Writes the picture and prints where it is."""
        check_file("--out", self.out)
        check_fr3("rig pictures", FR3[:1])
        from evaluation.rig_sheet import draw

        atomic_write_bytes(self.out, draw(self.object_name))
        print(self.out)
