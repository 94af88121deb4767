"""ddgrasp ddg: the generator."""

from dataclasses import dataclass, replace
from pathlib import Path

from ddgrasp import artifacts, pipeline
from ddgrasp.commands.base import OneStage
from ddgrasp.commands.checks import check_config_values, check_count


@dataclass(frozen=True)
class DDGFit(OneStage):
    """Fit the depth noise model on recordings: the run's own, or any in --data."""

    data: Path | None = None
    """A recording, or a folder of them (color/, depth/, meta.json); none takes the run's recordings."""

    stage = "ddg"

    def run(self) -> None:
        if self.data is None:
            super().run()
            return
        config, data, directory = check_config_values(self.config), self.data, self.out / self.stage
        stage = pipeline.get_stage(self.stage)

        def work(progress):
            from ddg_jax.stage import fit_folder

            return fit_folder(config, data, directory, progress=progress)

        inputs = {"data": str(data.resolve())}
        pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs)


@dataclass(frozen=True)
class DDGSample:
    """Draw recorded frames beside what a fitted noise model makes of them, as a PNG."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    data: Path
    """A recording, or a folder of them."""
    out: Path = Path()
    """Where samples.png goes."""
    count: int = 4
    """Frames to draw."""
    seed: int = 0
    """Of the noise."""

    def run(self) -> None:
        from ddg_jax.stage import sample_folder
        from ddgrasp.progress import Progress

        check_count("--count", self.count)
        progress = Progress(name="ddg sample")
        print(
            sample_folder(
                self.model, self.data, self.out, seed=self.seed, progress=progress, count=self.count
            )
        )


@dataclass(frozen=True)
class DDGDistil:
    """Distil a fitted noise model to few network evaluations per map."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    data: Path
    """The recordings it was fitted on: a recording, or a folder of them."""
    out: Path
    """Directory of a run; the distilled model goes to its folder ddg."""
    evaluations: int = 4
    """Network evaluations per map; those passed on the way (4 and 2 before 1) are kept too."""
    steps: int | None = None
    """Optimiser steps per halving; none takes the model's ddg.distil_steps."""
    resume: bool = False
    """Continue what is there."""

    def run(self) -> None:
        fitted = artifacts.read_artifact(self.model)
        config = artifacts.config_from_json(fitted.manifest.config)
        ddg = replace(
            config.ddg,
            init_from=str(self.model.resolve()),
            sampler="progressive",
            sample_steps=self.evaluations,
            distil_steps=config.ddg.distil_steps if self.steps is None else self.steps,
        )
        config = replace(config, ddg=ddg)

        def work(progress):
            from ddg_jax.stage import fit_folder

            return fit_folder(config, self.data, self.out / "ddg", progress=progress)

        inputs = {"data": str(self.data.resolve()), "model": fitted.hash}
        stage = pipeline.get_stage("ddg")
        pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs)


@dataclass(frozen=True)
class DDGGenerate:
    """Give all demos the camera's artefacts: a stream in constant memory, over all devices."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    demos: Path
    """Stage directory of collected demos, for example runs/demo/demos."""
    out: Path
    """Directory of a run; the depth goes to its folder noisy."""
    seed: int = 0
    """Of the noise."""
    resume: bool = False
    """Continue what is there."""

    def run(self) -> None:
        inputs = {name: artifacts.read_artifact(getattr(self, name)).hash for name in ("model", "demos")}
        config = artifacts.config_from_json(artifacts.read_manifest(self.model).config)
        config = replace(config, seed=self.seed)

        def work(progress):
            from ddg_jax.generate import generate_store

            return generate_store(self.model, self.demos, self.out / stage.name, config, progress)

        stage = pipeline.Stage("noisy", "ddg_jax", ("demos", "ddg"), "depth of the demos with artefacts")
        made = pipeline.make(stage, config, self.out, work, resume=self.resume, inputs=inputs).manifest
        print(
            "{episodes} episodes, {frames} frames, {invalid_fraction:.1%} of pixels invalid".format(
                **made.metrics
            )
        )


@dataclass(frozen=True)
class DDGThresholds:
    """Holes, flicker and error over thresholds of a fitted noise model's mask: a table, JSON, a PNG."""

    model: Path
    """Stage directory of a fitted model, for example runs/demo/ddg."""
    data: Path
    """A recording, or a folder of them; its last frames are used."""
    out: Path = Path()
    """Where thresholds.json and thresholds.png go."""
    count: int = 180
    """Frames."""
    seed: int = 1
    """Of the noise."""

    def run(self) -> None:
        from ddg_jax import thresholds
        from ddgrasp.progress import Progress

        check_count("--count", self.count)
        progress = Progress(name="thresholds")
        rows = thresholds.analyse(self.model, self.data, self.out, progress, count=self.count, seed=self.seed)
        print(f"{thresholds.table(rows)}\n{self.out / thresholds.FILE}.png")
