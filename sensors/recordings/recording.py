"""RGB-D recordings on disk: `color/%06d.jpg`, `depth/%06d.png` (uint16 millimetres), `meta.json`.

The format holds what a camera on a desk can give: no pose, no CAD, no pairing. A recording is
read frame by frame; a damaged frame is left out and named, the others stay readable. A recording
whose depth cannot be what it claims (unit, type, size) is refused. NumPy and OpenCV alone.
"""

import hashlib
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from ddgrasp import depth
from ddgrasp.contract import CONTRACT_VERSION, D455, DEPTH_UNIT_M
from ddgrasp.errors import UserError
from ddgrasp.files import DAMAGED_JSON
from sensors.recordings.integrity import find_color, find_depth, inspect_frame
from sensors.recordings.pictures import decoded
from sensors.recordings.sources import in_time

META_FILE = "meta.json"
COLOR_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
"""A telephone's note of how it was held would turn colour, and not depth."""

# A D4xx sees from about 0.1 m to 10 m. Medians outside these are another unit, not another scene.
NEAREST_MEDIAN_M = 0.08
FARTHEST_MEDIAN_M = 6.0
UNIT_CHECK_FRAMES = 5
UNIT_IS_CERTAIN = "depth_unit_is_certain"
"""Field of a recording whose camera said its unit: then no median of a whole recording speaks against it."""

D4XX_BASELINE_M = {"D435": 0.050, "D415": 0.055, "D455": D455.baseline_m}
"""Distance between the imagers, from the D400 series datasheet."""


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that was left out of a recording."""

    file: Path
    reason: str

    def __str__(self) -> str:
        return f"{self.file.name}: {self.reason}"


@dataclass(frozen=True)
class Recording:
    """One trajectory of RGB-D frames in time order.

    Pictures are read from disk on demand; the object itself is small.
    """

    path: Path
    meta: dict[str, Any]
    depth_files: tuple[Path, ...]
    color_files: tuple[Path, ...]
    height_px: int
    width_px: int
    skipped: tuple[SkippedFrame, ...] = ()

    @classmethod
    def open(cls, path: str | os.PathLike) -> "Recording":
        """Index the recording in `path`.

        Every file's structure is checked (PNG checksums, JPEG markers), a few frames are decoded
        to check the unit. Damaged frames, frames without colour and frames without a single valid
        pixel are listed in `skipped`.

        Raises:
            UserError: no recording there, or depth of another type, size or unit.
        """
        path = Path(path)
        meta = _read_meta(path)
        depth_files = find_depth(path)
        kept, skipped, size = [], [], None
        for depth_file in depth_files:
            color_file = find_color(path, depth_file)
            reason, frame_size = inspect_frame(depth_file, color_file)
            if reason:
                skipped.append(SkippedFrame(depth_file, reason))
                continue
            if size is not None and frame_size != size:
                raise UserError(
                    f"{depth_file}: depth is {frame_size[1]}x{frame_size[0]}, the frames before it "
                    f"{size[1]}x{size[0]}; a recording has one size: split it into one folder per size."
                )
            size = frame_size
            kept.append((depth_file, color_file))
        if size is None:
            raise UserError(
                f"{path}: none of its {len(depth_files)} frames is readable "
                f"(first: {skipped[0]}); record it again."
            )
        recording = cls(
            path, meta, tuple(d for d, _ in kept), tuple(c for _, c in kept), size[0], size[1], tuple(skipped)
        )
        _check_unit(recording)
        return recording

    def __len__(self) -> int:
        return len(self.depth_files)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def fx_px(self) -> float | None:
        """Focal length of the depth picture in pixels, where known."""
        return self.meta.get("fx_px")

    def optics(self) -> tuple[float, float]:
        """(focal length in pixels, baseline in metres), which turn depth into disparity.

        Raises:
            UserError: meta.json names no focal length, or neither a baseline nor a D4xx that has one.
        """
        sensor = str(self.meta.get("sensor", ""))
        baseline = self.meta.get("baseline_m") or next(
            (metres for name, metres in D4XX_BASELINE_M.items() if name in sensor), None
        )
        if not self.fx_px or not baseline:
            raise UserError(
                f"{self.path}: fx_px is {self.fx_px!r}, sensor {sensor!r}; add fx_px and baseline_m to "
                f"{META_FILE}: without them disparity is unknown."
            )
        return self.fx_px, baseline

    @property
    def consecutive(self) -> bool:
        """Whether the frames follow each other in time (temporal statistics make sense), none left out, and
        none taken away of as many as meta.json counts."""
        first, last = in_time(self.depth_files[0]), in_time(self.depth_files[-1])
        gaps = any(first < in_time(frame.file) < last for frame in self.skipped)
        counted = self.meta.get("frames")
        gaps |= isinstance(counted, int) and len(self) + len(self.skipped) < counted
        return bool(self.meta.get("consecutive_frames", False)) and not gaps

    @property
    def color_aligned(self) -> bool:
        """False if meta.json says that colour is the colour camera's own picture, not depth's."""
        return self.meta.get("color_aligned_to_depth") is not False

    def depth_mm(self, index: SupportsIndex) -> UInt16[np.ndarray, "H W"]:
        """(H, W) uint16 planar depth in millimetres, 0 = invalid."""
        return depth.from_counts(self._counts(index), self.meta["depth_unit_m"])

    def depth_m(self, index: SupportsIndex) -> Float32[np.ndarray, "H W"]:
        """(H, W) float32 planar depth in metres, 0 = invalid; as fine as `depth_unit_m`."""
        return depth.metres_from_counts(self._counts(index), self.meta["depth_unit_m"])

    def repeats(self, index: int) -> bool:
        """Whether a frame is the one before, come again: a deployment keeps a picture for every step, the
        same one while its camera has no other."""
        if not self.meta.get("repeated_frames") or index == 0:
            return False
        return np.array_equal(self._counts(index), self._counts(index - 1))

    def _counts(self, index: SupportsIndex) -> UInt16[np.ndarray, "H W"]:
        file = self.depth_files[index]
        raw = decoded(file.read_bytes(), cv2.IMREAD_UNCHANGED)
        if raw is None:
            raise UserError(f"{file}: cannot be decoded as PNG; delete it or copy it again.")
        return raw

    def rgb(self, index: SupportsIndex) -> UInt8[np.ndarray, "h w 3"]:
        """(h, w, 3) uint8 colour at the colour camera's own size."""
        file = self.color_files[index]
        bgr = decoded(file.read_bytes(), COLOR_AS_STORED)
        if bgr is None:
            raise UserError(f"{file}: cannot be decoded as a picture; delete it or copy it again.")
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)

    def frames(self) -> Iterator[tuple[UInt8[np.ndarray, "h w 3"], UInt16[np.ndarray, "H W"]]]:
        """(rgb uint8 (h, w, 3), depth uint16 mm (H, W)) in time order."""
        for index in range(len(self)):
            yield self.rgb(index), self.depth_mm(index)

    def skipped_summary(self) -> str:
        """One line naming what was left out; empty if nothing was."""
        if not self.skipped:
            return ""
        shown = ", ".join(str(frame) for frame in self.skipped[:3])
        more = f" and {len(self.skipped) - 3} more" if len(self.skipped) > 3 else ""
        total = len(self) + len(self.skipped)
        return f"{self.path}: left out {len(self.skipped)} of {total} frames ({shown}{more})"


def is_recording(path: str | os.PathLike) -> bool:
    """Whether `path` is a finished recording (meta.json and depth/ are there)."""
    path = Path(path)
    return (path / META_FILE).is_file() and (path / "depth").is_dir()


def find_recordings(root: str | os.PathLike) -> list[Recording]:
    """All recordings at or directly below `root`, by name.

    Unfinished ones (no meta.json, or a name that starts with a dot) are not recordings yet.

    Raises:
        UserError: `root` is missing, holds no recording, or one of them is refused.
    """
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; expected a recording or a folder of recordings.")
    folders = recording_folders(root)
    if not folders:
        raise UserError(
            f"{root}: no recording in it (a recording has color/, depth/ and {META_FILE}); "
            "make some with `ddgrasp record`."
        )
    return [Recording.open(folder) for folder in folders]


def contents(root: str | os.PathLike) -> str:
    """Tells one set of finished recordings at or directly below `root` from another.

    Their number, that of their pictures, and a hash of names (not of a single one), numbers and meta.json.
    """
    root = Path(root)
    folders, digest, pictures = recording_folders(root), hashlib.sha256(), 0
    for folder in folders:
        count = sum(not file.name.startswith(".") for file in (folder / "depth").iterdir())  # Finder's
        name, meta = os.fsencode(folder.relative_to(root)), folder / META_FILE
        digest.update(name + f"\0{count}\0".encode() + (meta.read_bytes() if meta.is_file() else b""))
        pictures += count
    return f"{len(folders)} recordings of {pictures} pictures, {digest.hexdigest()[:8]}"


def recording_folders(root: Path) -> list[Path]:
    """`root` itself if it has pictures, else the finished recordings directly below it, by name."""
    if (root / "depth").is_dir():
        return [root]
    return sorted(p for p in root.iterdir() if not p.name.startswith(".") and is_recording(p))


def unfinished(root: Path) -> list[Path]:
    """Folders directly below `root` that would be recordings with a meta.json, by name; none if `root` itself
    has pictures."""
    if (root / "depth").is_dir() or not root.is_dir():
        return []
    inside = sorted(p for p in root.iterdir() if not p.name.startswith("."))
    return [p for p in inside if (p / "depth").is_dir() and not is_recording(p)]


def depth_picture_count(folders: Iterable[Path]) -> int:
    """Depth pictures in recordings, by their names: none is opened."""
    files = (file for folder in folders for file in (folder / "depth").glob("[!.]*"))
    return sum(file.suffix.lower() == ".png" for file in files)


def _read_meta(path: Path) -> dict[str, Any]:
    file = path / META_FILE
    if not path.is_dir():
        raise UserError(f"{path}: no such recording; expected a folder with color/, depth/ and {META_FILE}.")
    if not file.is_file():
        raise UserError(
            f"{path}: {META_FILE} is missing, so the recording is unfinished or not one; "
            'if it is complete, add one, at least {"depth_unit_m": 0.001}.'
        )
    try:
        meta = json.loads(file.read_bytes())
    except DAMAGED_JSON as error:
        raise UserError(f"{file}: not valid JSON ({error}); repair it or record again.") from error
    unit = meta.get("depth_unit_m") if isinstance(meta, dict) else None
    if not isinstance(unit, int | float) or not 1e-5 <= unit <= 1e-2:
        raise UserError(
            f"{file}: depth_unit_m is {unit!r}; expected metres per count of a 16-bit depth picture, "
            "0.001 for millimetres."
        )
    version = meta.get("contract_version", CONTRACT_VERSION)  # other people's recordings name none
    if version != CONTRACT_VERSION:
        raise UserError(
            f"{file}: written with contract version {version!r}, this code has {CONTRACT_VERSION}: record or "
            "import it again, or use the release that made it."
        )
    check_fields(file, meta)
    return meta


def check_fields(file: Path, meta: Mapping[str, Any]) -> None:
    """UserError for a field of a meta.json, as people write them by hand, that is of another kind."""
    for name in ("fx_px", "baseline_m", "hz"):
        if (value := meta.get(name)) is not None and not _is_positive(value):
            raise UserError(f"{file}: {name} is {value!r}; expected a number above 0, or null.")
    if (frames := meta.get("frames")) is not None and not (_is_positive(frames) and isinstance(frames, int)):
        raise UserError(f"{file}: frames is {frames!r}; expected how many there are, or null.")
    for name in ("consecutive_frames", "color_aligned_to_depth", UNIT_IS_CERTAIN):
        if not isinstance(value := meta.get(name), bool | None):
            raise UserError(f"{file}: {name} is {value!r}; expected true or false, or null.")


def _is_positive(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float) and 0 < value < math.inf


def _check_unit(recording: Recording) -> None:
    """Refuse depth whose median cannot be a D4xx's in the declared unit."""
    indices = np.linspace(0, len(recording) - 1, min(UNIT_CHECK_FRAMES, len(recording))).astype(int)
    values = np.concatenate([d[d > 0] for d in (recording.depth_mm(i) for i in indices)])
    unit = recording.meta["depth_unit_m"]
    if not len(values):
        raise UserError(
            f"{recording.path}: with depth_unit_m {unit:g} no pixel of {len(indices)} of its frames lies "
            f"between {DEPTH_UNIT_M:g} and {depth.MAX_MM * DEPTH_UNIT_M:g} m: correct it in {META_FILE}."
        )
    median_m = float(np.median(values)) * DEPTH_UNIT_M
    if recording.meta.get(UNIT_IS_CERTAIN):
        return
    if NEAREST_MEDIAN_M <= median_m <= FARTHEST_MEDIAN_M:
        return
    finer = unit / 10 ** round(np.log10(median_m))
    guess = "metres or centimetres" if median_m < NEAREST_MEDIAN_M else f"a finer unit ({finer:g} m?)"
    raise UserError(
        f"{recording.path}: median depth {median_m:.4g} m with depth_unit_m {unit:g}; expected "
        f"{NEAREST_MEDIAN_M:g} to {FARTHEST_MEDIAN_M:g} m: the pictures look like {guess}; "
        f"correct depth_unit_m in {META_FILE} or convert them to millimetres."
    )
