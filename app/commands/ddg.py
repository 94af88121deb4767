"""ddgrasp ddg: the generator."""

from dataclasses import dataclass, replace
from pathlib import Path

from app import pipeline
from app.commands.base import OneStage
from app.commands.checks import (
    check_config_values,
    check_data,
    check_file,
    check_folder,
    recordings_in,
    stage_folder,
    tell_fit,
)
from ddgrasp import artifacts
from ddgrasp.config import CROSS_ENTROPY, DDGTrainingConfig
from ddgrasp.config.checks import Count, Seed, Steps, Text
from ddgrasp.config.ddg import HALVED_SPACINGS, PROGRESSIVE, Sampler
from ddgrasp.errors import UserError
from ddgrasp.stages import get_stage


@dataclass(frozen=True)
class DDGFit(OneStage):
    """Fit the depth generator on recordings: the run's own, or any in --data."""

    data: Path | None = None
    """A recording, or a folder of them (color/, depth/, meta.json); none takes the run's recordings."""

    stage = "ddg"

    def run(self) -> None:
        """Fits on the run's recordings, or on those in `data`."""
        if self.data is None:
            super().run()
            return
        inputs = recordings_in("--data", self.data)
        config = check_config_values(self.config, self.out)
        tell_fit(config, self.data, self.out / self.stage)
        pipeline.make(get_stage(self.stage), config, self.out, resume=self.resume, parents={}, inputs=inputs)


@dataclass(frozen=True)
class DDGSample:
    """Draw recorded frames beside what a fitted generator makes of them, as a PNG."""

    model: Path
    """A run with a fitted generator, its folder ddg, or pretrained/ddg."""
    data: Path
    """A recording, or a folder of them."""
    out: Path = Path()
    """Where samples.png goes."""
    count: Count = 4
    """Frames to draw."""
    seed: Seed = 0
    """Seed of the noise."""

    def run(self) -> None:
        """Writes samples.png and prints where it is."""
        from ddg_jax.stage import sample_folder
        from ddgrasp.progress import Progress

        check_folder("--out", self.out)
        check_data("--data", self.data)
        model, progress = _fitted(self.model), Progress(name="ddg sample")
        print(sample_folder(model, self.data, self.out, seed=self.seed, progress=progress, count=self.count))


@dataclass(frozen=True)
class DDGDistil:
    """Distil a fitted generator to few network evaluations per map."""

    model: Path
    """A run with a fitted generator, its folder ddg, or pretrained/ddg."""
    data: Path
    """The recordings it was fitted on: a recording, or a folder of them."""
    out: Path
    """Directory of a run; the distilled model goes to its folder ddg."""
    evaluations: Count = 4
    """Network evaluations per map: 8, 4, 2 or 1 of a generator whose ddg.training.distil_from is 16; those
    passed on the way (8, 4 and 2 before 1) are kept too."""
    steps: Steps | None = None
    """Optimiser steps per halving; none takes the model's ddg.training.distil_steps."""
    resume: bool = False
    """Continue what is there."""

    def run(self) -> None:
        """Distils the model into the run's folder ddg."""
        from ddgrasp.progress import Progress

        fitted = artifacts.read_artifact(_fitted(self.model))
        config = artifacts.config_from_json(fitted.manifest.config)
        training, spacing = config.ddg.training, config.ddg.sampling.spacing
        self._check_halves(training)
        inputs = recordings_in("--data", self.data)
        if spacing not in HALVED_SPACINGS:
            Progress(name="ddg distil").note(
                f"the model's steps are {spacing}, which cannot be halved: the distilled one's are quadratic"
            )
            spacing = "quadratic"
        ddg = replace(
            config.ddg,
            init_from=str(fitted.directory.resolve()),
            sampling=replace(
                config.ddg.sampling, sampler=PROGRESSIVE, steps=self.evaluations, spacing=spacing
            ),
            training=training if self.steps is None else replace(training, distil_steps=self.steps),
        )
        config = replace(config, ddg=ddg)
        inputs["model"] = fitted.hash
        tell_fit(config, self.data, self.out / "ddg")
        pipeline.make(get_stage("ddg"), config, self.out, resume=self.resume, parents={}, inputs=inputs)

    def _check_halves(self, training: DDGTrainingConfig) -> None:
        """UserError unless the generator in `model` can be halved to so many evaluations."""
        if training.hole_loss == CROSS_ENTROPY:
            raise UserError(
                f"--model {self.model} was fitted with ddg.training.hole_loss {CROSS_ENTROPY}, which cannot "
                "be distilled: give one that was fitted with squared."
            )
        whole = training.distil_from
        halves = [whole // 2**k for k in range(1, whole.bit_length()) if whole % 2**k == 0]
        if self.evaluations not in halves:
            raise UserError(
                f"--evaluations is {self.evaluations}; expected {', '.join(map(str, halves)) or 'none'}: the "
                f"generator's ddg.training.distil_from, {whole}, halved and halved again."
            )


@dataclass(frozen=True)
class DDGGenerate:
    """Give all demos the camera's artefacts, for `ddgrasp demos export --noisy`; training makes its own. A
    stream in constant memory, over all devices."""

    model: Path
    """A run with a fitted generator, its folder ddg, or pretrained/ddg."""
    demos: Path
    """A run with collected demos, or its folder demos."""
    out: Path
    """Directory of a run; the depth goes to its folder noisy."""
    seed: Seed = 0
    """Seed of the noise."""
    resume: bool = False
    """Continue what is there."""

    def run(self) -> None:
        """Writes depth.zarr episode by episode and prints how much of it is invalid."""
        from ddg_jax.sample import check_aspect
        from demos.store import STORE, EpisodeStore

        demos = stage_folder("--demos", self.demos, "demos")
        size = EpisodeStore(demos / STORE).steps("depth_mm", 0, 1).shape[1:]
        parents = {
            "ddg": artifacts.read_artifact(_fitted(self.model)),
            "demos": artifacts.read_artifact(demos),
        }
        fitted, config = (
            artifacts.config_from_json(parents[name].manifest.config) for name in ("ddg", "demos")
        )
        check_aspect(size, fitted.ddg)
        config = replace(config, ddg=fitted.ddg, seed=self.seed)
        stage = get_stage("noisy")
        made = pipeline.make(stage, config, self.out, resume=self.resume, parents=parents).manifest
        print(
            "{episodes} episodes, {frames} frames, {invalid_fraction:.1%} of pixels invalid".format(
                **made.metrics
            )
        )


@dataclass(frozen=True)
class DDGThresholds:
    """Holes, flicker and error over thresholds of a fitted generator's mask: a table, JSON, a PNG."""

    model: Path
    """A run with a fitted generator, its folder ddg, or pretrained/ddg."""
    data: Path
    """A recording, or a folder of them; its last frames are used."""
    out: Path = Path()
    """Where thresholds.json and thresholds.png go."""
    count: Count | None = None
    """Frames; none takes as many as were held out at the fit, at most 180."""
    seed: Seed = 1
    """Seed of the noise."""

    def run(self) -> None:
        """Prints the table and writes thresholds.json and thresholds.png."""
        from ddg_jax import thresholds
        from ddgrasp.progress import Progress

        check_folder("--out", self.out)
        check_data("--data", self.data)
        model, progress = _fitted(self.model), Progress(name="thresholds")
        rows = thresholds.analyse(model, self.data, self.out, progress, count=self.count, seed=self.seed)
        print(f"{thresholds.table(rows)}\n{self.out / thresholds.FILE}.png")


@dataclass(frozen=True)
class DDGExport:
    """Write a fitted generator as one ONNX file for any simulator: clean depth in, a camera's depth out."""

    model: Path
    """A run with a fitted generator, its folder ddg, or pretrained/ddg."""
    out: Path = Path("generator.onnx")
    """The file."""
    data: Path | None = None
    """Recordings it was fitted on: their camera, licence and range of depth go into the file."""
    licence: Text = ""
    """Licence of the generator, for the file; empty takes the recordings'."""
    sampler: Sampler | None = None
    """Another sampler than the model's: progressive, for one that was distilled; dpm_solver, which then takes
    quadratic steps."""
    steps: Steps | None = None
    """Network evaluations per map unless the file's input says otherwise; none takes the model's."""

    def run(self) -> None:
        """Writes the file and prints how it compares with JAX."""
        check_file("--out", self.out)
        if self.data is not None:
            check_data("--data", self.data)
        model = _fitted(self.model)
        from export.generator import export_generator

        measured = export_generator(
            model,
            self.out,
            data=self.data,
            licence=self.licence,
            sampler=self.sampler or "",
            steps=self.steps or 0,
        )
        print(
            f"{self.out}: {self.out.stat().st_size / 1e6:.1f} MB; against JAX {measured.share:.3%} of "
            f"the pixels grafted otherwise, inverse depth elsewhere within "
            f"{measured.inverse_depth_per_m:.1e} 1/m"
        )


def _fitted(model: Path) -> Path:
    return stage_folder("--model", model, "ddg")
