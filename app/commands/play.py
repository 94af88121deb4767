"""ddgrasp play: watch a policy grasp."""

import contextlib
import os
import sys
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ddgrasp.config.checks import Count, Range
from ddgrasp.errors import UserError
from ddgrasp.shipped import PRETRAINED

if TYPE_CHECKING:
    from deploy.trials import Bench, Trial
    from deploy.viewers import Noise, Viewer

WEB_PORT = 9090
"""Rerun's own, of its web viewer."""


@dataclass(frozen=True)
class Play:
    """Watch the pretrained student, or a policy of yours, grasp in simulation: a film, or Rerun's viewer."""

    policy: Path | None = None
    """ONNX file that `ddgrasp export` wrote; without it the student under pretrained/."""
    objects: tuple[str, ...] = ("apple", "banana", "can")
    """Names, or all (`ddgrasp objects list` has them)."""
    rig: Literal["development", "fr3"] = "development"
    """development (MuJoCo's Franka, seconds a trial) or fr3 (the test rig: another arm behind Franka's own
    protocol, meshes; a minute a trial)."""
    camera: Literal["stereo", "ideal"] = "stereo"
    """stereo (a D455's errors) or ideal (none)."""
    trials: Count = 1
    """How many with every object."""
    seconds: Annotated[float, Range(0.5, 60)] = 6.0
    """Length of a trial."""
    number: Annotated[int, Range(0, 999)] = 0
    """Another number, other places of the objects."""
    generator: Path | None = None
    """Folder of a fitted generator (a run's ddg), whose depth a film then shows beside the camera's."""
    viewer: Literal["film", "rerun", "web"] = "film"
    """film (a video file), rerun (a window), or web (in the browser, also of another machine)."""
    out: Path = Path("runs/play.mp4")
    """The film, .mp4, or .webm for browsers; .rrd keeps what Rerun would show."""

    def run(self) -> None:
        """Runs the trials, prints how each ended, and where the film is."""
        from app.commands.student import config_of
        from evaluation.rig_trials import Series

        series = Series(
            self.rig, self.objects, self.trials, number=self.number, camera=self.camera, seconds=self.seconds
        )
        trials = series.plan()
        self._check_generator()
        viewer = self._viewer()
        policy = self.policy or _pretrained()
        config = series.configured(config_of(policy, None), policy)
        bench = series.make(config)(config, policy)
        try:
            lifted = sum(_watched(bench, trial, viewer) for trial in trials)
            film = f": {self.out}" if self.viewer == "film" else ""
            print(f"{lifted} of {len(trials)} lifted and held{film}", flush=True)
            self._wait()
        finally:
            bench.close()
            viewer.close()

    def _check_generator(self) -> None:
        if self.generator and (self.rig == "fr3" or self.viewer != "film" or self.out.suffix == ".rrd"):
            raise UserError(
                "--generator is shown in films of rig development alone: drop it, or --rig, --viewer, .rrd."
            )

    def _viewer(self) -> "Viewer":
        from deploy.viewers import Rerun, Video

        if self.out.suffix == ".rrd":
            return Rerun(browser=False, file=self.out)
        if self.viewer == "film":
            return Video(self.out, self.generator and _noise_of(self.generator))
        if self.viewer == "rerun" and sys.platform == "linux" and not _has_display():
            raise UserError("--viewer rerun: there is no display here: choose web, or film.")
        viewer = Rerun(browser=self.viewer == "web")
        if self.viewer == "web":
            print(f"http://localhost:{WEB_PORT}/?url={viewer.address}", flush=True)
        return viewer

    def _wait(self) -> None:
        """The browser fetches what it shows from this process."""
        if self.viewer == "web" and self.out.suffix != ".rrd":
            print("Ctrl-C ends the viewer.", flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                threading.Event().wait()


def _watched(bench: "Bench", trial: "Trial", viewer: "Viewer") -> bool:
    """One trial before `viewer`; whether the object was lifted and held."""
    viewer.begin(trial.object_name)
    result, _ = bench.run(trial, viewer.look)
    verdict = "lifted and held" if result.success else "failed"
    viewer.end(verdict)
    print(f"{trial.object_name:<12} {verdict}", flush=True)
    return result.success


def _noise_of(generator: Path) -> "Noise":
    """The generator's depth of one frame after the other of an episode."""
    from itertools import count

    import jax
    import numpy as np

    from ddg_jax.sample import Generator
    from student_jax.depth_source import GeneratorSource

    loaded = Generator.load(generator)
    one = replace(loaded.config, sampling=replace(loaded.config.sampling, batch_size=1))
    source = GeneratorSource(replace(loaded, config=one), jax.random.key(0))
    if source.needs_rgb:
        raise UserError(f"--generator {generator} looks at colour: a film can show one with another prior.")
    frames = count()

    def noisy(clean_mm: np.ndarray) -> np.ndarray:
        return source.frames(clean_mm[None], None, np.zeros(1, int), np.array([next(frames)]))[0]

    return noisy


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _pretrained() -> Path:
    from deploy.policy import POLICY_FILE

    return PRETRAINED / "student" / POLICY_FILE
