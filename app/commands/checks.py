"""What commands check before they write anything: options of their own, names, files, devices.

What a value of the configuration may be, the configuration itself knows (ddgrasp/config/); here is what needs
files, devices or packages above it.
"""

import contextlib
import os
import sys
import tempfile
import typing
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ddgrasp import artifacts
from ddgrasp.config import PROGRESSIVE, Config, ScoreConfig, WorldConfig
from ddgrasp.config.checks import Range, check_value, kinds, stated
from ddgrasp.errors import UserError
from ddgrasp.files import TEMPORARY
from ddgrasp.learnable import check_learnable
from ddgrasp.shipped import PRETRAINED, holding, shipped
from ddgrasp.stages import CHECKPOINTS

if TYPE_CHECKING:
    from evaluation.rig_trials import Series


def check_options(command: Any) -> None:
    """UserError for a command's own option beyond the bounds or choices that its type states."""
    for field, kind in kinds(type(command)).items():
        value, option = getattr(command, field), f"--{field.replace('_', '-')}"
        if value is not None and _is_stated(stated(kind)):
            check_value(option, value, stated(kind))


def _is_stated(kind: Any) -> bool:
    """Whether a type says which values it allows: paths, flags and whole configurations do not."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return _is_stated(arguments[0])
    return origin is Literal or (origin is Annotated and any(isinstance(x, Range) for x in arguments[1:]))


def check_config_values(
    config: Config, run_dir: Path | None = None, finished: Collection[str] = ()
) -> Config:
    """`config` if the names and files in it exist; UserError with the remedy otherwise.

    What a stage starts from is asked for no more where `run_dir` has it finished, or `finished` names it.
    """
    from ddg_jax import start
    from student_jax.source_check import check_source

    check_objects(config.world)
    check_learnable(config)
    made = [stage for stage in CHECKPOINTS if run_dir and artifacts.is_finished(run_dir / stage)]
    ahead = CHECKPOINTS.keys() - {*made, *finished}
    for stage in ("ddg", "student"):
        if stage in ahead:
            check_start(stage, f"{stage}.init_from", getattr(config, stage).init_from)
    if config.ddg.init_from and "ddg" in ahead:
        start.check(config.ddg)
    if config.teacher.starts_from_file and "teacher" in ahead:
        check_start("teacher", "teacher.start", config.teacher.start, "nothing, guide, or ")
    check_source(config)
    if config.student.encoder.weights and "student" in ahead:
        from student_jax import pretrained_encoder

        pretrained_encoder.source(config.student)
    return config


def check_objects(world: WorldConfig) -> None:
    """UserError unless all of the world's objects are known."""
    from mjx_envs.objects import get_object

    for name in world.objects:
        get_object(name)


def check_tried(series: "Series") -> None:
    """UserError for a plain shape among the objects of `series` where its rig, the FR3's, has none."""
    from mjx_envs.objects import SHAPES

    if shapes := [name for name in series.objects if name in SHAPES.keys() - series.known()]:
        raise UserError(
            f"object {shapes[0]!r} is a plain shape, which the development rig alone has: choose one of "
            f"{', '.join(series.known())}."
        )


def check_file(option: str, path: Path) -> None:
    """UserError if `path` cannot become a file: it is a folder or device, or nothing can be written there."""
    if os.path.isdir(path):
        raise UserError(f"{option} is {path}, a folder: name a file, in it or elsewhere.")
    if os.path.exists(path) and not os.path.isfile(path):
        raise UserError(f"{option} is {path}, a device or pipe, which a file would replace: name another.")
    _try_writing(option, path, path.absolute().parent, "a file")


def check_folder(option: str, path: Path) -> None:
    """UserError if no files can be written into the folder `path`, which need not be there yet."""
    _try_writing(option, path, path.absolute(), "a folder")


def _try_writing(option: str, path: Path, folder: Path, kind: str) -> None:
    """Makes what is missing of `folder` and a file in it, as `atomic_path` would, and takes them away."""
    missing: list[Path] = []
    try:
        missing += (place for place in (folder, *folder.parents) if not place.exists())
        there = next(place for place in (folder, *folder.parents) if place not in missing)
        if not there.is_dir():
            raise UserError(f"{option} is {path}, and {there} is no folder: name {kind} elsewhere.")
        folder.mkdir(parents=True, exist_ok=True)
        (tried := folder / f"{TEMPORARY}{os.getpid()}-{path.name}").touch()
        tried.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(
            f"{option} is {path}, where nothing can be written ({error.strerror}): name {kind} elsewhere."
        ) from None
    finally:
        for place in missing:
            with contextlib.suppress(OSError):
                place.rmdir()


def is_shipped(directory: Path) -> bool:
    """Whether `directory` is, or lies in, what comes with the project: it is not written over."""
    return directory.resolve().is_relative_to(PRETRAINED.resolve())


def check_score(score: ScoreConfig) -> None:
    """UserError unless the networks that the scores name have their weights."""
    from foundation import catalog, store

    for name in score.features:
        if name in (catalog.FID_INCEPTION, catalog.RESNET18):
            store.read_manifest(store.WEIGHTS_DIR / name)
    if score.monocular_weights:
        store.read_manifest(Path(score.monocular_weights))
    elif set(score.columns) == {"monocular"}:  # among others it is left out, and that is said
        store.read_manifest(store.WEIGHTS_DIR / f"{score.monocular}_small")


def check_data(option: str, path: Path) -> None:
    """UserError unless there is a recording, or a folder of them, to read."""
    from sensors.recordings.recording import recording_folders

    if not path.exists():
        raise UserError(f"{option} is {path}, which does not exist: give a recording or a folder of them.")
    if not path.is_dir():
        raise UserError(
            f"{option} is {path}, a file: give a recording or a folder of them; of a RealSense file "
            f"`ddgrasp record import {path}` makes one."
        )
    if not recording_folders(path):
        raise UserError(
            f"{option} is {path}, which holds no recording (color/, depth/, meta.json): give one or a folder "
            "of them; `ddgrasp record import` makes them of pictures or RealSense files."
        )


def recordings_in(option: str, path: Path) -> dict[str, Any]:
    """The input of a stage that reads recordings at `path`, and which they are; errors of `check_data`."""
    from sensors.recordings.recording import contents

    check_data(option, path)
    return {"data": path, "recordings": contents(path)}


def stage_folder(option: str, path: Path, stage: str) -> Path:
    """The finished `stage` that `path` is, or that lies in the run `path`; UserError if there is none, or if
    `path` is another stage's."""
    if found := holding(path, artifacts.MANIFEST, stage):
        artifacts.check_stage(option, found, stage)
        return found
    trouble = "holds no finished stage" if shipped(path).exists() else "does not exist"
    raise UserError(f"{option} is {path}, which {trouble}: give a run that has made {stage}, or its folder.")


def check_devices(config: Config, run_dir: Path) -> None:
    """UserError if pictures cannot be drawn here, or the teacher, unless it is finished, not be trained; what
    that takes on standard error."""
    if config.world.renderer == "warp":  # any other draws anywhere, and to import MJX takes seconds
        from mjx_envs.physics.mjx_warp import require_gpu

        require_gpu("renderer")
    if not artifacts.is_finished(run_dir / "teacher"):
        from ppo.stage import check

        if need := check(config):
            print(need, file=sys.stderr, flush=True)


ON_PICTURES = ("demos", "ddg", "student")
"""Stages that work on pictures."""


def check_networks(config: Config, run_dir: Path, stages: Collection[str] = ON_PICTURES) -> list[str]:
    """What each unfinished of the `stages` will take, a line for each; UserError if it is too much, if the
    student would start from another network, if simulated depth has another shape than the generator's, or
    its evaluations cannot be halved.

    Traces a step of each, which the stages do as well.
    """
    left = [name for name in ON_PICTURES if name in stages and not artifacts.is_finished(run_dir / name)]
    if not left:
        return []
    from ddg_jax import distil
    from ddg_jax import memory as ddg_memory
    from ddg_jax.sample import check_aspect
    from demos import memory as demos_memory
    from learning import memory
    from student_jax import memory as student_memory
    from student_jax import start
    from student_jax.source_check import LEARNED

    if "student" in left:
        if config.student.depth_source in LEARNED:
            check_aspect((config.world.profile.height_px, config.world.profile.width_px), config.ddg)
        start.check(config)
    if "ddg" in left and config.ddg.sampling.sampler == PROGRESSIVE:
        distil.check(config.ddg)
    need_of = {"demos": demos_memory.need, "ddg": ddg_memory.need, "student": student_memory.need}
    needs = []
    for name in left:
        needs.append(need_of[name](config))
        memory.check(needs[-1], run_dir)
    return [str(need) for need in needs]


def tell_needs(config: Config, run_dir: Path, stages: Collection[str] = ON_PICTURES) -> None:
    """`check_networks`, its lines on standard error, and how a generator that is loaded will be drawn, where
    that is otherwise than as it was made."""
    from ddg_jax import start

    if config.ddg.init_from and "ddg" in stages and not artifacts.is_finished(run_dir / "ddg"):
        if other := start.drawn_otherwise(config.ddg):
            print(other, file=sys.stderr, flush=True)
    for need in check_networks(config, run_dir, stages):
        print(need, file=sys.stderr, flush=True)


def tell_fit(config: Config, data: Path, directory: Path, most: int | None = None) -> None:
    """`tell_needs` of a generator that is fitted in `directory` on recordings at `data`, the first `most` of
    their frames. Reads none."""
    if artifacts.is_finished(directory):
        return
    from ddg_jax import distil
    from ddg_jax import memory as ddg_memory
    from learning import memory
    from sensors.recordings.recording import depth_picture_count, recording_folders

    if config.ddg.sampling.sampler == PROGRESSIVE:
        distil.check(config.ddg)
    frames = depth_picture_count(recording_folders(data))
    need = ddg_memory.need(config, frames if most is None else min(most, frames))
    memory.check(need, directory)
    print(need, file=sys.stderr, flush=True)


def tell_trials(config: Config) -> None:
    """`tell_needs` of a student's trials in its own simulation, which are no stage."""
    from learning import memory
    from student_jax.memory import trials_need

    need = trials_need(config)
    memory.check(need, Path(tempfile.gettempdir()))
    print(need, file=sys.stderr, flush=True)


def check_start(stage: str, option: str, folder: str, others: str = "") -> None:
    """UserError unless `folder` is empty or holds the stage's checkpoint; `others` might be given instead."""
    file = CHECKPOINTS[stage]
    if not folder or holding(folder, file, stage):
        return
    pretrained = Path(folder).parts[:1] == ("pretrained",)
    remedy = (
        f"{PRETRAINED} has what comes with this project"
        if pretrained
        else f"give {others}a run or pretrained folder" + ("" if others else ", or nothing")
    )
    trouble = f"holds no {file}" if shipped(folder).exists() else "does not exist"
    raise UserError(f"{option} is {folder!r}, which {trouble}: {remedy}.")
