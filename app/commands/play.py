"""ddgrasp play: watch a policy grasp."""

import contextlib
import itertools
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, assert_never, cast

import tyro

from app.commands.checks import check_file, check_tried, stage_folder
from ddgrasp import contract
from ddgrasp.config.checks import Count, Range
from ddgrasp.errors import UserError
from ddgrasp.install import check_fr3, lacks_fr3
from ddgrasp.policy_metadata import POLICY_FILE
from ddgrasp.shipped import PRETRAINED
from deploy.controls import KEYS, Controls, Noise
from deploy.interrupts import terminable

if TYPE_CHECKING:
    import numpy as np

    from deploy.interfaces import Depth
    from deploy.treatment import CleanDepth
    from deploy.trials import Bench, Trial
    from deploy.viewers import Viewer
    from evaluation.rig_trials import Series

PRETRAINED_GENERATOR = PRETRAINED / "ddg"
FILM = Path("runs/play.mp4")
LIVE = ("mujoco", "rerun", "web")


@dataclass(frozen=True)
class Play:
    """Watch the pretrained student, or a policy of yours, grasp in simulation: a film, or live in a viewer.

    In a viewer, object, noise and rig can be changed as it runs, by typing their names on the terminal.
    """

    policy: Path | None = None
    """ONNX file that `ddgrasp export` wrote; without it the student under pretrained/."""
    objects: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--object",))] = ("apple", "banana", "can")
    """Names (`ddgrasp objects list`, on rig fr3 with --meshes), or all: the paper's twelve, on rig fr3 six
    more."""
    rig: Literal["development", "fr3"] = "development"
    """development (MuJoCo's Franka, seconds a trial) or fr3 (the test rig: another arm behind Franka's own
    protocol, meshes; a minute or so a trial)."""
    noise: Noise = "camera"
    """Whose errors the policy sees: camera (a simulated D455's), none, or generator (the learned ones)."""
    trials: Count = 1
    """How many with every object."""
    seconds: Annotated[float, Range(0.5, 60)] = contract.TRIAL_S
    """A trial ends with success, or after this."""
    number: Annotated[int, Range(0, 999)] = 0
    """Another number, other places of the objects."""
    generator: Path | None = None
    """A run with a fitted generator, or its folder ddg, for noise generator, instead of pretrained/ddg; a
    film then shows its depth beside the camera's."""
    viewer: Literal["auto", "film", "mujoco", "rerun", "web"] = "auto"
    """film (a file), mujoco (MuJoCo's window), rerun (Rerun's), web (Rerun in the browser, also of another
    machine), or auto: on a terminal mujoco if there is a display, or else web if Rerun is installed; a film
    otherwise, with --out, and with --generator unless that is the noise."""
    out: Path | None = None
    """The film (runs/play.mp4 if this is not given): .mp4, .webm for browsers, .webp for pages; .rrd keeps
    what Rerun would show."""

    def run(self) -> None:
        """Runs the trials, prints how each ended, and where the film is."""
        if self.out and self.viewer in (("mujoco",) if self.out.suffix == ".rrd" else LIVE):
            raise UserError(f"--out is {self.out}, and --viewer {self.viewer} writes no file: leave out one.")
        chosen = _chosen(self._wants_film) if self.viewer == "auto" else self.viewer
        replace(self, viewer=chosen)._run()

    def _run(self) -> None:
        given = self.generator
        generator = stage_folder("--generator", given, "ddg") if given else PRETRAINED_GENERATOR
        from evaluation.rig_trials import Series

        if self.rig == "fr3":
            check_fr3("--rig fr3")
        series = Series(self.rig, self.objects, self.trials, number=self.number, seconds=self.seconds)
        check_tried(series)
        trials = series.plan()
        controls = Controls(_objects_by_rig(series, self._live), self.rig, self.noise)
        noise = _ChosenNoise(controls, generator)
        if not self._live:
            check_file("--out", self._film)
        viewer = self._viewer(noise)
        rigs, whole = _Rigs(series, self.policy or _pretrained(), noise), False
        try:
            rigs.bench(self.rig)
            if self._live:
                self._play_on(rigs, series.names(), viewer, noise)
            else:
                with terminable():  # the file is closed, whatever ends it
                    lifted = sum(_watched(rigs.bench(self.rig), trial, viewer, noise) for trial in trials)
            whole = True
        finally:
            rigs.close()
            viewer.close(whole)
        if not self._live:
            print(f"{lifted} of {len(trials)} lifted and held: {self._film}", flush=True)

    @property
    def _wants_film(self) -> bool:
        """Whether a film is meant: its file is named, or a generator to be seen beside the camera."""
        return self.out is not None or (self.generator is not None and self.noise != "generator")

    @property
    def _live(self) -> bool:
        return self.viewer != "film" and self._film.suffix != ".rrd"

    @property
    def _film(self) -> Path:
        return self.out or FILM

    def _viewer(self, noise: "_ChosenNoise") -> "Viewer":
        from deploy.video import Video
        from deploy.viewers import MujocoWindow, Rerun

        if self.generator or self.noise == "generator":
            _ = noise.generator  # what is wrong with it is said before anything runs
        if self._film.suffix == ".rrd":
            return Rerun(browser=False, file=self._film)
        if self.viewer == "film":
            beside = self.generator and self.noise != "generator"  # else it is what the policy sees
            return Video(self._film, noise.generator if beside else None)
        if self.viewer != "web" and sys.platform == "linux" and not _has_display():
            raise UserError(f"--viewer {self.viewer}: there is no display here: choose web, or film.")
        if self.viewer == "mujoco":
            return MujocoWindow(noise.controls.key)
        viewer = Rerun(browser=self.viewer == "web")
        if self.viewer == "web":
            print(viewer.url, flush=True)
        return viewer

    def _play_on(self, rigs: "_Rigs", names: Sequence[str], viewer: "Viewer", noise: "_ChosenNoise") -> None:
        """Trials with `names`, then with what is asked for, until Ctrl-C or the window's end."""
        controls = noise.controls
        controls.listen(sys.stdin, lambda text: print(text, flush=True))
        print(f"{controls.help} {KEYS}." if self.viewer == "mujoco" else controls.help, flush=True)
        planned = itertools.chain.from_iterable([name] * self.trials for name in names)
        tried: Counter[tuple[str, str]] = Counter()
        with contextlib.suppress(KeyboardInterrupt):
            while viewer.watched() and not controls.ended:
                name = controls.next_object() or next(planned, None)
                if name is None:
                    controls.wait(viewer.watched)
                    continue
                series = rigs.series(rig := controls.rig)
                if name in series.at_hand():
                    _watched(rigs.bench(rig), series.trial(name, tried[rig, name]), viewer, noise)
                    tried[rig, name] += 1


class _Rigs:
    """The rigs that were asked for, each made when it is first asked for."""

    def __init__(self, series: "Series", policy: Path, noise: "_ChosenNoise"):
        self._series, self._policy, self._noise = series, policy, noise
        self._benches: dict[str, Bench] = {}

    def series(self, rig: str) -> "Series":
        """The trials, on that rig."""
        from evaluation.rig_trials import RigName

        return replace(self._series, rig=cast(RigName, rig))

    def bench(self, rig: str) -> "Bench":
        """What runs them there."""
        from app.commands.student import config_of

        if rig not in self._benches:
            series = self.series(rig)
            config = series.configured(config_of(self._policy, None), self._policy)
            self._benches[rig] = series.make(config, self._noise)(config, self._policy)
        return self._benches[rig]

    def close(self) -> None:
        """Ends them all."""
        for bench in self._benches.values():
            bench.close()


def _objects_by_rig(series: "Series", choice: bool) -> dict[str, tuple[str, ...]]:
    """What the rig of `series` has to grasp; with a `choice` of them, every other that can run here as well.

    The FR3's meshes take a second to import, in which trimesh loses a Ctrl-C.
    """
    others = {"development", "fr3"} - {series.rig} if choice and not lacks_fr3() else set()
    return {rig: replace(series, rig=rig).at_hand() for rig in (series.rig, *others)}


class _ChosenNoise:
    """The depth that the policy sees, as `controls` say: see `deploy.treatment.Replacement`."""

    def __init__(self, controls: Controls, folder: Path):
        self.controls, self._folder, self._episode = controls, folder, 0

    @cached_property
    def generator(self) -> "_Generated":
        """Loaded when it is first asked for."""
        made = _Generated(self._folder)
        made.begin(self._episode)
        return made

    def begin(self, episode: int) -> None:
        """A trial begins, to which noise of its own belongs."""
        self._episode = episode
        if "generator" in vars(self):
            self.generator.begin(episode)

    def replace(self, depth: "Depth", clean_mm: "CleanDepth") -> "Depth":
        """See `Replacement`."""
        match self.controls.noise:
            case "camera":
                return depth
            case "none":
                return clean_mm()
            case "generator":
                return self.generator(clean_mm())
            case other:
                assert_never(other)


def _watched(bench: "Bench", trial: "Trial", viewer: "Viewer", noise: "_ChosenNoise") -> bool:
    """One trial before `viewer`; whether the object was lifted and held."""
    controls = noise.controls
    controls.begin(trial.object_name)
    noise.begin(trial.index % 2**31)
    viewer.begin(f"{trial.object_name}, noise: {controls.noise}")

    def look(step, camera) -> bool:
        viewer.look(step, camera)
        return controls.interrupts or not viewer.watched()

    result, _ = bench.run(trial, look)
    stopped = controls.interrupts or not viewer.watched()
    verdict = "lifted and held" if result.success else "stopped" if stopped else "failed"
    viewer.end(verdict)
    print(f"{trial.object_name:<12} {verdict}", flush=True)
    return result.success


class _Generated:
    """A generator's depth of one frame after the other of an episode."""

    def __init__(self, generator: Path):
        import jax

        from ddg_jax.sample import Generator
        from student_jax.depth_source import GeneratorSource

        loaded = Generator.load(generator)
        one = replace(loaded.config, sampling=replace(loaded.config.sampling, batch_size=1))
        self._source = GeneratorSource(replace(loaded, config=one), jax.random.key(0))
        if self._source.needs_rgb:
            raise UserError(f"--generator {generator} looks at colour: play can show one with another prior.")
        self._episode = self._frame = 0

    def begin(self, episode: int) -> None:
        """Start of an episode; what its frames share is drawn by its number."""
        self._episode, self._frame = episode, 0

    def __call__(self, clean_mm: "np.ndarray") -> "np.ndarray":
        """(H, W) uint16 millimetres -> the same as the generator has it."""
        import numpy as np

        made = self._source.frames(clean_mm[None], None, np.array([self._episode]), np.array([self._frame]))
        self._frame += 1
        return made[0]


def _chosen(film: bool) -> Literal["film", "mujoco", "web"]:
    """What --viewer auto means here. Elsewhere than on Linux MuJoCo's window needs a Python of its own."""
    if film or not sys.stdin.isatty():
        return "film"
    if sys.platform == "linux" and _has_display():
        return "mujoco"
    return "web" if find_spec("rerun") else "film"


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _pretrained() -> Path:
    return PRETRAINED / "student" / POLICY_FILE
