"""ddgrasp ddg score, curve, samplers, features: how real generated depth is."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from ddgrasp import artifacts, pipeline
from ddgrasp.commands.base import load_config
from ddgrasp.commands.checks import check_config_values
from ddgrasp.config import Config, DDGConfig, DepthFeatureConfig, ScoreConfig
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset


@dataclass(frozen=True)
class Scoring:
    score: Annotated[ScoreConfig, tyro.conf.arg(name="")]
    """How to score; the rest of the configuration is the run's own."""
    preset: str
    """Preset whose sizes to take."""
    out: Path
    """Directory of the result, a folder in it; usually the run's."""
    run_dir: Path | None = None
    """Run whose teacher and generator to use; none takes --out."""
    seed: int = 0
    """Of trajectories, noise and resampling."""
    resume: bool = False
    """Continue what is there."""

    def _make(self, stage_name: str, work: Callable[[Config, Path, Any], artifacts.Artifact]) -> None:
        """Lets `work` make the stage from the run's teacher and generator, and prints where the result is."""
        source = self.run_dir or self.out
        config = replace(load_config(source, "ddg"), score=self.score, seed=self.seed)
        parents = {name: artifacts.read_artifact(source / name).hash for name in ("teacher", "ddg")}
        pipeline.make(
            pipeline.get_stage(stage_name), config, self.out, lambda progress: work(config, source, progress),
            resume=self.resume, inputs=parents,
        )  # fmt: skip


@dataclass(frozen=True)
class DDGScore(Scoring):
    """Compare generated depth with recorded depth: the paper's Table I, hole measures, t-SNE."""

    ddg: DDGConfig = DDGConfig()
    """Generator that --real fits; its rows are those of the recordings."""
    real: Path | None = None
    """Recordings of a real camera: fits the preset's generator on the first frames and scores it on the last,
    instead of the rig; no run is needed."""
    fit_frames: int = 80
    """Frames that --real is fitted on."""
    score_frames: int = 40
    """Frames that --real is scored on, the last ones."""

    def run(self) -> None:
        from evaluation import score
        from evaluation.score_page import print_result

        if self.real is None:
            self._refuse_options_of_real()
            self._make("score", lambda config, source, p: score.run(config, source, self.out, progress=p))
            print_result(self.out / "score")
            return
        if self.run_dir is not None:
            raise UserError(
                f"--run-dir {self.run_dir} with --real: the generator is fitted on the first frames, none is "
                "taken from a run; leave one of them out."
            )
        preset = replace(get_preset(self.preset), ddg=self.ddg, score=self.score, seed=self.seed)
        config = score.real_config(check_config_values(preset), self.real)
        root, stage = self.real, pipeline.get_stage("score_real")

        def work(progress):
            return score.run_real(
                config, root, self.fit_frames, self.score_frames, self.out, progress=progress
            )

        inputs = {"frames": f"{root.resolve()} {self.fit_frames} {self.score_frames}"}
        pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs)
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

    def run(self) -> None:
        from evaluation import score_curve
        from evaluation.score_page import print_result

        self._make("curve", lambda config, source, p: score_curve.run(config, source, self.out, progress=p))
        print_result(self.out / "curve")


@dataclass(frozen=True)
class DDGSamplers(Scoring):
    """Score every sampler of the generator: what fewer network evaluations cost, and frames per second."""

    def run(self) -> None:
        from evaluation import score_samplers
        from evaluation.score_page import print_result

        self._make(
            "samplers", lambda config, source, p: score_samplers.run(config, source, self.out, progress=p)
        )
        print_result(self.out / "samplers")


@dataclass(frozen=True)
class DDGFeatures:
    """Train the depth feature extractor that scores use; the frozen one is part of the repository."""

    config: Annotated[DepthFeatureConfig, tyro.conf.arg(name="")] = DepthFeatureConfig()
    out: Path = Path("runs") / "depthfeat"
    """Folder of the extractor; the same command continues what was begun there."""

    def run(self) -> None:
        from foundation.depth_feature_training import train

        manifest = train(self.config, self.out)
        print(json.dumps(manifest["tested_on_new_cameras"], indent=2))
