"""ddgrasp demos, record, sensors: depth of every kind."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from app.commands.base import DEFAULT_PRESET, OneStage
from app.commands.checks import check_folder
from ddgrasp import contract
from ddgrasp.config import CameraScale, RecordConfig, StereoConfig
from ddgrasp.config.checks import Count, Range, Seed, Share
from ddgrasp.errors import Trouble
from ddgrasp.presets import get_preset


@dataclass(frozen=True)
class DemosCollect(OneStage):
    """Collect successful teacher episodes with clean depth."""

    stage = "demos"


@dataclass(frozen=True)
class Record(OneStage):
    """Record RGB-D from the development rig, moved by the teacher."""

    stage = "record"


@dataclass(frozen=True)
class RecordImport:
    """Turn RealSense files (.bag, .db3) or folders of colour and depth pictures into recordings."""

    source: tyro.conf.Positional[Path]
    """A .bag or .db3, a folder of them, one with depth/ and color/ (or rgb/), or a folder of such folders."""
    out: Path = Path("recordings")
    """Each source becomes a folder in it."""
    depth_unit_m: Share = 0.0
    """Metres per unit of depth; 0 takes a RealSense file's or a meta.json's own, else 0.001 for integer
    pictures, 1 for floats."""
    sensor: str = ""
    """Camera model, for example D455; a RealSense file, or a meta.json beside depth/, names its own."""
    fx_px: Annotated[float, Range(0, 100_000)] = 0.0
    """Focal length of the depth pictures in pixels; 0 if unknown."""
    baseline_m: Annotated[float, Range(0, 10)] = 0.0
    """Distance between the imagers; 0 if unknown."""
    consecutive: bool = False
    """The pictures follow each other in time (a RealSense file's do)."""
    aligned: bool = True
    """Colour is seen from where depth is; --no-aligned if it is the colour camera's own picture, as
    RealSense Viewer exports it (a RealSense file says so itself)."""

    def run(self) -> None:
        """Imports every source that can be used and says what was left out."""
        check_folder("--out", self.out)
        from sensors.recordings import importers

        known = {"sensor": self.sensor, "fx_px": self.fx_px, "baseline_m": self.baseline_m}
        meta = {name: value for name, value in known.items() if value}
        if self.consecutive:
            meta["consecutive_frames"] = True
        if not self.aligned:
            meta["color_aligned_to_depth"] = False
        sources, refused = importers.find_sources(self.source, self.depth_unit_m, meta)
        print(importers.summary(*importers.import_all(sources, self.out, refused)))


@dataclass(frozen=True)
class RecordRealsense:
    """Record colour and depth of a RealSense D4xx that is connected, until done or Ctrl-C."""

    out: Path = Path("recordings")
    """The recording becomes a folder in it."""
    name: str = "take"
    """Name of that folder; one that exists is never overwritten."""
    seconds: float = 10.0
    """Length, after the half second in which the exposure settles. Ctrl-C ends it earlier and keeps it."""
    frames: int = 0
    """Frames to record; 0 takes --seconds."""
    hz: int = 10
    """Frames kept per second: 1, 2, 3, 5, 6, 10, 15 or 30; the camera itself always runs at 30."""
    width: int = contract.D455_STREAM.width_px
    """Columns of depth and colour, in pixels."""
    height: int = contract.D455_STREAM.height_px
    """Rows of depth and colour, in pixels."""
    serial: str = ""
    """Serial number of the camera; empty takes the first."""

    def run(self) -> None:
        """Records, and says what was kept. UserError if the camera stopped by itself, or the disk is full;
        KeyboardInterrupt where somebody ended it, so that what follows in a script does not begin."""
        from ddgrasp.progress import Progress
        from sensors.recordings import realsense_live as live

        check_folder("--out", self.out)
        frames = live.frame_count(self.frames, self.seconds, self.hz)
        options = live.LiveOptions(frames, self.hz, self.width, self.height, self.serial)
        path = live.new_path(self.out, self.name)
        imported, take = live.record(options, path, Progress(name="record realsense"))
        print(live.summary(imported, take, frames))
        if take.trouble:
            raise Trouble(take.trouble)
        if take.stopped:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class RecordFr3:
    """Record RGB-D on the test rig: a D455 at 848x480, the FR3 led over the table through its driver."""

    out: Path = Path("recordings/fr3")
    """The recordings become folders in it; those that it has are kept, so that a run can go on."""
    trajectories: Count | None = None
    """How many; none takes the preset's."""
    frames: Count | None = None
    """Frames of each, 10 per second; none takes the preset's."""
    objects: tuple[str, ...] = ()
    """Names, in turn; none takes the six that a student trains on."""
    shapes: Literal["mesh", "primitive"] = "mesh"
    """mesh, or the development rig's primitives."""
    number: Annotated[int, Range(0, 999)] = 0
    """Which development seed."""
    preset: str = DEFAULT_PRESET
    """Configuration of the camera: size of the pictures, and how far it is moved from one to the next."""

    def run(self) -> None:
        """Records what is missing and says what there is."""
        from ddgrasp.progress import Progress
        from deploy import fr3_record
        from rig import seeds

        check_folder("--out", self.out)
        config = get_preset(self.preset)
        given = {"trajectories": self.trajectories, "frames": self.frames}
        changed = {name: value for name, value in given.items() if value is not None}
        config = replace(config, record=replace(config.record, **changed))
        takes = fr3_record.Takes(seeds.seed("development", self.number), self.objects, self.shapes)
        recordings = fr3_record.record(config, takes, self.out, Progress(name="record fr3"))
        print(fr3_record.describe(recordings, self.out))


@dataclass(frozen=True)
class SensorsCompare:
    """Set the rig's stereo camera beside real D4xx cameras: holes, noise, flicker, as table, JSON and PNG."""

    stereo: StereoConfig = field(default_factory=StereoConfig)
    """The rig's camera."""
    camera_scale: CameraScale = 0.25
    """Size of its picture relative to 1280 x 720."""
    real: Path | None = None
    """A recording of a real camera, or a folder of them; none takes the figures measured before."""
    out: Path = Path()
    """Where sensors.json and sensors.png go."""
    scenes: Count = 1
    """Standing scenes per object."""
    frames: Annotated[int, Range(2, 1_000_000)] = 6
    """Frames per scene, at least 2: noise over time needs them."""
    seed: Seed = 0
    """Seed of the scenes."""

    def run(self) -> None:
        """Prints both cameras' figures side by side and writes sensors.json and sensors.png."""
        check_folder("--out", self.out)
        from ddgrasp.progress import Progress
        from evaluation import camera_comparison as compare

        result = compare.compare(
            RecordConfig(stereo=self.stereo),
            contract.D455.scaled(self.camera_scale),
            self.real,
            per_object=self.scenes,
            frames=self.frames,
            seed=self.seed,
            progress=Progress(name="sensors compare"),
        )
        compare.print_tables(result)
        print(*compare.write(result, self.out), sep="\n")
