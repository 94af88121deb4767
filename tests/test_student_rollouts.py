"""Episodes that the student's training and evaluation roll out: whose actions, which scenes, what is kept."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import jax
import numpy as np
import pytest

from ddg_jax.generate import Clip
from ddgrasp.config import (
    Config,
    DaggerConfig,
    EncoderConfig,
    EvalConfig,
    HandViewConfig,
    HeadConfig,
    PictureConfig,
    PosesConfig,
    RandomConfig,
    StudentConfig,
    StudentTrainingConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.layout import STATE
from ddgrasp.progress import Progress
from demos.rollout import Actor, Episodes, Roller
from mjx_envs.camera import nominal_camera
from mjx_envs.views import Views
from ppo.policy import TeacherPolicy
from student_jax import dagger, evaluate, head, train
from student_jax.act import StudentActor
from student_jax.data import Frames, with_change
from student_jax.policy import HEAD_PARAMS, StudentPolicy, init_params

COUNT, STEPS = 4, 3
"""Episodes in lock-step, and their length."""
CONFIG = Config(
    preset="test",
    seed=3,
    world=WorldConfig(
        objects=("apple", "block", "can"), camera_scale=0.125, episode_steps=STEPS,
        random=RandomConfig(other_pose_share=0.5),
    ),
    student=StudentConfig(
        depth_source="ideal",
        picture=PictureConfig(height_px=32, width_px=40),
        encoder=EncoderConfig(width=8, keypoints=4, stage_blocks=(1, 1), features=16),
        head=HeadConfig(width=16, blocks=1, state_features=8, ddim_steps=2, batch_size=64),
        hand_view=HandViewConfig(size_px=8, width=8, blocks=1, channels=2, features=8),
        training=StudentTrainingConfig(crop_shift_px=2, learning_rate=1e-2, ema_decay=0.9),
        poses=PosesConfig(rounds=2, episodes=COUNT, steps=60),
        dagger=DaggerConfig(rounds=3, episodes=COUNT, steps=0, teacher_share=0.4),
    ),
    evaluation=EvalConfig(student_trials=COUNT),
)  # fmt: skip
TOLD = 0.3
"""An action that is nobody's label."""


@pytest.fixture(scope="module")
def teacher() -> TeacherPolicy:
    """Its labels depend on what it sees, so that no label is right by chance."""
    rng = np.random.default_rng(0)
    layer = (0.1 * rng.normal(size=(40, 16))).astype(np.float32), np.zeros(16, np.float32)
    return TeacherPolicy(np.zeros(40, np.float32), np.ones(40, np.float32), [layer])


@pytest.fixture(scope="module")
def params() -> dict:
    return init_params(jax.random.key(0), CONFIG.student, CONFIG.world.profile)


class Kept(Roller):
    """Keeps the keys that it was given, and the episodes."""

    def __init__(self, config: Config, teacher: TeacherPolicy, count: int):
        super().__init__(config, teacher, count)
        self.keys: list[jax.Array] = []
        self.made: list[Episodes] = []

    def run(self, key: jax.Array, actor: Actor, on_step: Callable[[int], None] = lambda _: None) -> Episodes:
        """See `Roller`."""
        self.keys.append(key)
        self.made.append(super().run(key, actor, on_step))
        return self.made[-1]


@pytest.fixture(scope="module")
def compiled(teacher) -> Kept:
    return Kept(CONFIG, teacher, COUNT)


@pytest.fixture
def roller(compiled, monkeypatch) -> Kept:
    """The one that everything here makes, compiled once for all tests."""

    def made(
        config: Config, teacher: TeacherPolicy, count: int, with_rgb: bool = False, with_depth: bool = True
    ) -> Kept:
        assert (count, with_rgb) == (COUNT, False)
        return compiled

    compiled.keys, compiled.made = [], []
    for module in (dagger, evaluate, head):
        monkeypatch.setattr(module, "Roller", made)
    return compiled


class Nearer:
    """A depth source that takes a millimetre off every picture, and remembers those that it was asked for."""

    needs_rgb = needs_views = False

    def __init__(self) -> None:
        self.asked: list[tuple[list[int], list[int]]] = []
        self.given: list[np.ndarray] = []

    def episodes(
        self, lengths: Sequence[int], read: Callable[[int], Clip], first: int = 0
    ) -> Iterator[np.ndarray]:
        """See `DepthSource`."""
        return iter(())

    def frames(
        self,
        depth_mm: np.ndarray,
        rgb: np.ndarray | None,
        episode: np.ndarray,
        frame: np.ndarray,
        views: Views | None = None,
    ) -> np.ndarray:
        """See `DepthSource`."""
        self.asked.append((episode.tolist(), frame.tolist()))
        self.given.append(depth_mm - np.uint16(1))
        return self.given[-1]


def test_an_episode_s_actions_are_the_teacher_s_labels_and_not_what_was_done(teacher, compiled):
    pictured = []

    def actor(scene):
        pictured.append(scene)
        return np.full((COUNT, 8), TOLD)

    episodes = compiled.run(jax.random.PRNGKey(0), actor)
    np.testing.assert_allclose(episodes.action, teacher(episodes.observation), atol=1e-5)
    assert np.abs(episodes.action - TOLD).max(axis=(1, 2)).min() > 0.1
    for t, scene in enumerate(pictured):
        np.testing.assert_array_equal(scene.expert, episodes.action[:, t])
    moved = np.diff(episodes.state[..., STATE.arm], axis=1)
    assert moved.min() > 0  # every joint by what it was told


# --- DAgger ---


DEMOS = 2
_WIDTHS = {"state": 8, "action": 8, "observation": 40}


@pytest.fixture
def trainer(teacher, roller, params, tmp_path) -> dagger.Trainer:
    """Its store holds DEMOS demos."""
    made = dagger.Trainer(CONFIG, teacher, Nearer(), tmp_path, Progress(quiet=True))
    made.params = params
    for _ in range(DEMOS):
        _append(made, from_demo=True)
    return made


def _append(trainer: dagger.Trainer, from_demo: bool) -> None:
    """An episode of zeros."""
    steps = {name: np.zeros((STEPS, width), np.float32) for name, width in _WIDTHS.items()}
    steps |= {"held": np.zeros(STEPS, bool), "drawn": np.ones(STEPS, bool)}
    steps["depth_mm"] = np.zeros((STEPS, *trainer._window.shape), np.uint16)
    trainer._store.append(steps, {"from_demo": np.bool_(from_demo)})


@pytest.fixture
def shares(monkeypatch) -> list[float]:
    """The teacher's share of every actor that DAgger makes."""
    seen: list[float] = []

    class Told(StudentActor):
        def __init__(self, *args, **named):
            super().__init__(*args, **named)
            seen.append(self._teacher_share)

    monkeypatch.setattr(dagger, "StudentActor", Told)
    return seen


def test_rounds_of_dagger_add_the_student_s_episodes_with_the_teacher_s_labels(
    trainer, teacher, roller, shares
):
    for number in (1, 2, 3):
        assert trainer._dagger(number, DEMOS) == {"rollout_success": 0.0}
        assert len(trainer._store) == DEMOS + number * COUNT
    assert shares == pytest.approx([0.4, 0.2, 0.0])
    store, new = trainer._store, slice(DEMOS * STEPS, None)
    assert store.episodes("from_demo").tolist() == [True] * DEMOS + [False] * 3 * COUNT
    labels = teacher(store.steps("observation")[new])
    np.testing.assert_allclose(store.steps("action")[new], labels, atol=1e-5)
    states = np.concatenate([made.state.reshape(-1, 8) for made in roller.made])
    np.testing.assert_array_equal(store.steps("state")[new], states)
    begins = np.concatenate([made.observation[:, 0] for made in roller.made])
    assert len(np.unique(begins, axis=0)) == 3 * COUNT
    firsts = [DEMOS + i * COUNT for i in range(3)]
    assert trainer._source.asked == [
        (list(range(first, first + COUNT)), [step] * COUNT) for first in firsts for step in range(STEPS)
    ]  # numbers of the store's episodes, and so none of a demo


def test_what_the_student_saw_is_what_is_kept(trainer, roller):
    trainer._dagger(1, DEMOS)
    kept = trainer._store.steps("depth_mm", DEMOS * STEPS).reshape(COUNT, STEPS, *trainer._window.shape)
    seen = np.stack(trainer._source.given, axis=1)
    np.testing.assert_array_equal(kept, trainer._window.cut(seen))


def test_a_round_that_is_partly_there_gets_what_is_missing_in_other_scenes(trainer, roller, shares):
    there = 3
    for _ in range(there):
        _append(trainer, from_demo=False)
    rounds = replace(CONFIG.student.dagger, episodes=there + COUNT)
    trainer._student = replace(CONFIG.student, dagger=rounds)
    for _ in range(2):  # the second time nothing is missing
        trainer._dagger(1, DEMOS)
        assert len(trainer._store) == DEMOS + there + COUNT and len(roller.made) == 1
    assert shares == [0.4] and trainer._acted(1) == {}  # a rest says little of the round
    assert trainer._source.asked[0][0] == list(range(DEMOS + there, DEMOS + there + COUNT))
    (key,) = roller.keys
    whole = jax.random.fold_in(jax.random.PRNGKey(dagger._DAGGER_SEED + CONFIG.seed), 1)
    assert not np.array_equal(key, whole)


# --- the head, on poses ---


def test_the_head_learns_from_poses_and_all_else_stays(teacher, roller, params, tmp_path):
    trained, measured = head.fit_on_poses(CONFIG, teacher, params, tmp_path, Progress(quiet=True))
    assert measured["rollout_success"] == 0.0 and trained.keys() == params.keys()
    for name in params:
        same = jax.tree.leaves(jax.tree.map(np.array_equal, params[name], trained[name]))
        assert not any(same) if name in HEAD_PARAMS else all(same), name

    poses = head._load_poses(tmp_path / head.POSES)
    assert poses is not None
    samples = head._from_poses(CONFIG, poses, np.random.default_rng(0), 512)
    net = StudentPolicy(CONFIG.student, CONFIG.world.profile)

    @jax.jit
    def loss(head_params):
        return train.diffusion_loss(CONFIG.student, net, head_params, *samples, jax.random.key(0))

    assert float(loss(train.head_of(trained))) < 0.5 * float(loss(train.head_of(params)))
    assert len(roller.made) == 2
    check_rows(poses, roller.made)


def test_the_head_takes_over_from_the_teacher_round_by_round(teacher, roller, params, tmp_path, monkeypatch):
    given = []

    class Told:
        def __init__(self, head, config, profile, rng, count, teacher_share):
            given.append((head is None, teacher_share))

        def __call__(self, scene):
            return scene.expert

    monkeypatch.setattr(head, "PoseActor", Told)
    poses = PosesConfig(rounds=4, episodes=COUNT, steps=0)
    config = replace(CONFIG, student=replace(CONFIG.student, poses=poses))
    head.fit_on_poses(config, teacher, params, tmp_path, Progress(quiet=True))
    assert given == [(True, 1.0), (False, 0.5), (False, 0.25), (False, 0.0)]
    begins = np.concatenate([made.observation[:, 0] for made in roller.made])
    assert len(np.unique(begins, axis=0)) == 4 * COUNT  # no scene twice


def check_rows(poses: Frames, made: list[Episodes]) -> None:
    """Every column is that of the episodes, and no chunk of actions goes on into the next one."""
    each = [(episodes, i) for episodes in made for i in range(COUNT)]
    assert poses.depth_mm is None
    np.testing.assert_array_equal(poses.episode, np.repeat(np.arange(len(each)), STEPS))
    for name in ("action", "observation", "held"):
        whole = np.concatenate([getattr(episodes, name)[i] for episodes, i in each])
        np.testing.assert_array_equal(getattr(poses, name), whole.astype(np.float32))
    states = np.concatenate([with_change(episodes.state[i]) for episodes, i in each])
    np.testing.assert_array_equal(poses.state, states)
    chunks = poses.action_chunks(np.arange(len(poses)), 2)
    last = poses.step == STEPS - 1
    np.testing.assert_array_equal(chunks[:, 0], poses.action)
    np.testing.assert_array_equal(chunks[last, 1], poses.action[last])
    np.testing.assert_array_equal(chunks[~last, 1], poses.action[1:][~last[:-1]])


def test_a_head_that_diverges_on_poses_ends_in_one_line(teacher, roller, params, tmp_path):
    broken = params | {"denoiser": jax.tree.map(lambda x: np.nan * x, params["denoiser"])}
    with pytest.raises(UserError, match="loss is not finite after 60 steps: .* smaller student.training"):
        head.fit_on_poses(CONFIG, teacher, broken, tmp_path, Progress(quiet=True))
    assert not (tmp_path / head.POSES).exists()


# --- evaluation ---


def test_both_cameras_see_the_same_trials_and_none_of_them_is_one_of_training_s(teacher, roller, params):
    source = Nearer()
    made = evaluate.closed_loop(CONFIG, teacher, source, params, Progress(quiet=True))
    assert set(made) == {"student_clean", "student_ddg"}
    clean, noisy = roller.made
    np.testing.assert_array_equal(clean.observation[:, 0], noisy.observation[:, 0])
    np.testing.assert_array_equal(clean.T_world_cam, noisy.T_world_cam)
    for counts, episodes in zip(made.values(), roller.made, strict=True):
        assert counts["success"] == {"successes": 0, "n": COUNT}
        tried = np.bincount(episodes.object_index, minlength=3).tolist()
        assert [counts["per_object"][name]["n"] for name in CONFIG.world.objects] == tried
        assert 0 < counts["position_error_mm"] < 1e4
    assert len(source.asked) == STEPS  # on clean depth nobody asks it
    numbers = np.array([number for number, _ in source.asked])
    assert numbers.min() >= 1_000_000 and numbers.shape == (STEPS, COUNT)
    assert made["student_clean"]["position_error_mm"] != made["student_ddg"]["position_error_mm"]


def test_a_perception_that_nothing_has_trained_is_not_measured(teacher, roller, params):
    untrained = replace(CONFIG.student, training=replace(CONFIG.student.training, aux_weight=0.0))
    config = replace(CONFIG, student=untrained)
    made = evaluate.closed_loop(config, teacher, Nearer(), params, Progress(quiet=True))
    assert not any("position_error_mm" in counts for counts in made.values())


def test_every_episode_has_a_camera_of_its_own_within_the_configured_error(compiled):
    nominal, most_m = nominal_camera(CONFIG.world.profile).T_world_cam, CONFIG.world.random.camera_position_m
    made = [compiled.run(jax.random.PRNGKey(seed), lambda scene: scene.expert).T_world_cam for seed in (0, 1)]
    cameras = np.concatenate(made)
    for axis in (cameras[:, :3, 3] - nominal[:3, 3]).T:
        assert np.abs(axis).max() <= most_m + 1e-6 and np.ptp(axis) > most_m / 2
        assert np.diff(np.sort(axis)).min() > 1e-6
    assert len(np.unique(cameras[:, :3, :3].reshape(len(cameras), -1), axis=0)) == 2 * COUNT


def test_a_plan_fits_on_the_demos_and_after_every_round_on_all_so_far(trainer, roller, monkeypatch):
    fits = []

    def fit(self, phase, steps):
        fits.append((phase, steps, len(self._store)))
        return {}

    monkeypatch.setattr(dagger.Trainer, "_restore", lambda self: None)
    monkeypatch.setattr(dagger.Trainer, "_fit", fit)
    monkeypatch.setattr(dagger.Trainer, "_fit_on_poses", lambda self: fit(self, "poses", 0))
    monkeypatch.setattr(dagger.Trainer, "_fit_on_perception", lambda self: fit(self, "head", 0))
    monkeypatch.setattr(dagger.frames_io, "add_noisy_demos", lambda *_: None)  # the fixture's are there
    trainer._student = replace(CONFIG.student, dagger=replace(CONFIG.student.dagger, steps=7))
    trainer.run(range(DEMOS))
    rounds = [(f"dagger-{i}", 7, DEMOS + i * COUNT) for i in (1, 2, 3)]
    first = [("poses", 0, DEMOS), ("demos", CONFIG.student.training.steps, DEMOS)]
    assert fits == [*first, *rounds, ("head", 0, DEMOS + 3 * COUNT)]
