"""ddgrasp ddg score, curve, samplers, features: how real generated depth is."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from app import pipeline
from app.commands.base import load_config
from app.commands.checks import check_config_values, check_folder, check_score, recordings_in, tell_fit
from ddgrasp import artifacts
from ddgrasp.config import DDGConfig, DepthFeatureConfig, ScoreConfig
from ddgrasp.config.checks import Count, Seed
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from ddgrasp.stages import get_stage

_OF_CURVE = ("curve_trajectories", "curve_steps")
_OF_REPEATS = ("repeat_scenes", "repeats")
_OF_RIG = ("trajectories", "frames", *_OF_REPEATS)
_OF_TABLE = ("columns", "tsne_maps", "monocular", "monocular_weights", "inpaint_radius_px")
"""Fields of `ScoreConfig` that one kind of score alone reads."""


@dataclass(frozen=True)
class Scoring:
    """A command that scores generated depth: options of the preset's `score` section, without prefix."""

    score: Annotated[ScoreConfig, tyro.conf.arg(name="")]
    """How to score."""
    preset: str
    """Preset whose sizes to take."""
    out: Path
    """Directory of the result, a folder in it; usually the run's."""
    run_dir: Path | None = None
    """Run whose teacher, generator and configuration (for `curve` recordings, too) to use; none takes
    --out."""
    seed: Seed = 0
    """Seed of trajectories, noise and resampling."""
    resume: bool = False
    """Continue what is there."""

    unread: ClassVar[tuple[str, ...]]
    """Fields of `ScoreConfig` that the command does not read, and refuses."""

    def _refuse(self, ignored: Sequence[str], command: str) -> None:
        """UserError for an option of scores that `command` does not read."""
        usual = get_preset(self.preset).score
        for name in ignored:
            if getattr(self.score, name) != getattr(usual, name):
                raise UserError(f"--{name.replace('_', '-')}: {command} does nothing with it; leave it out.")

    def _make(self, stage_name: str) -> None:
        """Makes the stage from the run's own parts, and prints its table."""
        from evaluation.depth_score.page import print_result

        self._refuse(self.unread, f"`ddgrasp ddg {stage_name}`")
        if stage_name != "score" and len(self.score.features) > 1:
            raise UserError(
                f"--features {' '.join(self.score.features)}: `ddgrasp ddg {stage_name}` scores by one of "
                "them; name one."
            )
        check_score(self.score)
        stage, source = get_stage(stage_name), self.run_dir or self.out
        for name in stage.parents:
            if artifacts.is_finished(source / name):
                option = "--run-dir" if self.run_dir else "--out"
                artifacts.check_stage(option, source / name, name)
        config = replace(load_config(source, "ddg"), score=self.score, seed=self.seed)
        parents = {name: artifacts.read_artifact(source / name) for name in stage.parents}
        pipeline.make(stage, config, self.out, resume=self.resume, parents=parents)
        print_result(self.out / stage_name)


@dataclass(frozen=True)
class DDGScore(Scoring):
    """Compare generated depth with recorded depth: the paper's Table I, hole measures, t-SNE."""

    ddg: DDGConfig = DDGConfig()
    """Generator that --real fits; its rows are those of the recordings."""
    real: Path | None = None
    """Recordings of a real camera: fits the preset's generator on the first frames and scores it on the last,
    instead of the rig; no run is needed."""
    fit_frames: Count = 80
    """Frames that --real is fitted on."""
    score_frames: Count = 40
    """Frames that --real is scored on, the last ones; 16 or more."""

    unread = _OF_CURVE

    def run(self) -> None:
        """Scores the run's generator on the rig, or one fitted on a real camera."""
        if self.real is None:
            self._refuse_options_of_real()
            self._make("score")
            return
        from evaluation.depth_score.page import print_result
        from evaluation.depth_score.real import real_config

        if self.run_dir is not None:
            raise UserError(
                f"--run-dir {self.run_dir} with --real: the generator is fitted on the first frames, none is "
                "taken from a run; leave one of them out."
            )
        if self.ddg.init_from:
            raise UserError(
                f"--ddg.init-from {self.ddg.init_from} with --real: what is scored is fitted on the first "
                "frames, and a generator from elsewhere may have seen the last ones; leave one of them out."
            )
        self._refuse((*_OF_RIG, *self.unread), "a score with --real")
        recordings = recordings_in("--real", self.real)
        check_score(self.score)
        preset = replace(get_preset(self.preset), ddg=self.ddg, score=self.score, seed=self.seed)
        config = real_config(check_config_values(preset), self.real)
        stage = get_stage("score_real")
        tell_fit(config, self.real, self.out / stage.name, self.fit_frames)
        inputs = recordings | {"fit_frames": self.fit_frames, "score_frames": self.score_frames}
        pipeline.make(stage, config, self.out, resume=self.resume, inputs=inputs)
        print_result(self.out / stage.name)

    def _refuse_options_of_real(self) -> None:
        usual = DDGScore(self.score, self.preset, self.out, ddg=get_preset(self.preset).ddg)
        for name in ("ddg", "fit_frames", "score_frames"):
            if getattr(self, name) != getattr(usual, name):
                option = "--ddg.*" if name == "ddg" else f"--{name.replace('_', '-')}"
                raise UserError(
                    f"{option} without --real: the generator of {self.run_dir or self.out} is scored as it "
                    "is; give --real, or fit another one with `ddgrasp ddg fit`."
                )


@dataclass(frozen=True)
class DDGCurve(Scoring):
    """Fit and score the generator on 5, 10, 20, ... recorded trajectories: the data-efficiency curve."""

    unread = (*_OF_TABLE, *_OF_REPEATS)

    def run(self) -> None:
        """Fits and scores each point that is not there yet."""
        self._make("curve")


@dataclass(frozen=True)
class DDGSamplers(Scoring):
    """Score every sampler of the generator: what fewer network evaluations cost, and frames per second."""

    unread = (*_OF_TABLE, *_OF_CURVE)

    def run(self) -> None:
        """Scores each sampler on the same trajectories."""
        self._make("samplers")


@dataclass(frozen=True)
class DDGFeatures:
    """Train the depth feature extractor that scores use; the frozen one is part of the repository."""

    config: Annotated[DepthFeatureConfig, tyro.conf.arg(name="")] = DepthFeatureConfig()
    out: Path = Path("runs") / "depthfeat"
    """Folder of the extractor; the same command continues what was begun there."""

    def run(self) -> None:
        """Trains, or goes on, and prints what the test said."""
        check_folder("--out", self.out)
        from foundation.depth_feature_training import train

        manifest = train(self.config, self.out)
        print(json.dumps(manifest["tested_on_new_cameras"], indent=2))
