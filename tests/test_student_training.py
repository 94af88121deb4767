"""Frames, labels, losses and the training plan of the student, by value."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ddgrasp import contract
from ddgrasp.config import (
    Config,
    DaggerConfig,
    EncoderConfig,
    HandViewConfig,
    HeadConfig,
    StudentConfig,
    StudentTrainingConfig,
)
from ddgrasp.depth import to_metres
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json
from ddgrasp.gripper import WidthChange
from ddgrasp.layout import OBSERVATION, closes
from ddgrasp.progress import Progress
from demos.rollout import Scene
from demos.store import EpisodeStore
from learning.params import load_params, save_params
from learning.train_state import first_state
from mjx_envs.camera import nominal_camera
from student_jax import dagger, train
from student_jax.act import StudentActor, keep_clean
from student_jax.augment import disparity_noise, unseen_objects
from student_jax.dagger import ACTED, CHECKPOINTS, PLAN, Trainer, _steps_before
from student_jax.data import aux_targets, make_frames, random_crops, sharpen_gripper, with_change
from student_jax.depth_source import make_source
from student_jax.frames_io import useful_steps
from student_jax.policy import PARAMS_FILE, Aux, Seen, init_params, position_to_world
from student_jax.preprocess import cut, table_depth
from student_jax.privileged import PoseActor, noisy_seen

PROFILE = contract.D455.scaled(0.25)
CONFIG = StudentConfig(
    encoder=EncoderConfig(width=8, keypoints=4, stage_blocks=(1, 1), features=16),
    head=HeadConfig(width=16, blocks=1, state_features=8, chunk=2, execute_steps=1),
    training=StudentTrainingConfig(batch_size=2, noise_draws=2),
    hand_view=HandViewConfig(size_px=8, width=8, blocks=1, channels=2, features=8),
)


def columns_of(lengths=(3, 2)):
    """depth_mm, state, action, observation and held of each episode."""
    count = iter(range(100))
    columns = []
    for n in lengths:
        numbers = np.array([next(count) for _ in range(n)], np.float32)
        observation = np.zeros((n, 40), np.float32)
        observation[:, OBSERVATION.grasp_pos.start] = 0.4 + numbers / 50
        observation[:, 36] = np.cos(0.1)  # quaternion of a hand turned by 0.2 rad, fingers down
        observation[:, 37] = np.sin(0.1)
        columns.append(
            (
                np.full((n, PROFILE.height_px, PROFILE.width_px), 700, np.uint16)
                + numbers[:, None, None].astype(np.uint16),
                np.repeat(numbers[:, None], 8, axis=1),
                np.repeat(numbers[:, None], 8, axis=1) / 10,
                observation,
                numbers > 1,
            )
        )
    return columns


def frames_of(lengths=(3, 2)):
    return make_frames(*zip(*columns_of(lengths), strict=True))


def test_the_first_frame_is_repeated_and_episodes_do_not_mix():
    stack = frames_of().depth_stack(np.array([0, 2, 3, 4]))
    np.testing.assert_array_equal(
        stack[:, :, 0, 0], [[700, 700, 700], [700, 701, 702], [703, 703, 703], [703, 703, 704]]
    )


def test_chunks_repeat_an_episodes_last_label():
    chunks = frames_of().action_chunks(np.array([0, 2, 4]), 3)
    np.testing.assert_allclose(
        chunks[:, :, 0], [[0.0, 0.1, 0.2], [0.2, 0.2, 0.2], [0.4, 0.4, 0.4]], atol=1e-6
    )


def test_privileged_targets_are_the_grasp_s():
    frames = frames_of()
    aux = aux_targets(frames.observation, frames.held)
    np.testing.assert_allclose(position_to_world(aux.position)[:, 0], 0.4 + np.arange(5) / 50, atol=1e-5)
    np.testing.assert_allclose(aux.yaw[0], [np.cos(0.4), np.sin(0.4)], atol=1e-6)
    np.testing.assert_array_equal(aux.held_logit, [0, 0, 1, 1, 1])


def test_steps_with_the_object_in_the_hand_are_drawn_less():
    index = frames_of().draw(np.random.default_rng(0), 6000, 0.25)  # 2 before the grasp, 3 after
    share = np.bincount(index, minlength=5) / 6000
    np.testing.assert_allclose(share, np.array([1, 1, 0.25, 0.25, 0.25]) / 2.75, atol=0.02)


def test_a_demo_ends_after_so_many_steps_with_the_object():
    held = np.array([0, 1, 0, 1, 1, 1], bool)
    assert [useful_steps(held, n) for n in (0, 1, 2, 3, 9)] == [1, 2, 4, 5, 6]


def test_gripper_labels_are_sharp():
    np.testing.assert_array_equal(sharpen_gripper(np.full((2, 8), 0.2))[:, 6:], [[0.2, 1.0], [0.2, 1.0]])
    assert sharpen_gripper(np.full((1, 8), -0.01))[0, 7] == -1.0


def test_crops_stay_within_the_shift():
    crops = random_crops(np.random.default_rng(0), 500, PROFILE, 3)
    away = crops - np.array(PROFILE.crop_origin_px)
    assert away.min() == -3 and away.max() == 3


def test_auxiliary_losses_by_hand():
    seen = Aux(jnp.array([[0.3, 0.0, 0.0]]), jnp.array([[1.0, 0.0]]), jnp.array([0.0]))
    target = Aux(jnp.array([[0.0, 0.0, 0.0]]), jnp.array([[0.0, 1.0]]), jnp.array([1.0]))
    losses = train.aux_losses(seen, target)
    huber = 0.05 * (0.3 - 0.025) / 3  # bound 0.05
    assert float(losses["position"]) == pytest.approx(40 * huber, rel=1e-5)
    assert float(losses["yaw"]) == pytest.approx(1.0)
    assert float(losses["held"]) == pytest.approx(np.log(2), rel=1e-5)


@pytest.mark.parametrize("action_weight", [0.0, 1.0])
def test_a_training_step_is_pure_and_learns(action_weight):
    config = dataclasses.replace(
        CONFIG,
        training=dataclasses.replace(CONFIG.training, action_weight=action_weight, learning_rate=1e-2),
    )
    frames = frames_of((6, 6))
    rng = np.random.default_rng(0)
    batch = train.make_batch(frames, np.arange(8), rng, config, PROFILE)
    steps = 24
    params = init_params(jax.random.key(0), config, PROFILE)
    trained, frozen = train.split(config, params)
    assert ("denoiser" in trained) == bool(action_weight)
    fresh = lambda: train.init_state(config, steps, 0, trained)  # noqa: E731
    one, first = train.train_step(config, PROFILE, steps, fresh(), frozen, batch)
    two, _ = train.train_step(config, PROFILE, steps, fresh(), frozen, batch)
    for a, b in zip(jax.tree.leaves(one.params), jax.tree.leaves(two.params), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    state = fresh()
    for _ in range(steps):
        state, last = train.train_step(config, PROFILE, steps, state, frozen, batch)
    assert float(last["held"]) < 0.7 * float(first["held"])
    assert float(last["yaw"]) < 0.8 * float(first["yaw"])
    assert ("action" in last) == bool(action_weight)


def test_a_batch_is_cropped_by_the_configured_shift():
    index, rng = np.arange(5).repeat(4), np.random.default_rng(0)
    batch = train.make_batch(frames_of(), index, rng, CONFIG, PROFILE)
    shift_px = CONFIG.training.crop_shift_px
    np.testing.assert_array_equal(
        batch.crop_rc, random_crops(np.random.default_rng(0), 20, PROFILE, shift_px)
    )
    assert np.ptp(np.asarray(batch.crop_rc), axis=0).min() > shift_px > 0


class _Blind:
    """In the network's place, so that no step is compiled: keeps the depth that it is shown, and takes the
    object to be where its only parameter says."""

    shown: list[np.ndarray] = []

    def __init__(self, config, profile):
        pass

    def apply(self, variables, depth_m, state, crop_rc, method):
        """See `StudentPolicy.encode`."""
        self.shown.append(np.asarray(depth_m))
        place = variables["params"]["encoder"] * jnp.ones((len(depth_m), 3))
        return Seen(jnp.zeros((len(depth_m), 1)), Aux(place, place[:, :2], place[:, 0]))


def _blind_step(monkeypatch, **training) -> tuple[train.Batch, np.ndarray, float]:
    """(batch, the depth that the network was shown, its gradient) of a step of a `_Blind` one."""
    grads = []
    monkeypatch.setattr(train, "StudentPolicy", _Blind)
    monkeypatch.setattr(_Blind, "shown", [])
    monkeypatch.setattr(train, "updated", lambda state, optimizer, grad, decay: grads.append(grad) or state)
    config = dataclasses.replace(CONFIG, training=dataclasses.replace(CONFIG.training, **training))
    batch = train.make_batch(frames_of(), np.arange(4), np.random.default_rng(0), config, PROFILE)
    pixels = np.arange(PROFILE.height_px * PROFILE.width_px) % 499  # else every part of a frame is alike
    pixels = pixels.reshape(PROFILE.height_px, PROFILE.width_px).astype(np.uint16)
    batch = batch.replace(depth_mm=batch.depth_mm + pixels)
    key = jax.random.key_data(jax.random.key(0))
    state = first_state({"encoder": np.float32(0.5)}, optax.identity(), key)
    train.train_step.__wrapped__(config, PROFILE, 5, state, {}, batch)
    return batch, _Blind.shown[0], float(grads[0]["encoder"])


PLAIN = {"disparity_noise_px": 0.0, "edge_noise_px": 0.0, "unseen_share": 0.0}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, lambda depth_m: depth_m),
        ({"disparity_noise_px": 0.25}, lambda depth_m: depth_m + 1.0),
        ({"edge_noise_px": 0.6}, lambda depth_m: depth_m + 1.0),
        ({"unseen_share": 0.25}, lambda depth_m: 2.0 * depth_m),
        ({"disparity_noise_px": 0.25, "unseen_share": 0.25}, lambda depth_m: 2.0 * (depth_m + 1.0)),
    ],
)
def test_a_step_shows_the_network_depth_with_noise_and_without_unseen_objects(
    monkeypatch, settings, expected
):
    """Both (tests of their own are below) as marks that can be told apart."""
    grasps = []

    def unseen(key, depth_m, first_px, grasp_m, profile, config):
        grasps.append(grasp_m)
        return 2.0 * depth_m

    monkeypatch.setattr(train, "disparity_noise", lambda key, depth_m, *given: depth_m + 1.0)
    monkeypatch.setattr(train, "unseen_objects", unseen)
    batch, shown, _ = _blind_step(monkeypatch, **PLAIN | settings)
    parts = [
        depth[:, row : row + shown.shape[2], column : column + shown.shape[3]]
        for depth, (row, column) in zip(np.asarray(batch.depth_mm), np.asarray(batch.crop_rc), strict=True)
    ]
    np.testing.assert_array_equal(shown, expected(to_metres(np.stack(parts))))
    for grasp_m in grasps:
        np.testing.assert_allclose(grasp_m[:, 0], 0.4 + np.arange(4) / 50, atol=1e-5)


def test_the_privileged_losses_count_by_their_weight(monkeypatch):
    none, one, two = (_blind_step(monkeypatch, **PLAIN, aux_weight=weight)[2] for weight in (0.0, 1.0, 2.0))
    assert none == 0.0 and abs(one) > 0.1 and two == pytest.approx(2 * one, rel=1e-5)


class _StopsAt(Progress):
    """Ctrl-C at so many updates of bars and curves."""

    def __init__(self, left):
        super().__init__(quiet=True)
        self.left = left

    def _tick(self):
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt


@pytest.mark.parametrize(("aux", "action"), [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_what_is_shown_while_it_trains_is_what_is_trained(aux, action):
    shown = train.told(StudentTrainingConfig(aux_weight=aux, action_weight=action))
    assert ("position_error_mm" in shown, "action" in shown) == (aux > 0, action > 0)


def test_a_fit_interrupted_and_resumed_ends_as_an_uninterrupted_one(tmp_path):
    config = Config(
        "test", student=dataclasses.replace(CONFIG, training=dataclasses.replace(CONFIG.training, steps=5))
    )
    assert config.world.profile == PROFILE

    def trainer(name, progress):
        made = Trainer(config, cast(Any, None), cast(Any, None), tmp_path / name, progress)
        if made.frame_count == 0:
            _with_frames(made)
        made.params = init_params(jax.random.key(0), CONFIG, PROFILE)
        return made

    whole, again = trainer("whole", Progress(quiet=True)), trainer("halves", Progress(quiet=True))
    whole._phase("demos", lambda: whole._fit("demos", 5))
    halves = trainer("halves", _StopsAt(4))  # the start and three steps
    with pytest.raises(KeyboardInterrupt):
        halves._fit("demos", 5)
    folder = tmp_path / "halves" / CHECKPOINTS
    assert [path.name for path in (folder / "demos").iterdir()] == ["3"]
    again._phase("demos", lambda: again._fit("demos", 5))
    jax.tree.map(np.testing.assert_array_equal, again.params, whole.params)
    assert again.history == whole.history and not folder.exists()


def _with_frames(trainer: Trainer) -> Trainer:
    for episode in columns_of((6, 6)):
        steps = dict(zip(("depth_mm", "state", "action", "observation", "held"), episode, strict=True))
        trainer._store.append(steps, {"from_demo": np.bool_(True)})
    return trainer


def test_every_step_of_a_fit_on_pictures_draws_samples_of_its_own(tmp_path, monkeypatch):
    drawn = []

    def step(config, profile, steps, state, frozen, batch):
        drawn.append(np.sort(np.asarray(batch.depth_mm[:, -1, 0, 0])))  # a frame's number, by its depth
        assert set(np.unique(batch.action[..., 7])) <= {
            -1.0,
            1.0,
        }  # the gripper's labels are its two commands
        zeros = {name: jnp.zeros(()) for name in ("position_error_mm", "yaw", "held")}
        averaged = jax.tree.map(lambda x: 0 * x + 7, state.ema)
        return state.replace(step=state.step + 1, ema=averaged), zeros

    monkeypatch.setattr(train, "train_step", step)
    training = dataclasses.replace(CONFIG.training, batch_size=4)
    config = Config("test", student=dataclasses.replace(CONFIG, training=training))
    trainer = Trainer(config, cast(Any, None), cast(Any, None), tmp_path, Progress(quiet=True))
    _with_frames(trainer).params = {"encoder": {"w": np.ones(2, np.float32)}}
    for phase in ("demos", "dagger-1"):
        trainer._fit(phase, 6)
    assert len(np.unique(drawn, axis=0)) > 6
    np.testing.assert_array_equal(trainer.params["encoder"]["w"], 7)  # the averaged ones


@pytest.mark.parametrize("damage", [[], {"done": []}])
def test_a_damaged_plan_is_named(tmp_path, damage):
    atomic_write_json(tmp_path / PLAN, damage)
    trainer = Trainer(
        Config("test", student=CONFIG), cast(Any, None), cast(Any, None), tmp_path, Progress(quiet=True)
    )
    with pytest.raises(UserError, match=r"plan\.json is damaged: delete .* and begin anew"):
        trainer._restore()


def test_a_fit_on_pictures_draws_steps_with_the_object_in_the_hand_by_their_weight(tmp_path, monkeypatch):
    drawn = []

    def step(config, profile, steps, state, frozen, batch):
        drawn.append(batch.aux.held_logit)
        zeros = {name: jnp.zeros(()) for name in ("position_error_mm", "yaw", "held")}
        return state.replace(step=state.step + 1), zeros

    monkeypatch.setattr(train, "train_step", step)
    training = dataclasses.replace(CONFIG.training, held_weight=1e-9, batch_size=16)
    config = Config("test", student=dataclasses.replace(CONFIG, training=training))
    trainer = Trainer(config, cast(Any, None), cast(Any, None), tmp_path, Progress(quiet=True))
    _with_frames(trainer).params = {"encoder": {"w": np.ones(2, np.float32)}}
    trainer._fit("dagger-1", 2)
    assert np.shape(drawn) == (2, 16) and not np.any(drawn)  # 10 of 12 steps are


@pytest.mark.parametrize("killed_at", ["atomic_write_json", "_take_over"])
def test_a_phase_is_done_with_its_parameters_or_not_at_all(tmp_path, monkeypatch, killed_at):
    config = Config("test", student=CONFIG)

    def trainer() -> Trainer:
        return Trainer(config, cast(Any, None), cast(Any, None), tmp_path, Progress(quiet=True))

    def killed(*_):
        raise KeyboardInterrupt

    first = trainer()
    first.params = {"a": np.zeros(3)}
    first._phase("poses", dict)
    with monkeypatch.context() as patch:
        patch.setattr(dagger if killed_at == "atomic_write_json" else Trainer, killed_at, killed)
        first.params = {"a": np.ones(3)}
        with pytest.raises(KeyboardInterrupt):
            first._phase("head", dict)
    again = trainer()
    again._restore()
    done = killed_at == "_take_over"
    assert again._done == ["poses", "head"][: 1 + done]
    np.testing.assert_array_equal(again.params["a"], np.full(3, float(done)))
    again._phase("head", lambda: again.params.update(a=np.full(3, 2.0)) or {})
    assert sorted(path.name for path in tmp_path.glob("*.msgpack")) in ([PARAMS_FILE],)
    np.testing.assert_array_equal(load_params(tmp_path / PARAMS_FILE)["a"], np.full(3, 1.0 if done else 2.0))


@pytest.mark.parametrize(("number", "before"), [(0, 0), (1, 500), (2, 540), (3, 580)])
def test_curves_count_on_from_phase_to_phase(number, before):
    training = dataclasses.replace(CONFIG.training, steps=500)
    student = dataclasses.replace(CONFIG, training=training, dagger=DaggerConfig(rounds=3, steps=40))
    assert _steps_before(student, number) == before


def test_a_round_interrupted_after_its_episodes_keeps_their_success(tmp_path):
    student = dataclasses.replace(CONFIG, dagger=DaggerConfig(rounds=2, episodes=1, steps=0))
    config = Config("test", student=student)
    trainer = Trainer(config, cast(Any, None), cast(Any, None), tmp_path, Progress(quiet=True))
    for episode in columns_of((6, 6)):
        steps = dict(zip(("depth_mm", "state", "action", "observation", "held"), episode, strict=True))
        trainer._store.append(steps, {"from_demo": np.bool_(False)})
    assert trainer._dagger(1, 1) == {}
    atomic_write_json(tmp_path / ACTED, {"round": 1, "rollout_success": 0.25})
    assert trainer._dagger(1, 1) == {"rollout_success": 0.25}
    assert trainer._dagger(2, 0) == {}


def test_a_student_that_learns_nothing_more_has_no_depth_drawn(tmp_path, monkeypatch):
    """It may be a generator's: minutes for the demos of a preset."""
    monkeypatch.setattr("student_jax.frames_io.add_noisy_demos", None)
    student = dataclasses.replace(
        CONFIG, depth_source="ideal", poses=dataclasses.replace(CONFIG.poses, rounds=0),
        training=dataclasses.replace(CONFIG.training, steps=0),
        dagger=dataclasses.replace(CONFIG.dagger, rounds=0),
        head=dataclasses.replace(CONFIG.head, train_steps=0),
    )  # fmt: skip
    config = Config("test", student=student)
    source, demos = make_source(config, tmp_path), EpisodeStore(tmp_path / "demos", create=True)
    trainer = Trainer(config, cast(Any, None), source, tmp_path, Progress(quiet=True))
    trainer.run(demos)
    assert trainer.frame_count == 0 and (tmp_path / PARAMS_FILE).exists()
    assert [phase["phase"] for phase in trainer.history] == ["poses", "demos", "head"]


def test_a_student_stopped_after_its_last_phase_needs_its_frames_no_more(tmp_path):
    """Its stage deletes them before the manifest that says it is finished."""
    config = Config("test", student=dataclasses.replace(CONFIG, depth_source="ideal"))
    done = ["poses", "demos", "dagger-1", "head"]
    history = [{"phase": name, "frames": 12} for name in done]
    atomic_write_json(tmp_path / PLAN, {"done": done, "history": history})
    save_params(tmp_path / PARAMS_FILE, {"a": np.ones(3)})
    source, demos = make_source(config, tmp_path), EpisodeStore(tmp_path / "demos", create=True)
    trainer = Trainer(config, cast(Any, None), source, tmp_path, Progress(quiet=True))
    trainer.run(demos)
    assert trainer.frame_count == 12 and len(trainer._store) == 0
    np.testing.assert_array_equal(trainer.params["a"], np.ones(3))


def test_the_head_learns_actions_from_poses():
    """Labels that say where the object is: after 300 steps the head's actions follow a new position."""
    rng = np.random.default_rng(0)
    params = init_params(jax.random.key(0), CONFIG, PROFILE)
    state = train.init_state(CONFIG, 300, 0, train.head_of(params))

    def samples(count):
        observation = np.zeros((count, 40), np.float32)
        grasp = observation[:, OBSERVATION.grasp_pos]
        grasp[:, :2] = [0.5, 0.0] + rng.uniform(-0.15, 0.15, (count, 2))
        observation[:, OBSERVATION.grip_pos] = grasp  # hand at the object: errors are small
        observation[:, OBSERVATION.grasp_quat.start + 1] = 1.0
        seen = noisy_seen(observation, np.zeros(count, bool), np.zeros((count, 5)), rng, CONFIG)
        label = np.zeros((count, CONFIG.head.chunk, 8), np.float32)
        label[:, :, 0] = grasp[:, 1:2] * 5
        return seen, np.zeros((count, 9), np.float32), label

    for _ in range(300):
        state, _ = train.head_step(CONFIG, PROFILE, 300, state, *samples(64))
    seen, joints, label = samples(100)
    chosen = train.act_on_seen(CONFIG, PROFILE, state.params, seen, joints, np.zeros_like(label))
    assert np.corrcoef(np.asarray(chosen)[:, 0, 0], label[:, 0, 0])[0, 1] > 0.9


def test_pose_errors_shrink_near_the_object():
    observation = np.zeros((2, 40), np.float32)
    observation[1, 18] = 0.5  # half a metre away
    seen = noisy_seen(observation, np.ones(2, bool), np.ones((2, 5)), np.random.default_rng(0), CONFIG)
    error = np.asarray(position_to_world(seen.aux.position))
    np.testing.assert_allclose(error, [[0.002] * 3, [0.010] * 3], atol=1e-6)
    assert np.abs(seen.aux.held_logit).tolist() == [6.0, 6.0]


def test_who_acts_from_poses_takes_the_first_of_a_chunk_and_is_pushed_now_and_then(monkeypatch):
    """In the network's place a chunk whose actions can be told apart."""
    count, chunk = 4000, (0.1, 0.9)

    def chosen(config, profile, head, seen, state, noise):
        return np.broadcast_to(np.array(chunk)[None, :, None], (count, 2, 8))

    monkeypatch.setattr(train, "act_on_seen", chosen)
    actor = PoseActor({}, CONFIG, PROFILE, np.random.default_rng(0), count, teacher_share=0.25)
    still, observation = np.zeros((count, 8), np.float32), np.zeros((count, 40), np.float32)
    empty = np.zeros((count, 0, 0), np.uint16)
    action = actor(Scene(empty, still, np.full((count, 8), -0.5), observation, np.zeros(count, bool), 0))
    taught = action[:, 7] < 0  # a push does not move the gripper
    assert taught.mean() == pytest.approx(0.25, abs=0.03) and set(action[:, 7]) == {-0.5, chunk[0]}
    off = action[:, :7] - np.where(taught, -0.5, chunk[0])[:, None]
    pushed = np.any(np.abs(off) > 1e-9, axis=1)
    assert pushed.mean() == pytest.approx(0.15, abs=0.02)
    assert off[pushed].std() == pytest.approx(0.3, rel=0.05)


def test_training_and_whoever_acts_are_told_the_same_change_of_width():
    states = np.random.default_rng(0).random((6, 8)).astype(np.float32)
    acting = WidthChange()
    np.testing.assert_array_equal(with_change(states), [acting(state) for state in states])


def test_neither_actor_takes_a_closing_back():
    """The teacher's labels close once and open again; what is executed goes on closing for eight steps."""
    depth = np.full((2, PROFILE.height_px, PROFILE.width_px), 700, np.uint16)
    state, observation = np.zeros((2, 8), np.float32), np.zeros((2, 40), np.float32)
    params, rng = init_params(jax.random.key(0), CONFIG, PROFILE), np.random.default_rng(0)
    for actor in (
        PoseActor(None, CONFIG, PROFILE, rng, 2, teacher_share=1.0),
        StudentActor(params, CONFIG, PROFILE, keep_clean, rng, teacher_share=1.0),
    ):
        closing = []
        for step in range(10):
            expert = np.full((2, 8), -0.5)
            expert[0, 7] = 0.5 if step == 0 else -0.5
            scene = Scene(depth, state, expert, observation, np.zeros(2, bool), step)
            closing.append(closes(actor(scene)))
        np.testing.assert_array_equal(np.array(closing), [[True, False]] * 8 + [[False, False]] * 2)


def test_executing_more_than_a_chunk_is_refused():
    with pytest.raises(UserError, match=r"execute_steps is 3: expected 1 to student.head.chunk = 2"):
        dataclasses.replace(CONFIG.head, execute_steps=3)


WHOLE = np.zeros((1, 2), np.int32)
"""First pixel of frames that are no part of any."""


def _parts_of_a_block() -> tuple[np.ndarray, jax.Array, np.ndarray, tuple[int, int], tuple[int, int]]:
    """A block on the empty table: the frame, the whole stacks, first pixels and size of a part of each, and
    the block's first pixel."""
    depth = np.array(table_depth(PROFILE, 2.5), np.float32)
    row, column = PROFILE.height_px // 2, PROFILE.width_px // 2
    depth[row : row + 4, column : column + 4] -= 0.05
    stack = jnp.asarray(depth)[None, None].repeat(2, 0).repeat(3, 1)
    first_px = np.array([[row - 32, column - 40], [row - 20, column - 28]])
    return depth, stack, first_px, (64, 80), (row, column)


def test_edges_of_a_part_of_the_frames_are_told_by_the_table_that_lies_there():
    noise = dataclasses.replace(CONFIG.training, disparity_noise_px=0.0, edge_noise_px=1.0)
    config = dataclasses.replace(CONFIG, training=noise)
    _, stack, first_px, size, block = _parts_of_a_block()
    part = cut(stack, first_px, size)
    made = disparity_noise(jax.random.key(0), part, first_px, PROFILE, config)
    changed = np.abs(np.asarray(made - part)) > 1e-4
    near = np.zeros(changed.shape, bool)
    for i, (row, column) in enumerate(block - first_px):
        near[i, :, row - 8 : row + 12, column - 8 : column + 12] = True
    assert changed[near].any() and not changed[~near].any()


def test_cells_of_noise_begin_where_the_frame_s_do_and_not_the_part_s():
    noise = dataclasses.replace(CONFIG.training, disparity_noise_px=0.25, edge_noise_px=0.0)
    config = dataclasses.replace(CONFIG, training=noise)
    part, first_px = jnp.ones((3, 3, 8, 8)), np.array([[2, 4], [1, 0], [0, 1]])
    made = np.asarray(disparity_noise(jax.random.key(0), part, first_px, PROFILE, config))
    rows, columns = made[:, :, 0] == made[:, :, 1], made[..., 0] == made[..., 1]
    alike = np.stack([rows.all((1, 2)), columns.all((1, 2))], axis=-1)  # the first two, in each sample
    np.testing.assert_array_equal(alike, first_px % 2 == 0)


def test_an_unseen_object_in_a_part_of_the_frames_is_found_where_it_lies():
    config = dataclasses.replace(CONFIG, training=dataclasses.replace(CONFIG.training, unseen_share=1.0))
    depth, stack, first_px, size, (row, column) = _parts_of_a_block()
    x, y = (column + 2 - PROFILE.cx_px) / PROFILE.fx_px, (row + 2 - PROFILE.cy_px) / PROFILE.fy_px
    camera = nominal_camera(PROFILE).T_world_cam
    place = camera[:3, 3] + camera[:3, :3] @ [x, y, 1.0] * depth[row + 2, column + 2]
    grasp = jnp.asarray(place, jnp.float32)[None].repeat(2, 0)
    part = cut(stack, first_px, size)
    whole = unseen_objects(jax.random.key(0), stack, WHOLE, grasp, PROFILE, config)
    made = unseen_objects(jax.random.key(0), part, first_px, grasp, PROFILE, config)
    assert ((np.asarray(made) == 0).sum((1, 2, 3)) >= 3 * 16).all()
    np.testing.assert_allclose(made, cut(whole, first_px, size), rtol=1e-6)


def test_disparity_noise_grows_with_the_square_of_depth_and_keeps_holes():
    config = dataclasses.replace(
        CONFIG, training=dataclasses.replace(CONFIG.training, disparity_noise_px=0.2)
    )
    depth = np.zeros((40, 3, 40, 60), np.float32)
    depth[:, :, :20, :30], depth[:, :, 20:, :30] = 0.5, 1.0  # the right half is invalid
    noisy = np.asarray(disparity_noise(jax.random.key(0), jnp.asarray(depth), WHOLE, PROFILE, config))
    assert np.all(noisy[..., 30:] == 0) and np.all(noisy[..., :30] > 0)
    error = np.abs(noisy - depth)
    near, far = (np.median(error[:, :, rows, :30]) for rows in (slice(20), slice(20, 40)))
    assert far / near == pytest.approx(4.0, rel=0.1)
    # strength uniform up to 0.2: its mean 0.1 px at 1 m is 0.1 / (f b) metres; median of |normal| is 0.674
    assert far == pytest.approx(0.674 * 0.1 / (PROFILE.fx_px * PROFILE.baseline_m), rel=0.35)
    one = error[:, 0, ::2, :30:2] > 0.2
    assert 0.0 < one.mean() < 0.004  # wrong matches are rare


@pytest.mark.parametrize(("strength_px", "exact"), [(0.0, True), (0.25, False)])
def test_without_disparity_noise_perception_is_told_of_pixels_as_they_come(strength_px, exact):
    training = dataclasses.replace(CONFIG.training, disparity_noise_px=strength_px)
    config = dataclasses.replace(CONFIG, training=training)
    params = init_params(jax.random.key(0), config, PROFILE)
    depth_mm = np.full((1, 3, PROFILE.height_px, PROFILE.width_px), 700, np.uint16)
    given = config, PROFILE, params, depth_mm, np.zeros((1, 9), np.float32), np.zeros((1, 2), np.int32)
    plain, noisy = train.encode(*given), train.encode(*given, jax.random.key(1))
    same = [np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (plain, noisy)), strict=True)]
    assert all(same) == exact


def test_noise_at_edges_is_where_things_stand_out_of_the_table_and_nowhere_else():
    noise = dataclasses.replace(CONFIG.training, disparity_noise_px=0.0, edge_noise_px=1.0)
    config = dataclasses.replace(CONFIG, training=noise)
    depth = np.array(table_depth(PROFILE, 2.5), np.float32)
    height, width = depth.shape
    row, column = height // 2 // 4 * 4, width // 2 // 4 * 4
    depth[row : row + 4, column : column + 4] -= 0.05
    depth[:8, :8] = 0.0
    stack = jnp.asarray(depth)[None, None].repeat(64, 0).repeat(3, 1)
    made = np.asarray(disparity_noise(jax.random.key(0), stack, WHOLE, PROFILE, config))
    np.testing.assert_array_equal(made[:, :, :8, :8], 0.0)
    changed = np.mean(np.abs(made - depth) > 1e-4, axis=(0, 1))
    beside = np.zeros(depth.shape, bool)
    beside[row - 4 : row + 8, column - 4 : column + 8] = True
    assert changed[beside].min() > 0.9 and changed[~beside].max() == 0.0  # without wrong matches
    error = made[:, :, row, column] - depth[row, column]
    assert 0.3 < np.corrcoef(error[:, 0], error[:, 2])[0, 1] < 0.9
    without = dataclasses.replace(config, training=dataclasses.replace(noise, edge_noise_px=0.0))
    plain = np.asarray(disparity_noise(jax.random.key(0), stack, WHOLE, PROFILE, without))
    assert np.mean(np.abs(plain - depth)[:, :, beside] > 1e-4) < 0.02


def test_a_hole_in_a_surface_is_no_edge():
    noise = dataclasses.replace(CONFIG.training, disparity_noise_px=0.0, edge_noise_px=1.0)
    config = dataclasses.replace(CONFIG, training=noise)
    depth = np.array(table_depth(PROFILE, 2.5), np.float32)
    row, column = PROFILE.height_px // 2, PROFILE.width_px // 2
    depth[row - 14 : row + 14, column - 14 : column + 14] -= 0.05
    stack = jnp.asarray(depth)[None, None].repeat(4, 0).repeat(3, 1)
    holed = stack.at[..., row - 1 : row + 1, column - 1 : column + 1].set(0.0)
    whole, made = (
        np.asarray(disparity_noise(jax.random.key(0), x, WHOLE, PROFILE, config)) for x in (stack, holed)
    )
    np.testing.assert_array_equal(made[holed > 0], whole[holed > 0])


def test_position_yaw_and_holding_each_pull_at_what_is_seen(monkeypatch):
    """`_Blind` reports 0.5 for everything, beyond Huber's bound of positions: slope 0.05, weight 40."""
    _, _, gradient = _blind_step(monkeypatch, **PLAIN, aux_weight=1.0)
    position = 40 * 0.05
    yaw = (0.5 - np.cos(0.4)) + (0.5 - np.sin(0.4))  # mean over cosine and sine of 2 (0.5 - target)
    held = 0.3 * (1 / (1 + np.exp(-0.5)) - 0.5)  # two of four are held
    assert gradient == pytest.approx(position + yaw + held, rel=1e-4)


def test_a_step_shows_the_network_the_windows_that_were_drawn(monkeypatch):
    crops, apply = [], _Blind.apply

    def kept(self, variables, depth_m, state, crop_rc, method):
        crops.append(crop_rc)
        return apply(self, variables, depth_m, state, crop_rc, method)

    monkeypatch.setattr(_Blind, "apply", kept)
    batch, *_ = _blind_step(monkeypatch, **PLAIN)
    np.testing.assert_array_equal(crops[0], batch.crop_rc)
    assert np.any(np.asarray(crops[0]) != PROFILE.crop_origin_px)


def test_an_object_that_is_not_seen_is_a_hole_as_large_as_it_is():
    """A 4 cm block on an empty table, drawn by hand through the nominal camera that stands 5 mm too low."""
    training = dataclasses.replace(CONFIG.training, unseen_share=1.0)
    config = dataclasses.replace(CONFIG, training=training)
    depth = np.array(table_depth(PROFILE, 2.5)) * (1 + 0.005 / contract.CAMERA_POSITION_M[2])
    empty = depth.copy()
    at = np.array([0.5, 0.0, 0.02])
    camera = nominal_camera(PROFILE)
    x, y, z = camera.T_world_cam[:3, :3].T @ (at - camera.T_world_cam[:3, 3])
    row, column = int(y / z * PROFILE.fy_px + PROFILE.cy_px), int(x / z * PROFILE.fx_px + PROFILE.cx_px)
    block = np.zeros(depth.shape, bool)
    block[row - 3 : row + 4, column - 3 : column + 4] = True
    depth[block] = z - 0.03
    stack = jnp.asarray(np.stack([depth, depth, depth])[None].repeat(2, 0), jnp.float32)
    grasp = jnp.asarray(np.stack([at, [0.5, 0.0, 0.3]]), jnp.float32)  # the other one is carried
    made = np.asarray(unseen_objects(jax.random.key(0), stack, WHOLE, grasp, PROFILE, config))
    hole = made[0, 0] == 0
    grown = np.zeros_like(block)
    grown[row - 4 : row + 5, column - 4 : column + 5] = True  # a pixel of its edge each way
    assert hole[block].all() and not hole[~grown].any()
    np.testing.assert_allclose(made[0, 2][~hole], empty[~hole], rtol=1e-6)
    np.testing.assert_array_equal(made[1], stack[1])
    none = dataclasses.replace(config, training=dataclasses.replace(training, unseen_share=0.0))
    np.testing.assert_array_equal(
        unseen_objects(jax.random.key(0), stack, WHOLE, grasp, PROFILE, none), stack
    )


def test_a_share_of_the_objects_that_lie_is_not_seen():
    training = dataclasses.replace(CONFIG.training, unseen_share=0.25)
    config = dataclasses.replace(CONFIG, training=training)
    depth, stack, first_px, size, (row, column) = _parts_of_a_block()
    x, y = (column + 2 - PROFILE.cx_px) / PROFILE.fx_px, (row + 2 - PROFILE.cy_px) / PROFILE.fy_px
    camera = nominal_camera(PROFILE).T_world_cam
    place = camera[:3, 3] + camera[:3, :3] @ [x, y, 1.0] * depth[row + 2, column + 2]
    part, first_px = cut(stack, first_px, size)[:1].repeat(400, 0), first_px[:1].repeat(400, 0)
    grasp = jnp.asarray(place, jnp.float32)[None].repeat(400, 0)
    made = unseen_objects(jax.random.key(0), part, first_px, grasp, PROFILE, config)
    assert (np.asarray(made) == 0).any((1, 2, 3)).mean() == pytest.approx(0.25, abs=0.07)


def test_the_head_s_average_has_the_configured_decay(monkeypatch):
    """As the step's on pictures, below."""
    monkeypatch.setattr(train, "diffusion_loss", lambda config, policy, head, *_: head["w"])
    config = dataclasses.replace(CONFIG, training=dataclasses.replace(CONFIG.training, ema_decay=0.9))
    key = jax.random.key_data(jax.random.key(0))
    state = first_state({"w": np.float32(0.5)}, train.make_optimizer(config, 500), key)
    state = state.replace(step=jnp.asarray(200))
    for _ in range(2):
        state, _ = train.head_step.__wrapped__(config, PROFILE, 500, state, None, None, None)
    moved, averaged = (float(tree["w"]) - 0.5 for tree in (state.params, state.ema))
    assert abs(moved) > 1e-6 and averaged == pytest.approx(0.1 * moved, rel=1e-2)


def test_a_step_s_average_has_the_configured_decay(monkeypatch):
    """Of two steps the first has rate 0; decay min(0.9, (1 + n) / (10 + n)) is 0.9 from step 80 on."""
    monkeypatch.setattr(train, "StudentPolicy", _Blind)
    training = dataclasses.replace(CONFIG.training, **PLAIN, ema_decay=0.9)
    config = dataclasses.replace(CONFIG, training=training)
    batch = train.make_batch(frames_of(), np.arange(4), np.random.default_rng(0), config, PROFILE)
    key = jax.random.key_data(jax.random.key(0))
    state = first_state({"encoder": np.float32(0.5)}, train.make_optimizer(config, 500), key)
    state = state.replace(step=jnp.asarray(200))
    for _ in range(2):
        state, _ = train.train_step.__wrapped__(config, PROFILE, 500, state, {}, batch)
    moved, averaged = (float(tree["encoder"]) - 0.5 for tree in (state.params, state.ema))
    assert abs(moved) > 1e-6 and averaged == pytest.approx(0.1 * moved, rel=1e-2)
