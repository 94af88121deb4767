"""The commands of `ddgrasp`, one dataclass each: its fields are the options, `run` does the work.

Stages are imported inside `run`, so that `--help` starts without JAX.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from app import pipeline
from app.commands.base import DEFAULT_PRESET, Command, FromPreset
from app.commands.calibrate import Calibrate, CalibrateBoard
from app.commands.checks import check_config_values, check_devices, check_options, tell_needs
from app.commands.dataset import DemosExport
from app.commands.ddg import DDGDistil, DDGExport, DDGFit, DDGGenerate, DDGSample, DDGThresholds
from app.commands.depth import DemosCollect, Record, RecordFr3, RecordImport, RecordRealsense, SensorsCompare
from app.commands.other import ObjectsList, ObjectsSheet, Report, WeightsConvert, WeightsList
from app.commands.parsing import HELP_ALL, parsed
from app.commands.play import Play
from app.commands.rig import RigFr3, RigPictures
from app.commands.score import DDGCurve, DDGFeatures, DDGSamplers, DDGScore, Scoring
from app.commands.student import (
    DEFAULT_POLICY,
    Deploy,
    Export,
    StudentEval,
    StudentPerception,
    StudentTrain,
    config_of,
)
from app.commands.study import StudyCauses, StudyTable2
from app.commands.teacher import TeacherCompare, TeacherEval, TeacherTrain, with_world_of
from app.commands.trials import DeployTrials
from app.commands.words import check_words
from ddgrasp import artifacts, config_file
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from ddgrasp.scaling import scaled
from ddgrasp.shipped import holding, shipped


@dataclass(frozen=True)
class Run(FromPreset):
    """The whole flow: teacher, demos, record, ddg, student, export, deploy, report."""

    def run(self) -> None:
        """Says what memory the stages will take, makes those that are not finished, prints the table."""
        pipeline.check_place(self.config, self.out, resume=self.resume)
        check_config_values(self.config, self.out)
        check_devices(self.config, self.out)
        tell_needs(self.config, self.out)
        report = pipeline.run(self.config, self.out, resume=self.resume)
        from evaluation.report.summary import print_summary

        print(f"{self.out / 'report.json'}\n{self.out / 'report.html'}\n")
        print_summary(report)


_SCALE = "--scale"
COMMANDS: dict[str, type] = {
    "play": Play,
    "run": Run,
    "teacher train": TeacherTrain,
    "teacher eval": TeacherEval,
    "teacher compare": TeacherCompare,
    "demos collect": DemosCollect,
    "demos export": DemosExport,
    "record": Record,
    "record import": RecordImport,
    "record realsense": RecordRealsense,
    "record fr3": RecordFr3,
    "ddg fit": DDGFit,
    "ddg sample": DDGSample,
    "ddg score": DDGScore,
    "ddg curve": DDGCurve,
    "ddg samplers": DDGSamplers,
    "ddg features": DDGFeatures,
    "ddg distil": DDGDistil,
    "ddg generate": DDGGenerate,
    "ddg export": DDGExport,
    "ddg thresholds": DDGThresholds,
    "student train": StudentTrain,
    "student eval": StudentEval,
    "student perception": StudentPerception,
    "export": Export,
    "deploy": Deploy,
    "deploy trials": DeployTrials,
    "calibrate": Calibrate,
    "calibrate board": CalibrateBoard,
    "study table2": StudyTable2,
    "study causes": StudyCauses,
    "rig fr3": RigFr3,
    "rig pictures": RigPictures,
    "weights convert": WeightsConvert,
    "weights list": WeightsList,
    "report": Report,
    "objects list": ObjectsList,
    "sensors compare": SensorsCompare,
    "objects sheet": ObjectsSheet,
}


def parse(name: str, args: Sequence[str]) -> Command:
    """The command `name` with its options; --help and --help-all print and raise SystemExit(0), options
    that are wrong raise UserError."""
    cls = COMMANDS[name]
    check_words(cls, args)
    if cls in (Deploy, Calibrate) and _option(args, _SCALE) is not None:
        raise UserError(f"{_SCALE} makes nothing smaller that `ddgrasp {name}` does: leave it out.")
    options: dict[str, Any] = {}
    if issubclass(cls, FromPreset):
        base = _base(args, cls.default_preset())
        options["default"] = cls(config=base, out=cls.default_out(base.preset))
    elif issubclass(cls, Scoring):
        preset = get_preset(_option(args, "--preset") or DEFAULT_PRESET)
        default = cls(preset.score, preset.preset, Path("runs") / preset.preset)
        options["default"] = replace(default, ddg=preset.ddg) if isinstance(default, DDGScore) else default
    elif cls is Deploy:
        policy = shipped(_option(args, "--policy") or DEFAULT_POLICY)
        file = _option(args, "--config")
        config = config_of(policy, _option(args, "--preset"), Path(file) if file else None)
        options["default"] = Deploy(config=config, policy=policy)
    elif cls is Calibrate:
        options["default"] = Calibrate(_base(args, DEFAULT_PRESET))
    elif cls is TeacherEval:
        options["default"] = with_world_of(_teacher_s_run(args))
    program, whole = f"ddgrasp {name}", HELP_ALL in args
    given = ["--help" if arg == HELP_ALL else arg for arg in args]
    read = partial(tyro.cli, cls, prog=program, args=given, **options)
    command = _found(parsed(read, program, whole, _unread(cls)))
    check_options(command)
    return command


def _unread(cls: type) -> tuple[str, ...]:
    """Options that the command refuses: help does not show them."""
    if issubclass(cls, Scoring):
        return tuple(f"--{name.replace('_', '-')}" for name in cls.unread)
    return (_SCALE,) if cls in (Deploy, Calibrate) else ()


def _found(command: Any) -> Any:
    """`command` with the places of what it reads that comes with this project (`shipped`)."""
    reads = [field.name for field in fields(command) if field.name != "out" or isinstance(command, Report)]
    return replace(command, **{name: _place(getattr(command, name)) for name in reads})


def _place(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_place(item) for item in value)
    return shipped(value) if isinstance(value, Path) else value


def _teacher_s_run(args: Sequence[str]) -> Path | None:
    """The run, or its teacher's folder, among the arguments of `teacher eval`, wherever it stands."""
    words = zip(("", *args), args, strict=False)
    places = (shipped(arg) for before, arg in words if arg and before != "--out")
    return next((place for place in places if _has_teacher(place)), None)


def _has_teacher(place: Path) -> bool:
    found = holding(place, artifacts.MANIFEST, "teacher")
    return found is not None and artifacts.read_manifest(found).stage == "teacher"


def _base(args: Sequence[str], default_preset: str) -> Config:
    """What single values are given besides: the file of --config, or a preset at --scale."""
    file, preset, scale = (_option(args, name) for name in ("--config", "--preset", _SCALE))
    if file is None:
        return _scaled(get_preset(preset or default_preset), scale)
    for name, value in (("--preset", preset), (_SCALE, scale)):
        if value is not None:
            raise UserError(f"--config {file} and {name} {value} both say where to begin: give one.")
    return config_file.read(Path(file))


def _scaled(preset: Config, scale: str | None) -> Config:
    """`preset` at the `scale` of the command line; what is no scale is left to the parser to refuse."""
    try:
        factor = float(scale or 1)
    except ValueError:
        return preset
    return scaled(replace(preset, scale=factor), factor)


_TASKS = {
    "begin": ("play", "run", "report"),
    "teacher and its demonstrations": ("teacher", "demos"),
    "a depth camera and its noise": ("record", "sensors", "ddg"),
    "student": ("student", "export", "study"),
    "robot": ("deploy", "calibrate", "rig"),
    "objects, networks of other people": ("objects", "weights"),
}
"""First words of commands, by what they are for."""


def describe_commands(group: str = "") -> str:
    """The list that `ddgrasp --help` (or `ddgrasp teacher`) prints."""
    listed = {word for words in _TASKS.values() for word in words}
    others = tuple(sorted({name.split()[0] for name in COMMANDS} - listed))
    lines = [
        line
        for task, words in (_TASKS | {"others": others}).items()
        if (
            names := [
                name for name in COMMANDS if name.split()[0] in words and group in ("", name.split()[0])
            ]
        )
        for line in ("", f"{task}:", *map(_described, names))
    ]
    usage = f"usage: ddgrasp COMMAND [options]   (--help for a command's options, {HELP_ALL} for all values)"
    return "\n".join([usage, *lines, "", *_PRESET_HELP])


def _described(name: str) -> str:
    return f"  {name:<16} {(COMMANDS[name].__doc__ or '').splitlines()[0]}"


_PRESET_HELP = (
    "Presets (--preset): debug (tests; teacher from the pretrained one), demo (teacher from the scripted",
    "guide, student from the pretrained one; 19 to 35 minutes on two cores), laptop (random first weights,",
    "teacher from the guide, twelve training objects; 50 to 81 minutes), ppo and ppo_paper (laptop with a",
    "teacher by PPO from nothing, six), camera (laptop, the generator for a real camera that moves),",
    "student_paper (laptop with the paper's own student, six), paper (PPO from nothing, one GPU).",
    "Any value can be given, for example --teacher.num-envs 64. --scale 0.001 makes all its counts that much",
    "smaller, never its networks or pictures: a trial run, whose figures mean nothing.",
    'Commands and options are completed after  eval "$(ddgrasp completion bash)"  (or zsh).',
)


def _option(args: Sequence[str], name: str) -> str | None:
    """Value of `--name value` or `--name=value` among `args`, the last one, as the parser takes it."""
    value = None
    for index, arg in enumerate(args):
        if arg == name and index + 1 < len(args):
            value = args[index + 1]
        if arg.startswith(f"{name}="):
            value = arg.split("=", 1)[1]
    return value
