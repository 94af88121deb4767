"""ddgrasp calibrate: where the camera stands, measured as in a lab."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from app.commands.base import say
from app.commands.checks import check_file
from ddgrasp.config import Config
from ddgrasp.config.checks import Range
from ddgrasp.config.sensors import MarkerDictionary
from ddgrasp.errors import UserError

if TYPE_CHECKING:
    from sensors.charuco_board import CharucoBoard


@dataclass(frozen=True)
class BoardOptions:
    """A ChArUco board; measure the squares on the print."""

    columns: int = 5
    """Squares across."""
    rows: int = 7
    """Squares down."""
    square_mm: float = 30.0
    """Side of a square."""
    marker_mm: float = 22.0
    """Side of a marker."""
    dictionary: MarkerDictionary = "DICT_4X4_50"
    """OpenCV's name of the set of markers."""

    def made(self) -> "CharucoBoard":
        """With metres. Raises UserError for measures that cannot be."""
        from sensors.charuco_board import CharucoBoard

        return CharucoBoard(
            self.columns, self.rows, 1e-3 * self.square_mm, 1e-3 * self.marker_mm, self.dictionary
        )


@dataclass(frozen=True)
class Calibrate:
    """Hand-eye calibration: a Franka shows the fixed camera a ChArUco board that its gripper holds.

    --preset (or values) is what the policy was trained for: the measured place is compared with it.
    """

    config: Annotated[Config, tyro.conf.arg(name="")]
    """Values that can be given on their own."""
    camera: Literal["realsense", "rig"] = "realsense"
    """realsense (its left infrared imager), or rig (the FR3 rig at --host, `ddgrasp rig fr3 --board`)."""
    host: str = ""
    """Address of the robot's control unit; empty takes deploy.franka.host, or 127.0.0.1 with camera rig."""
    board: BoardOptions = BoardOptions()
    poses: Annotated[int, Range(6, 100)] = 20
    """Views to take."""
    speed: Annotated[float, Range(0.02, 0.6)] = 0.3
    """Speed of the fastest joint, rad/s; deploy.franka.dynamics may allow less."""
    dry_run: bool = False
    """Connect and look, print the poses, move nothing."""
    yes: bool = False
    """Move without asking first; for the board it asks all the same, but on the rig, whose hand holds one."""
    out: Path | None = None
    """What deploy reads; a picture lies beside it. By default runs/calibration/calibration.json, unless that
    is of another camera or robot."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """YAML file to take instead of --preset."""

    def run(self) -> None:
        """Drives the poses, prints the errors, writes the calibration."""
        from deploy.calibration.session import CalibrationOptions, run
        from deploy.interrupts import ended_late

        options = CalibrationOptions(
            self.camera, self.host, self.board.made(), self.poses, self.speed,
            dry_run=self.dry_run, yes=self.yes, out=self.out,
        )  # fmt: skip
        check_file("--out", options.file)
        run(self.config, options, say)
        if ended_late():
            raise KeyboardInterrupt


@dataclass(frozen=True)
class CalibrateBoard:
    """Write the board as a page to print at 100 %, PDF or PNG."""

    board: BoardOptions = BoardOptions()
    out: Path = Path("board.pdf")
    """File, .pdf or .png."""

    def run(self) -> None:
        """Writes the page and says what it shows."""
        from ddgrasp.files import atomic_write_bytes
        from sensors.charuco_board import printable

        kind = self.out.suffix.lower()
        if kind not in (".pdf", ".png"):
            raise UserError(f"--out is {self.out}; expected a name that ends with .pdf or .png.")
        check_file("--out", self.out)
        board = self.board.made()
        atomic_write_bytes(self.out, printable(board, "pdf" if kind == ".pdf" else "png"))
        print(f"{self.out}: {board.describe()}")
