"""What a deployment leaves behind: its frames as a recording, its steps, its report, a film, how it ended.

A folder of deployments is a folder of recordings: `ddgrasp ddg fit --data runs/deployments` fits the
generator to what the robot just saw.
"""

import json
import math
import os
import queue
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8, UInt16

from ddgrasp import contract
from ddgrasp.depth import to_millimetres
from ddgrasp.files import atomic_write_bytes, atomic_write_text, to_json
from deploy.interfaces import Camera, Device, Filmed, Judge, Replayed
from deploy.interrupts import unbroken
from deploy.loop_report import Step
from rig.film import Film, contact_sheet

if TYPE_CHECKING:
    from sensors.recordings.writer import RecordingWriter

STEPS_FILE, REPORT_FILE, FILM_FILE = "steps.jsonl", "report.json", "film.png"
ENDED = {True: "lifted and held", False: "failed", None: "not judged"}
"""How a deployment ended, in words, by its success."""
FILM_COLUMNS = 12
"""Most pictures of the film strip: what comes later is thinned out evenly."""
FITTED = "brought to the policy's picture"
"""What a recording says of a camera whose own picture is another."""
_Frame = tuple[UInt8[np.ndarray, "h w 3"], UInt16[np.ndarray, "H W"]]
_GAP_S = 1.5 * contract.CONTROL_DT_S
"""Two frames further apart do not follow each other: the camera had none, or a step came late."""


class DeploymentRecord:
    """Collects what the loop did; the disk is a thread's, so that a step does not wait for it."""

    def __init__(
        self,
        camera: Camera | Filmed,
        profile: contract.CameraProfile,
        sensor: str,
        film_every: int,
        is_profile_s: bool = True,
    ):
        """`profile` is the policy's picture, `film_every` as in `DeployConfig`; `is_profile_s`: whether the
        camera is a simulated one of that profile, and has its baseline."""
        self._camera, self._picture_every, self._film_every = camera, film_every, film_every
        self._meta: dict[str, Any] = {
            "sensor": sensor, "fx_px": profile.fx_px,
            "color_aligned_to_depth": isinstance(camera, Filmed),  # a camera's own is of another lens
        }  # fmt: skip
        if is_profile_s:
            self._meta["baseline_m"] = profile.baseline_m
        self._newest_s, self._kept_s = -math.inf, math.inf
        self._rows: list[dict[str, Any]] = []
        self._queue: queue.Queue[tuple[dict[str, Any], _Frame | None] | None] = queue.Queue()
        self._film: list[tuple[int, UInt8[np.ndarray, "h w 3"], np.ndarray]] = []
        self._queued = self._written = 0
        self._trouble = self._without = ""

    @contextmanager
    def into(self, folder: Path) -> Iterator[None]:
        """Frames become the recording `folder` when this ends, if there were any. Its steps are there from
        the first on, for whoever asks what a process that was killed had done."""
        thread = threading.Thread(target=self._write, args=(folder,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            with unbroken():  # a thread that is left behind would put its frames over the report
                self._queue.put(None)
                thread.join()

    def look(self, step: Step) -> None:
        """What the loop's `on_step` is called with."""
        row = self._row(step)
        frame = self._frame(step)
        if frame is not None:
            row["frame"] = self._queued
            self._queued += 1
            self._keep(step.index, *frame)
        self._rows.append(row)
        self._queue.put((row, frame))

    def _row(self, step: Step) -> dict[str, Any]:
        row = {"step": step.index, "q_rad": step.state.q_rad.tolist(), "width_m": float(step.state.width_m)}
        row |= {"time_s": step.state.timestamp_s, "held": step.action is None}
        if step.state.met:
            row["met"] = step.state.met
        if step.state.felt_nm is not None:
            row["felt_nm"] = np.round(step.state.felt_nm, 3).tolist()
        row["action"] = None if step.action is None else np.asarray(step.action, float).tolist()
        row["by"] = step.by
        row["close"] = step.close
        row["q_target_rad"] = None if step.q_target_rad is None else step.q_target_rad.tolist()
        return row

    def _frame(self, step: Step) -> _Frame | None:
        """Copies, since cameras fill their buffers again before the thread has written; None for a step whose
        frame is not kept."""
        if step.frame is None:
            return None
        rgb = step.frame.rgb
        if not self._queued:  # a camera's own are all kept
            apart = self._picture_every if rgb is None else 1
            self._meta |= {"hz": contract.CONTROL_HZ / apart, "consecutive_frames": apart == 1}
            if isinstance(self._camera, Device) and (name := self._camera.device_name()):
                self._meta["sensor"] = f"{name}, {FITTED}"
                self._meta.pop("baseline_m", None)  # known by the name
            if isinstance(self._camera, Replayed):
                told = self._meta | self._camera.recorded_as()
                self._meta = {name: value for name, value in told.items() if value is not None}
        if again := step.frame.timestamp_s == self._newest_s:  # the loop holds, and has no other
            self._meta["consecutive_frames"] = False
        self._newest_s = step.frame.timestamp_s
        if rgb is None and step.index % self._picture_every == 0 and isinstance(self._camera, Filmed):
            rgb = self._camera.picture()
        if rgb is None or (rgb.dtype, rgb.shape[2:]) != (np.uint8, (3,)):
            if not isinstance(self._camera, Filmed):  # which has one now and then
                wrong = "no colour" if rgb is None else f"colour of type {rgb.dtype} and shape {rgb.shape}"
                self._without = self._without or wrong
            return None
        depth = step.frame.depth
        depth_mm = depth.copy() if depth.dtype == np.uint16 else to_millimetres(depth)
        if step.frame.timestamp_s - self._kept_s > _GAP_S:
            self._meta["consecutive_frames"] = False
        if again:
            self._meta["repeated_frames"] = self._meta.get("repeated_frames", 0) + 1
        self._kept_s = step.frame.timestamp_s
        return rgb.copy(), depth_mm

    @property
    def lost(self) -> str:
        """Why frames are missing of what `finish` left, empty if none is."""
        if self._trouble or self._written or not self._without:
            return self._trouble
        return f"the camera gives {self._without}; a recording's is (h, w, 3) uint8"

    def finish(
        self, folder: Path, report: Mapping[str, Any], success: bool | None, about: Mapping[str, Any]
    ) -> None:
        """Writes everything but the frames into `folder`; `report` is a LoopReport as plain values."""
        folder.mkdir(parents=True, exist_ok=True)
        for row in self._rows:
            if row.get("frame", 0) >= self._written:
                row.pop("frame", None)
        atomic_write_text(folder / STEPS_FILE, "".join(map(_line, self._rows)))
        values = {**about, "success": success, "frames": self._written, **report}
        if self.lost:
            values["frames_lost"] = self.lost
        atomic_write_text(folder / REPORT_FILE, json.dumps(to_json(values), indent=1) + "\n")
        if self._film:
            steps, rgb, depth_mm = zip(*self._film, strict=True)
            film = Film(steps, np.stack(rgb), np.stack(depth_mm))
            sheet = contact_sheet(film, report["fault"])  # without the verdict, which people may change
            atomic_write_bytes(folder / FILM_FILE, sheet)

    def _keep(self, index: int, rgb: np.ndarray, depth_mm: np.ndarray) -> None:
        """One of at most twice `FILM_COLUMNS` pictures, every second one dropped when there are more."""
        if index % self._film_every:
            return
        import cv2

        size = depth_mm.shape[::-1]
        self._film.append((index, cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), depth_mm))
        if len(self._film) >= 2 * FILM_COLUMNS:
            self._film, self._film_every = self._film[::2], 2 * self._film_every

    def _write(self, folder: Path) -> None:
        frames = self._taken(folder)
        first = next(frames, None)
        if first is None:
            return
        try:
            from sensors.recordings.writer import RecordingWriter

            with RecordingWriter(folder, self._meta) as writer:
                for frame in chain([first], frames):
                    if not self._trouble:  # what cannot be written is not kept in memory either
                        self._add(writer, *frame)
                writer.meta.update(self._meta)
        except Exception as error:  # encoders raise what they like
            self._trouble = str(error)  # the arm goes on; the report says what is missing
            self._written = 0
        for _ in frames:
            pass

    def _taken(self, folder: Path) -> Iterator[_Frame]:
        """The frames that `look` puts there, until `into` ends; a line of every step goes into `folder`. The
        report of an attempt before is taken away: a kill would leave it beside other steps."""
        path, mode = folder / STEPS_FILE, "w"
        with suppress(OSError):
            (folder / REPORT_FILE).unlink()
        while (taken := self._queue.get()) is not None:
            row, frame = taken
            with suppress(OSError, ValueError):  # `finish` writes them all, and says why it cannot
                folder.mkdir(parents=True, exist_ok=True)
                with open(path, mode) as file:
                    file.write(_line(row))
                    file.flush()
                    os.fsync(file.fileno())
                mode = "a"
            if frame is not None:
                yield frame

    def _add(self, writer: "RecordingWriter", rgb: np.ndarray, depth_mm: np.ndarray) -> None:
        """Raises what prevented it if there is no frame before; otherwise that is noted."""
        try:
            writer.add(rgb, depth_mm)
        except Exception as error:
            if not self._written:
                raise
            self._trouble = f"those after the first {self._written}: {error}"
        else:
            self._written += 1


def _line(row: Mapping[str, Any]) -> str:
    return json.dumps(to_json(row)) + "\n"


def verdict(camera: Camera, ask: Callable[[str], bool | None]) -> bool | None:
    """Whether the object was lifted and held: what the rig knows, else what a person answers, else None."""
    if isinstance(camera, Judge):
        return camera.success()
    return ask("Is the object in the hand, lifted to where it belongs?")
