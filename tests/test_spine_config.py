"""The configuration checks itself: every field has bounds or choices, from Python and the command line."""

import ast
import dataclasses
import inspect
import itertools
import math
import textwrap
import typing
from typing import Annotated, Literal

import numpy as np
import pytest

from app.cli import main
from app.commands import parse
from app.commands.checks import check_config_values
from ddg_jax import prior, sensor
from ddgrasp.config import (
    Config,
    DDGConfig,
    DDGDiffusionConfig,
    DDGTrainingConfig,
    DeployConfig,
    DepthFeatureConfig,
    DextrahConfig,
    EncoderConfig,
    HandViewConfig,
    HeadConfig,
    HostsConfig,
    PriorSource,
    RandomConfig,
    SamplingConfig,
    Section,
    SensorConfig,
    StudentConfig,
    TeacherConfig,
    UNetConfig,
    WorldConfig,
)
from ddgrasp.config.checks import FreeText, Range, check_value, kinds
from ddgrasp.config.score import Monocular
from ddgrasp.config.sensors import SENSORS
from ddgrasp.config_hash import config_hash
from ddgrasp.errors import UserError
from ddgrasp.learnable import check_learnable
from ddgrasp.presets import PRESETS
from foundation import catalog
from learning import diffusion

ROOTS = (Config, SensorConfig, HostsConfig, DepthFeatureConfig)


def sections(config: type) -> dict[str, type]:
    """Every dataclass in a configuration, by its full name."""
    found = {config.__name__: config}
    for kind in kinds(config).values():
        if dataclasses.is_dataclass(kind):
            found |= sections(typing.cast(type, kind))
    return found


ALL = {name: section for root in ROOTS for name, section in sections(root).items()}


def leaves(kind) -> list:
    """The types of single values in a field's type."""
    if typing.get_origin(kind) is tuple:
        return [leaf for item in typing.get_args(kind) if item is not Ellipsis for leaf in leaves(item)]
    return [kind]


@pytest.mark.parametrize("name", sorted(ALL))
def test_every_field_states_what_it_may_hold_and_what_it_is_for(name):
    assert issubclass(ALL[name], Section)
    for field, kind in kinds(ALL[name]).items():
        for leaf in leaves(kind):
            origin, arguments = typing.get_origin(leaf), typing.get_args(leaf)
            if origin is Annotated:
                wanted = FreeText if arguments[0] is str else Range
                assert any(isinstance(extra, wanted) for extra in arguments[1:]), (name, field)
            else:
                assert origin is Literal or leaf is bool or leaf in ALL.values(), (name, field)


@pytest.mark.parametrize("name", sorted(ALL))
def test_every_field_has_a_help_text(name):
    body = ast.parse(textwrap.dedent(inspect.getsource(ALL[name]))).body[0].body  # pyright: ignore
    told = {
        before.target.id
        for before, after in itertools.pairwise(body)
        if isinstance(before, ast.AnnAssign) and isinstance(after, ast.Expr)
    }
    sub = {field for field, kind in kinds(ALL[name]).items() if kind in ALL.values()}
    assert kinds(ALL[name]).keys() - sub <= told
    assert ALL[name].__doc__


@pytest.mark.parametrize("name", sorted(ALL))
def test_every_number_is_held_to_its_bounds(name):
    default = ALL[name]() if name != "Config" else Config("test")
    for field, kind in kinds(ALL[name]).items():
        if typing.get_origin(kind) is not Annotated or typing.get_args(kind)[0] is str:
            continue
        number, bounds = typing.get_args(kind)[:2]
        beyond = [bounds.least - 1, bounds.most + 1, *([bounds.least] if bounds.above else [])]
        for value in (*beyond, math.nan, math.inf, "1", None, True):
            value = number(value) if value in beyond else value
            with pytest.raises(UserError, match=rf"{field} is .*; expected "):
                dataclasses.replace(default, **{field: value})
        if number is int:
            with pytest.raises(UserError, match="expected a whole number"):
                dataclasses.replace(default, **{field: 1.5})


@pytest.mark.parametrize("name", sorted(ALL))
def test_every_choice_suggests_the_nearest(name):
    default = ALL[name]() if name != "Config" else Config("test")
    for field, kind in kinds(ALL[name]).items():
        if typing.get_origin(kind) is Literal and isinstance(typing.get_args(kind)[0], str):
            choice = max(typing.get_args(kind), key=len)
            with pytest.raises(UserError, match=rf"Unknown \S*{field} '{choice}x'\. Did you mean '{choice}'"):
                dataclasses.replace(default, **{field: choice + "x"})


def test_numbers_of_numpy_are_numbers():
    assert UNetConfig(space_to_depth=np.int64(2)).space_to_depth == 2  # pyright: ignore
    assert SamplingConfig(eta=np.float32(0.5)).eta == 0.5  # pyright: ignore
    assert EncoderConfig(output_stride=np.int64(16)).output_stride == 16  # pyright: ignore


def test_an_output_stride_that_the_stages_do_not_reach_is_refused_and_read_as_ever():
    for blocks, refused in (((1, 1, 1, 1), False), ((1, 1, 1), True)):
        encoder = EncoderConfig(stage_blocks=blocks, output_stride=32)
        student = dataclasses.replace(PRESETS["demo"].student, encoder=encoder)
        config = dataclasses.replace(PRESETS["demo"], student=student)
        if not refused:
            check_learnable(config)
            continue
        with pytest.raises(
            UserError, match=r"output_stride is 32; expected at most 16, which is what 3 stage"
        ):
            check_learnable(config)


def test_a_whole_number_is_a_float_where_floats_are_held():
    whole = DeployConfig(stale_periods=3, arm_lower_m=(-1, -1, 0))
    given = DeployConfig(stale_periods=3.0, arm_lower_m=(-1.0, -1.0, 0.0))
    assert type(whole.stale_periods) is type(whole.arm_lower_m[0]) is float
    whole, given = (dataclasses.replace(PRESETS["demo"], deploy=deploy) for deploy in (whole, given))
    assert config_hash(whole, "deploy") == config_hash(given, "deploy")


@pytest.mark.parametrize(
    ("choices", "taken", "refused"),
    [
        (Literal[4, 8], 8, 8.0),
        (Literal[1, 2], 1, True),
        (Literal[True], True, 1),
        (Literal[0.5, 1.0], 1.0, 1),
        (Literal["1"], "1", 1),
    ],
)
def test_what_equals_a_choice_and_is_of_another_type_is_none(choices, taken, refused):
    check_value("x", taken, choices)
    with pytest.raises(UserError, match=rf"^x is {refused}; expected one of "):
        check_value("x", refused, choices)


def test_a_field_without_bounds_is_an_error_of_the_programmer():
    @dataclasses.dataclass(frozen=True)
    class Forgetful(Section, name="forgetful"):
        count: int = 1

    with pytest.raises(TypeError, match="forgetful.count has type .* which states no bounds"):
        Forgetful()


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: WorldConfig(sim_dt_s=0.003), "world.sim_dt_s is 0.003; expected a step that divides"),
        (lambda: TeacherConfig(num_envs=10, minibatches=4), "num_envs 10 is no multiple of"),
        (lambda: UNetConfig(widths=(8, 8), blocks=(1,)), "expected one number per level"),
        (lambda: UNetConfig(widths=(8, 10), blocks=(0, 0)), "attention_heads is 4; expected a divisor"),
        (lambda: UNetConfig(widths=()), "ddg.unet.widths is empty; expected at least one"),
        (lambda: DDGConfig(sampling=SamplingConfig(steps=2000)), "steps is 2000; expected 1 to 1000"),
        (lambda: DDGConfig(unet=UNetConfig(space_to_depth=64)), "folds 256 x 256 pixels into one"),
        (lambda: DDGTrainingConfig(snr_limits=(2.0, math.nan)), "snr_limits is nan; expected a finite"),
        (lambda: HeadConfig(chunk=2, execute_steps=3), "execute_steps is 3: expected 1 to"),
        (lambda: HeadConfig(ddim_steps=60), "ddim_steps is 60; expected 1 to 50"),
        (lambda: HeadConfig(aux_to_head=False), "are both off: turn one on"),
        (lambda: HeadConfig(time_features=7), "time_features is 7; expected a multiple of 2"),
        (lambda: EncoderConfig(width=12), "width is 12; expected a multiple of 8, as norm group"),
        (lambda: HandViewConfig(size_px=6), "size_px is 6; expected a multiple of 4"),
        (lambda: StudentConfig(hand_view=HandViewConfig(width=12)), "hand_view.width is 12; expected"),
        (lambda: DextrahConfig(random_near_m=3.0), "random_near_m is 3.0; expected at most random_far_m"),
    ],
)
def test_values_that_do_not_fit_each_other_are_refused(make, expected):
    with pytest.raises(UserError, match=expected):
        make()


def test_stages_that_do_not_fit_each_other_are_refused():
    config = PRESETS["demo"]
    for changes, expected in (
        ({"world": dataclasses.replace(config.world, camera_scale=0.125)}, "the camera's crop window has 56"),
        ({"export": dataclasses.replace(config.export, ddim_steps=51)}, "export.ddim_steps is 51; expected"),
        ({"deploy": dataclasses.replace(config.deploy, execute_steps=3)}, "deploy.execute_steps is 3"),
        (
            {"world": WorldConfig(random=RandomConfig(held_share=0.1))},
            "world.random.held_share is 0.1; expected 0 in a run: .*by teacher.held_share",
        ),
    ):
        with pytest.raises(UserError, match=expected):
            dataclasses.replace(config, **changes)
    training = dataclasses.replace(config.student.training, crop_shift_px=40)
    with pytest.raises(UserError, match="crop_shift_px is 40; expected 0 to 34"):
        dataclasses.replace(config, student=dataclasses.replace(config.student, training=training))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ("training.aux_weight=0", "aux_weight and action_weight are both 0"),
        (
            "head.aux_to_head=no head.features_to_head=yes training.action_weight=1",
            "rounds is 8, and student",
        ),
        ("head.features_to_head=yes", "action_weight 0: the head would act before it has learnt"),
        ("poses.rounds=0", "nothing would have trained the action head before it acts"),
        ("poses.rounds=0 dagger.rounds=0 head.train_steps=0", "nothing would have trained the action head"),
        ("poses.steps=0", "poses.rounds 8 and steps 0, .*action_weight 0, .* nothing would have trained"),
        ("poses.steps=0 dagger.rounds=0 head.train_steps=0", "nothing would have trained the action head"),
        (
            "training.action_weight=1 training.steps=0 poses.rounds=0",
            "steps 0, no student.init_from: nothing",
        ),
        (
            "training.action_weight=1 training.steps=0 poses.rounds=0 dagger.rounds=0 head.train_steps=0",
            "nothing would have trained the action head before it acts; give rounds and steps on p",
        ),
        (
            "head.features_to_head=yes training.action_weight=1 training.steps=0",
            "training.steps 0: the head would act before it has learnt",
        ),
        ("head.batch_size=1", "student.head.batch_size is 1; expected at least 2"),
        ("head.blocks=0", "the head would see neither an observation nor the diffusion step"),
        ("training.steps=0 dagger.rounds=0", "nothing would have trained perception; give steps, or"),
        ("training.steps=0 dagger.steps=0", "dagger.rounds 2 and dagger.steps 0, no student.init_from"),
    ],
)
def test_a_student_that_nothing_would_train_is_refused(values, expected):
    arguments = [word for value in values.split() for word in _option("student", value)]
    with pytest.raises(UserError, match=expected):
        check_config_values(parse("run", ["--preset", "laptop", *arguments]).config)


def _option(section: str, value: str) -> list[str]:
    name, _, given = value.replace("_", "-").partition("=")
    *groups, field = name.split(".")
    if given in ("yes", "no"):
        return [f"--{'.'.join([section, *groups, 'no-' * (given == 'no') + field])}"]
    return [f"--{section}.{name}", given]


def test_a_teacher_whose_actor_would_never_learn_is_refused():
    with pytest.raises(UserError, match=r"critic_warmup is 10, .*100000 makes 10 iteration\(s\)"):
        check_config_values(parse("run", ["--preset", "demo", "--teacher.total-steps", "100000"]).config)
    check_config_values(parse("run", ["--preset", "demo", "--scale", "0.001"]).config)
    with pytest.raises(UserError, match="episode_steps is 4; success is an object held for the last 5"):
        check_config_values(parse("run", ["--preset", "demo", "--world.episode-steps", "4"]).config)
    for preset in PRESETS.values():
        check_learnable(preset)


def test_a_bonus_beyond_float32_is_refused_before_the_policy_has_learnt_to_hold():
    args = ["--preset", "demo", "--world.reward.bonus-growth", "20", "--world.reward.bonus-max-count"]
    with pytest.raises(UserError, match=r"bonus_growth 20 to the power of 60 .* is a bonus beyond 1e\+15"):
        check_learnable(parse("run", [*args, "1000"]).config)
    check_learnable(parse("run", [*args, "10"]).config)
    check_learnable(
        parse(
            "run", [*args, "1000", "--teacher.start", "pretrained/teacher", "--teacher.total-steps", "0"]
        ).config
    )


def test_a_whole_number_beyond_all_floats_is_refused():
    with pytest.raises(UserError, match="total_steps is 1000"):
        parse("run", ["--preset", "demo", "--teacher.total-steps", str(10**400)])


def test_a_schedule_that_does_not_end_in_noise_is_refused_before_it_is_fitted_and_read_as_ever():
    shifted = DDGDiffusionConfig(500, "linear", 3.0)
    ddg = dataclasses.replace(PRESETS["demo"].ddg, diffusion=shifted)
    with pytest.raises(UserError, match=r"log_snr_shift is 3\.0; expected at most 0\.5 with 500 steps"):
        check_learnable(dataclasses.replace(PRESETS["demo"], ddg=ddg))


@pytest.mark.parametrize(
    ("name", "steps", "shift", "error"),
    [("linear", 2500, 0.0, 0.0), ("linear", 4000, 0.0, 0.4), ("cosine", 1000, -10.0, 0.02)],
)
def test_a_schedule_whose_first_prediction_rounding_would_drown_is_refused(name, steps, shift, error):
    """A sampler makes eps of the network's x_0 in float32, and x_0 of eps again."""
    settings, schedule = DDGDiffusionConfig(steps, name, shift), diffusion.make_schedule(name, steps, shift)
    x, x_0 = np.random.default_rng(0).standard_normal(10_000).astype(np.float32), np.float32(0.5)
    signal = np.float32(schedule.alpha_bars[-1])
    eps = (x - np.sqrt(signal) * x_0) / np.sqrt(1 - signal)
    back = np.clip(diffusion.predict_x_0(schedule, x, np.array(steps - 1), eps), -1, 1)
    off = float(np.abs(back - x_0).mean())
    ddg = dataclasses.replace(PRESETS["demo"].ddg, diffusion=settings)
    config = dataclasses.replace(PRESETS["demo"], ddg=ddg)
    if not error:
        assert off < 0.01
        check_learnable(config)
        return
    assert off > error
    with pytest.raises(UserError, match=rf"log_snr_shift is {shift}; expected at least .* {steps} steps"):
        check_learnable(config)


@pytest.mark.parametrize(("name", "accepted"), [("linear", 15), ("cosine", 36)])
def test_schedules_that_configurations_take_have_noise_at_both_ends(name, accepted):
    taken = 0
    for steps in (2, 50, 499, 500, 1000, 5000, 5001, 100_000):
        for shift in (-10.0, 0.0, 1.0, 3.0, 5.0, 10.0):
            try:
                config = DDGDiffusionConfig(steps, name, shift)
            except UserError:
                continue
            alpha_bars = diffusion.make_schedule(name, config.steps, config.log_snr_shift).alpha_bars
            assert np.all(alpha_bars > 0) and np.all(1 - alpha_bars > 0)
            assert (alpha_bars[-1] < 0.01) == (shift < config.noisy_up_to), (steps, shift)
            taken += 1
    assert taken == accepted  # of 48


def test_choices_are_those_that_the_code_knows():
    built_in, networks = set(prior._BUILT_IN), set(prior.NETWORKS)
    assert set(typing.get_args(PriorSource)) == built_in | networks
    assert set(typing.get_args(Monocular)) == {catalog.IMAGE_DEPTH, catalog.VIDEO_DEPTH}
    assert set(SENSORS) == set(sensor.SENSORS)
    assert {"linear", "cosine"} == set(diffusion._BETAS)


@pytest.mark.parametrize(
    "command",
    [
        # the choices and ranges that a person mistypes
        "run --student.encoder.pooling spatialsoftmax => Did you mean 'spatial_softmax'? Known: mean,",
        "run --ddg.diffusion.schedule cosin => Did you mean 'cosine'? Known: cosine, linear",
        "run --world.sim-dt-s 0 => world.sim_dt_s is 0.0; expected 0.0001 to 0.1",
        "run --teacher.learning-rate -1 => teacher.learning_rate is -1.0; expected above 0, up to 1",
        "run --student.training.steps -5 => student.training.steps is -5; expected at least 0",
        "run --world.random.size -3 => world.random.size is -3.0; expected 0 to 0.5",
        # every command that takes a configuration
        "teacher train --world.backend cuda => Unknown world.backend 'cuda'",
        "teacher train --world.sim-dt-s nan => expected a finite number",
        "teacher train --teacher.hidden => teacher.hidden is empty; expected at least one",
        "teacher train --hosts.processes 0 => hosts.processes is 0; expected at least 1",
        "teacher eval --world.camera-scale 7 => world.camera_scale is 7.0; expected 0.1 to 1",
        "teacher eval --trials 0 => --trials is 0; expected at least 1",
        "teacher compare runs/x --backends cpu mjx => Unknown backends 'mjx'",
        "demos collect --demos.noise-share 1.5 => demos.noise_share is 1.5; expected 0 to 1",
        "demos collect --demos.parallel 1000000 => demos.parallel is 1000000; expected at most 65536",
        "record --record.stereo.block-px 4 => record.stereo.block_px is 4; expected an odd number",
        "record --record.stereo.flat-window-px 8 => flat_window_px is 8; expected an odd number",
        "record --record.frames -1 => record.frames is -1; expected at least 1",
        "record import x --depth-unit-m 5 => --depth-unit-m is 5.0; expected 0 to 1",
        "ddg fit --ddg.unet.widths 8 8 => expected one number per level in each",
        "ddg fit --ddg.training.learning-rate inf => expected a finite number",
        "ddg fit --ddg.prior.in-sim deph => Unknown ddg.prior.in_sim 'deph'. Did you mean 'depth'?",
        "ddg fit --preset laptop --ddg.sampling.sampler progressive => give --ddg.sampling.spacing quadratic",
        "ddg fit --data nowhere => --data is nowhere, which does not exist",
        "ddg sample --model x --data x --seed -1 => --seed is -1; expected at least 0",
        "ddg distil --model x --data x --out x --evaluations 0 => --evaluations is 0; expected at least 1",
        "ddg generate --model x --demos x --out x --seed -1 => --seed is -1; expected at least 0",
        "ddg score --columns sim_gt dgd => Unknown columns 'dgd'. Did you mean 'ddg'?",
        "ddg score --features resnet => Unknown features 'resnet'. Did you mean 'resnet18'?",
        "ddg score --features resnet18 => weights",
        "ddg curve --curve-trajectories 5 0 => score.curve_trajectories is 0; expected at least 1",
        "ddg samplers --trajectories 1 => score.trajectories is 1; expected at least 2",
        "ddg features --steps 0 => features.steps is 0; expected at least 1",
        "student train --student.head.chunk 1 --student.head.execute-steps 2 => execute_steps is 2: expected",
        "student train --student.picture.height-px 110 => height_px is 110; expected a multiple of 4",
        "student train --student.picture.height-px 400 => the camera's crop window has 112 x 145",
        "student train --student.picture.channels depht => Did you mean 'depth'?",
        "student train --student.encoder.output-stride 5 => expected one of 4, 8, 16, 32",
        "student train --student.training.batch-size 1.5 => expected a whole number",
        "student eval runs/x --trials many => --trials is 'many'; expected a whole number",
        "export --export.max-abs-diff 0 => export.max_abs_diff is 0.0; expected above 0, up to 1",
        "deploy --deploy.workspace-lower-m 0.9 0 0 => expected the lower corner below the upper one",
        "deploy --robot ur5 => Unknown robot 'ur5'. Known: franka, sim",
        "deploy --world.objects cub => Unknown object 'cub'. Did you mean 'cube'?",
        "sensors compare --frames 1 => --frames is 1; expected at least 2",
        "objects sheet --objects cub => Unknown object 'cub'. Did you mean 'cube'?",
        # names that are no options, and values that are missing
        "run --student.train-steps 5 => Unrecognized options: --student.train-steps",
        "run --seed => Missing value for argument '--seed'",
        "weights convert => Missing from ddgrasp weights convert",
    ],
)
def test_a_mistake_gets_one_line_and_leaves_nothing_behind(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments, expected = command.split(" => ")
    assert main(arguments.split()) == 2
    told = capsys.readouterr()
    assert told.err.startswith("ddgrasp: ") and told.err.count("\n") == 1, told.err
    assert expected in told.err
    assert told.out == ""
    assert list(tmp_path.iterdir()) == []
