"""The shared training machinery on a problem of two numbers: state, optimiser, checkpoints, loop."""

import dataclasses
import gc
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from ddgrasp.errors import UserError
from ddgrasp.progress import Progress, read_curves
from learning.checkpoints import Checkpoints, intact
from learning.loop import run_steps
from learning.optimizers import adamw
from learning.train_state import averaged, first_state, step_key, updated

KEY = jax.random.key_data(jax.random.key(3))
OPTIMIZER = adamw(0.1, 30, warmup=5)


def fresh():
    return first_state({"w": jnp.array([1.0, -2.0])}, OPTIMIZER, KEY)


@jax.jit
def _noisy_step(state):
    target = jax.random.normal(step_key(state), (2,))
    loss, grads = jax.value_and_grad(lambda p: jnp.sum((p["w"] - target) ** 2))(state.params)
    return updated(state, OPTIMIZER, grads, 0.9), {"loss": loss}


def noisy_step(state, _):
    return _noisy_step(state)


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


# --- state -----------------------------------------------------------------------------------------


def test_the_average_by_hand():
    """Decay min(0.9, (1 + n) / (10 + n)): 0.1 in step 0, 0.5 in step 8, 0.9 from step 80 on."""
    old, new = {"w": jnp.array(1.0)}, {"w": jnp.array(2.0)}
    for step, expected in ((0, 1.9), (8, 1.5), (80, 1.1), (10_000, 1.1)):
        assert float(averaged(old, new, jnp.array(step), 0.9)["w"]) == pytest.approx(expected, rel=1e-6)
    assert float(averaged(old, new, jnp.array(5), 0.0)["w"]) == 2.0


def test_an_update_moves_parameters_average_and_step():
    sgd = optax.sgd(0.5)
    state = first_state({"w": jnp.array([1.0, -2.0])}, sgd, KEY)
    after = updated(state, sgd, {"w": jnp.array([2.0, 0.0])}, 0.9)
    np.testing.assert_allclose(after.params["w"], [0.0, -2.0])
    np.testing.assert_allclose(after.ema["w"], [0.1, -2.0], rtol=1e-6)  # 0.1 of the old, 0.9 of the new
    assert int(after.step) == 1
    np.testing.assert_array_equal(after.key, KEY)


def test_a_donated_state_leaves_the_callers_parameters_alone():
    params = {"w": jnp.array([1.0, -2.0])}
    state = first_state(params, OPTIMIZER, KEY)
    jax.jit(lambda s: s.replace(step=s.step + 1), donate_argnums=0)(state)
    assert not intact(state)
    np.testing.assert_array_equal(params["w"], [1.0, -2.0])


def test_every_step_has_a_key_of_its_own():
    state = fresh()
    expected = jax.random.fold_in(jax.random.wrap_key_data(KEY), 1)
    later = state.replace(step=state.step + 1)
    for made in (step_key(state, ahead=1), step_key(later)):
        np.testing.assert_array_equal(jax.random.key_data(made), jax.random.key_data(expected))


# --- optimiser -------------------------------------------------------------------------------------


def sizes(optimizer, steps, gradient=1.0):
    """How far each of `steps` moves a parameter at 0: Adam's is the learning rate, whatever the gradient."""
    params = {"w": jnp.array(0.0)}
    state, moved = optimizer.init(params), []
    for _ in range(steps):
        update, state = optimizer.update({"w": jnp.array(gradient)}, state, params)
        moved.append(-float(update["w"]))
    return np.array(moved)


def test_the_rate_rises_then_falls_along_half_a_cosine():
    steps = sizes(adamw(0.1, 100, warmup=10, final_share=0.2), 101)
    np.testing.assert_allclose(steps[:11], 0.01 * np.arange(11), atol=1e-5)
    np.testing.assert_allclose(steps[55], 0.1 * (0.2 + 0.8 / 2), rtol=1e-3)  # half-way down
    np.testing.assert_allclose(steps[100], 0.02, rtol=1e-3)


def test_the_warm_up_is_a_tenth_of_a_short_training():
    np.testing.assert_allclose(sizes(adamw(0.1, 20, warmup=50), 3), [0, 0.05, 0.1], atol=1e-5)
    assert sizes(adamw(0.1, 1, warmup=50), 2)[1] == pytest.approx(0.1, rel=1e-3)


def test_weights_decay_and_gradients_are_clipped():
    params = {"w": jnp.array([3.0, 0.0])}
    optimizer = adamw(0.1, 10, warmup=1, weight_decay=0.5)
    state = optimizer.init(params)
    for _ in range(2):  # the first step has rate 0
        update, state = optimizer.update({"w": jnp.zeros(2)}, state, params)
    np.testing.assert_allclose(update["w"], [-0.1 * 0.5 * 3, 0], rtol=1e-5)
    # After a clipped gradient of 100 and one of 1 Adam moves as after two of 1.
    clipped, plain = adamw(0.1, 10, warmup=1), adamw(0.1, 10, warmup=1)
    states = [o.init(params) for o in (clipped, plain)]
    for size in (100.0, 1.0):
        one, states[0] = clipped.update({"w": jnp.array([size, 0.0])}, states[0], params)
        two, states[1] = plain.update({"w": jnp.array([1.0, 0.0])}, states[1], params)
    np.testing.assert_allclose(one["w"], two["w"], rtol=1e-6)


# --- checkpoints -----------------------------------------------------------------------------------


def test_the_newest_two_are_kept_and_restored_to_the_bit(tmp_path):
    state = fresh()
    with Checkpoints(tmp_path / "c") as saved:
        assert saved.latest is None
        assert saved.restore_or(state) is state
        with pytest.raises(UserError, match="holds no checkpoint"):
            saved.restore(state)
        for step in (1, 2, 3):
            state, _ = noisy_step(state, step)
            saved.save(step, state)
        saved.save(3, state)  # is there already
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["2", "3"]
    with Checkpoints(tmp_path / "c") as again:
        assert again.latest == 3
        equal(again.restore(jax.eval_shape(fresh)), state)


@pytest.fixture
def orbax_coroutines():
    """Those that Orbax never awaits where a checkpoint cannot be read go with the test that left them."""
    yield
    gc.collect()


def damaging(test):
    ignored = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
    return pytest.mark.usefixtures("orbax_coroutines")(ignored(test))


@damaging
@pytest.mark.parametrize("other", [{"w": jnp.zeros(3)}, {"v": jnp.zeros(2)}])
def test_a_checkpoint_of_another_training_is_refused_in_one_line(tmp_path, other):
    with Checkpoints(tmp_path) as saved:
        saved.save(1, fresh())
        saved.save(2, fresh())
        with pytest.raises(UserError, match="/2 does not fit this training .*delete the folder") as refused:
            saved.restore(first_state(other, OPTIMIZER, KEY))
        assert saved.latest == 2
    assert "\n" not in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2"]


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


DAMAGE = {
    "structure cut": lambda step: cut(step / "default" / "_METADATA"),
    "structure gone": lambda step: (step / "default" / "_METADATA").unlink(),
    "index cut": lambda step: cut(step / "default" / "manifest.ocdbt"),
    "index gone": lambda step: (step / "default" / "manifest.ocdbt").unlink(),
    "numbers cut": lambda step: [cut(file) for file in (step / "default" / "d").iterdir()],
    "numbers gone": lambda step: shutil.rmtree(step / "default" / "d"),
    "nothing but the folder": lambda step: [shutil.rmtree(step), step.mkdir()],
}


@damaging
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_checkpoint_is_deleted_for_the_one_before(tmp_path, damage):
    quiet, seen, said = Progress(quiet=True), [], []
    whole, _ = run_steps(fresh(), 30, noisy_step, tmp_path / "whole", label="", progress=quiet)
    run_steps(fresh(), 20, noisy_step, tmp_path / "c", label="", progress=quiet, every=10)
    DAMAGE[damage](tmp_path / "c" / "20")

    def counted(state, step):
        seen.append(step)
        return noisy_step(state, step)

    quiet.note = said.append
    resumed, _ = run_steps(fresh(), 30, counted, tmp_path / "c", label="fit", progress=quiet, every=10)
    equal(resumed, whole)
    assert seen == list(range(10, 30))
    assert said == ["fit: the checkpoint of step 20 is damaged, going on from 10"]
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["20", "30"]


@damaging
@pytest.mark.parametrize("damage", [cut, lambda file: file.write_bytes(b""), lambda file: file.unlink()])
def test_a_torn_file_of_large_arrays_is_damage_too(tmp_path, damage):
    """Orbax keeps small ones in its index, and raises of large ones what has no class of its own."""
    rng = np.random.default_rng(0)
    with Checkpoints(tmp_path) as saved:
        for step in (1, 2):
            saved.save(step, {"w": jnp.asarray(rng.normal(size=(step, 300, 1000)).astype(np.float32)[0])})
    files = [file for file in (tmp_path / "2").rglob("*") if file.is_file()]
    damage(max(files, key=lambda file: file.stat().st_size))
    with Checkpoints(tmp_path) as saved:
        restored = saved.restore({"w": jnp.zeros((300, 1000))})
        assert saved.latest == 1 and restored["w"].shape == (300, 1000)


@damaging
@pytest.mark.parametrize("damage", DAMAGE)
def test_checkpoints_that_are_all_damaged_are_kept(tmp_path, damage):
    with Checkpoints(tmp_path) as saved:
        for step in (1, 2):
            saved.save(step, fresh())
            DAMAGE[damage](tmp_path / str(step))
        with pytest.raises(UserError, match="/2 .*delete the folder to start afresh") as refused:
            saved.restore(fresh())
    assert "\n" not in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2"]


# --- loop ------------------------------------------------------------------------------------------


class Interrupting(Progress):
    """Ctrl-C at the curves' point of a step."""

    def __init__(self, step):
        super().__init__(quiet=True)
        self.step = step

    def scalars(self, step, **values):
        if step == self.step:
            raise KeyboardInterrupt


def test_resume_equals_an_uninterrupted_run(tmp_path):
    quiet = Progress(quiet=True)
    whole, last = run_steps(fresh(), 30, noisy_step, tmp_path / "whole", label="", progress=quiet)
    with pytest.raises(KeyboardInterrupt):
        run_steps(fresh(), 30, noisy_step, tmp_path / "halves", label="", progress=Interrupting(20), every=7)
    assert sorted(int(path.name) for path in (tmp_path / "halves").iterdir()) == [14, 20]
    seen = []

    def counted(state, step):
        seen.append(step)
        return noisy_step(state, step)

    resumed, same = run_steps(fresh(), 30, counted, tmp_path / "halves", label="", progress=quiet)
    equal(resumed, whole)
    assert (seen, same) == (list(range(20, 30)), last)
    done, nothing = run_steps(fresh(), 30, counted, tmp_path / "halves", label="", progress=quiet)
    equal(done, whole)
    assert nothing == {} and len(seen) == 10
    unsaved, _ = run_steps(fresh(), 30, noisy_step, None, label="", progress=quiet)
    equal(unsaved, whole)


def test_a_step_that_took_the_buffers_and_failed_leaves_the_last_checkpoint(tmp_path):
    donating = jax.jit(lambda s: s.replace(step=s.step + 1), donate_argnums=0)

    def failing(state, step):
        if step == 5:
            donating(state)
            raise KeyboardInterrupt
        return noisy_step(state, step)

    with pytest.raises(KeyboardInterrupt):
        run_steps(fresh(), 30, failing, tmp_path, label="", progress=Progress(quiet=True), every=2)
    assert sorted(int(path.name) for path in tmp_path.iterdir()) == [2, 4]


def falling_apart(after):
    """`noisy_step` whose loss is no number from step `after` on."""

    def step_function(state, step):
        state, metrics = noisy_step(state, step)
        return state, metrics | {"loss": jnp.where(step >= after, jnp.nan, metrics["loss"])}

    return step_function


@pytest.mark.parametrize(("every", "at", "kept"), [(7, 14, [7]), (200, 20, []), (10, 20, [10])])
def test_a_training_that_has_diverged_ends_and_its_state_is_not_kept(tmp_path, every, at, kept):
    progress, said = (
        Progress(quiet=True),
        f"^fit: loss is not finite after {at} steps: .*smaller learning rate",
    )
    with pytest.raises(UserError, match=said) as error:
        run_steps(fresh(), 30, falling_apart(12), tmp_path, label="fit", progress=progress, every=every)
    assert "\n" not in str(error.value)
    assert sorted(int(path.name) for path in tmp_path.iterdir()) == kept


def test_parameters_that_are_no_numbers_are_not_kept_though_the_loss_before_was_one(tmp_path):
    def step_function(state, step):
        state, metrics = noisy_step(state, step)
        spoilt = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), state.params)
        return (state.replace(params=spoilt) if step == 9 else state), metrics

    with pytest.raises(UserError, match="a parameter is not finite after 10 steps"):
        run_steps(fresh(), 30, step_function, tmp_path, label="", progress=Progress(quiet=True), every=5)
    assert [path.name for path in tmp_path.iterdir()] == ["5"]


def test_ctrl_c_between_two_points_keeps_no_diverged_state(tmp_path):
    step_function = falling_apart(12)

    def interrupted(state, step):
        if step == 15:
            raise KeyboardInterrupt
        return step_function(state, step)

    with pytest.raises(KeyboardInterrupt):
        run_steps(fresh(), 30, interrupted, tmp_path, label="", progress=Progress(quiet=True), every=11)
    assert [path.name for path in tmp_path.iterdir()] == ["11"]


def test_curves_have_their_names_places_and_last_point(tmp_path):
    progress = Progress(tmp_path, quiet=True)
    run_steps(
        fresh(), 7, noisy_step, None, label="", progress=progress, curve="fit_", first_point=100, log_every=3
    )
    progress.close()
    steps, losses = zip(*read_curves(tmp_path)["fit_loss"], strict=True)
    assert steps == (103, 106, 107) and np.isfinite(losses).all()


def test_states_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        fresh().step = 3
