"""The exported generator behind one call: NumPy and PyTorch, what it refuses, noise that lasts an episode."""

import json
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest

from ddg_jax.window import mixed
from ddgrasp import generator_metadata as names
from ddgrasp.artifacts import read_manifest
from ddgrasp.config import GraftConfig
from ddgrasp.errors import UserError
from deploy import depth_noise
from deploy.depth_noise import DepthGenerator, check_count
from tutorial_support import code

ROOT = Path(__file__).parents[1]
FILE = ROOT / "pretrained" / "ddg" / "generator.onnx"


@pytest.fixture(scope="module")
def generator() -> DepthGenerator:
    return DepthGenerator(FILE, threads=1)


@pytest.fixture(scope="module")
def scene(generator: DepthGenerator) -> np.ndarray:
    """(2, H, W): a floor with a box before it, and nothing in one corner."""
    height, width = generator.info.height_px, generator.info.width_px
    depth_m = np.tile(np.linspace(1.6, 0.8, height, dtype=np.float32)[:, None], (2, 1, width))
    depth_m[:, height // 3 : 2 * height // 3, width // 3 : width // 2] = 0.7
    depth_m[:, :10, :20] = 0
    return depth_m


def windowed(depth_m: np.ndarray) -> np.ndarray:
    """What the shipped generator takes for clean: depth through the window that it was made with."""
    graft = read_manifest(FILE.parent).config["ddg"]["graft"]
    assert (graft["window_px"], graft["window_shape"]) == (5, "box")
    return mixed(depth_m, GraftConfig(**graft))


def test_a_cameras_holes_lie_where_a_camera_loses_pixels(generator, scene):
    made = generator.generate(scene)
    holes = made.depth_m == 0
    assert 0.03 < holes[:, 12:].mean() < 0.3 and made.mask.dtype == bool
    np.testing.assert_allclose(made.depth_m[~made.mask], windowed(scene)[~made.mask], rtol=1e-5)
    np.testing.assert_array_equal(made.depth_m[made.mask], made.predicted_m[made.mask])
    assert not made.depth_m[:, :10, :20].any()
    height, width = scene.shape[1:]
    beside = holes[:, height // 3 : 2 * height // 3, width // 3 - 8 : width // 3].mean()
    assert beside > 3 * holes[:, -height // 5 :].mean()  # the shadow of the box, and open floor


def test_the_d435s_generator_loses_pixels_beside_what_is_near():
    """A floor that recedes from 1 to 4 m and a post before it, seen as by the robot whose camera it was."""
    generator = DepthGenerator(ROOT / "pretrained" / "d435" / "generator.onnx", threads=1)
    info = generator.info
    assert (info.licence, info.stochastic, info.camera["fx_px"]) == ("MIT", True, 382.7)
    floor = np.linspace(4.0, 1.0, info.height_px, dtype=np.float32)[:, None]
    depth_m = np.tile(floor, (4, 1, info.width_px))
    post = slice(150, 190)
    depth_m[:, :160, post] = 0.8
    made = generator.generate(depth_m)
    holes = made.depth_m == 0
    np.testing.assert_array_equal(made.depth_m[~made.mask], depth_m[~made.mask])
    beside = holes[:, :160, post.start - 8 : post.start].mean()
    assert beside > 0.8 and beside > 10 * holes[:, -80:, 20:-20].mean()


def test_layout_of_the_input_is_kept(generator, scene):
    noise = generator.noise(2).next()
    plain = generator(scene, noise)
    for axis in (1, 3):
        np.testing.assert_array_equal(
            generator(np.expand_dims(scene, axis), noise), np.expand_dims(plain, axis)
        )
    fine = scene.astype(np.float64) * (1 + 1e-8)  # between two numbers of float32
    made = generator.generate(fine, noise)
    assert made.depth_m.dtype == made.predicted_m.dtype == np.float32
    np.testing.assert_allclose(generator(scene.astype(np.float64), noise), plain)
    larger = scene.repeat(2, axis=1).repeat(2, axis=2)
    assert generator(larger, noise).shape == larger.shape


def test_frames_do_not_see_each_other(generator, scene):
    """A batch gives what its frames give one by one, up to rounding at thresholds."""
    noise = generator.noise(2).next()
    scene = scene * np.array([1, 0.8], np.float32)[:, None, None]
    together = generator.generate(scene, noise)
    alone = [generator.generate(scene[i : i + 1], noise[i : i + 1]) for i in range(2)]
    assert np.mean(together.mask != np.concatenate([made.mask for made in alone])) < 1e-3
    in_turns = DepthGenerator(FILE, threads=1, batch=1).generate(scene, noise)  # as many at once as it may
    for made, (first, second) in zip(in_turns, zip(*alone, strict=True), strict=True):
        np.testing.assert_array_equal(made, np.concatenate([first, second]))


def test_evaluations_can_be_asked_for(generator, scene):
    assert generator.info.steps == 8 and not generator.info.fixed_steps
    noise = generator.noise(2)
    now = noise.next()
    np.testing.assert_array_equal(generator(scene, now), generator(scene, now, steps=8))
    assert not np.array_equal(generator(scene, now), generator(scene, noise.next()))
    same = DepthGenerator(FILE, threads=1, seed=5)(scene), DepthGenerator(FILE, threads=1, seed=5)(scene)
    np.testing.assert_array_equal(*same)
    assert not np.array_equal(generator(scene, steps=1), generator(scene, steps=4))


# --- noise -----------------------------------------------------------------------------------------


def test_noise_of_an_episode_lasts_and_ends_with_it(generator):
    noise = generator.noise(2, seed=3)
    first, second = noise.next(), noise.next()
    noise.reset([1])
    third = noise.next()

    def alike(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])

    assert first.shape == (2, 3, 180, 320) and abs(first.std() - 1) < 0.01
    for plane, share in ((0, 0.94), (1, 0.94), (2, 0.5)):  # the prior's, holes', deviations'
        assert alike(first[0, plane], second[0, plane]) == pytest.approx(share, abs=0.02)
    assert alike(second[0, 1], third[0, 1]) == pytest.approx(0.94, abs=0.02)
    assert abs(alike(second[1, 1], third[1, 1])) < 0.02
    assert abs(alike(first[0, 1], first[1, 1])) < 0.02
    with pytest.raises(UserError, match=r"Cameras \[2\] are to be reset; there are 0 to 1"):
        noise.reset([2])
    before = noise.next()
    noise.reset([False, True])
    after = noise.next()
    assert alike(before[0, 1], after[0, 1]) > 0.7 and abs(alike(before[1, 1], after[1, 1])) < 0.02
    for wrong in (1, ["a"], [True]):  # the tests' own check of types would stop these at the door
        with pytest.raises(UserError, match="are to be reset; expected numbers, as in"):
            type(noise).reset.__wrapped__(noise, wrong)
    for none in (0, -1):
        with pytest.raises(UserError, match=f"steps is {none}; expected a whole number of at least 1"):
            noise.next(none)
    with pytest.raises(UserError, match="steps is 2; this noise was begun with 8"):
        noise.next(2)


# --- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("depth", "said"),
    [
        (np.ones((1, 180, 320), np.uint16), "Depth is uint16 .* floating-point metres.*divide millimetres"),
        (np.ones((180, 320), np.float32), r"Depth is float32 \(180, 320\); expected \(N, H, W\)"),
        (np.ones((1, 240, 320), np.float32), "1 frames of 320x240; .* takes the shape of 320x180"),
        (np.ones((0, 180, 320), np.float32), "0 frames of 320x180"),
        (np.full((1, 180, 320), 900.0, np.float32), "from 900 to 900; expected finite metres"),
        (np.full((1, 180, 320), np.inf, np.float32), "put 0 for infinity and NaN"),
        (np.full((1, 180, 320), np.nan, np.float32), "put 0 for infinity and NaN"),
        (np.full((1, 180, 320), -1.0, np.float32), "from -1 to -1; expected finite metres"),
        ([1.0], r"Depth is list \(\); expected"),
    ],
)
def test_wrong_depth_is_one_line(generator, depth, said):
    with pytest.raises(UserError, match=said) as refused:
        generator(depth)
    assert "\n" not in str(refused.value)


def test_a_scene_beyond_what_it_was_fitted_on_is_told_once():
    far = DepthGenerator(FILE)
    depth = np.full((1, 180, 320), 3.0, np.float32)
    with pytest.warns(UserWarning, match="100% of the depth lies outside of the 0.359 to 1.786 m") as told:
        far(depth, steps=1)
        far(depth, steps=1)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        DepthGenerator(FILE)(depth / 3, steps=1)


def test_wrong_noise_and_steps_are_refused(generator, scene):
    with pytest.raises(
        UserError, match=r"Noise is ndarray \(1, 3, 180, 320\); 8 evaluations of 2 frames take \(2, 3"
    ):
        generator(scene, generator.noise(1).next())
    with pytest.raises(UserError, match=r"Noise is list \(\); 8 evaluations of 2 frames take \(2, 3"):
        generator(scene, [0.0])
    with pytest.raises(UserError, match="steps is 51; .* takes 1 to 50"):
        generator(scene, steps=51)


def test_what_is_no_number_is_refused(generator, scene):
    with pytest.raises(UserError, match="steps is 0; expected a whole number of at least 1"):
        generator(scene, steps=0)
    with pytest.raises(UserError, match="count is -1; expected a whole number of at least 1"):
        generator.noise(-1)
    with pytest.raises(UserError, match="batch is 0; expected a whole number of at least 1"):
        DepthGenerator(FILE, batch=0)
    with pytest.raises(UserError, match="seed is -3; expected a whole number of at least 0"):
        generator.noise(1, seed=-3)
    for wrong in (2.5, "4", None, True):  # the tests' own check of types would stop these at the door
        with pytest.raises(UserError, match=f"steps is {wrong!r}; expected a whole number of at least 1"):
            check_count("steps", wrong, 1)
    check_count("steps", np.int64(1), 1)


def test_files_that_are_no_generators_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"ddg is a folder: give the file, .*ddg/generator\.onnx"):
        DepthGenerator("pretrained/ddg")
    with pytest.raises(UserError, match="no such file; make one with `ddgrasp ddg export`"):
        DepthGenerator(tmp_path / "generator.onnx")
    (tmp_path / "generator.onnx").write_bytes(b"no")
    with pytest.raises(UserError, match="onnxruntime cannot load it"):
        DepthGenerator(tmp_path / "generator.onnx")
    with pytest.raises(UserError, match="is no generator of this project"):
        names.read({}, "x")
    with pytest.raises(UserError, match="damaged metadata"):
        names.read({names.METADATA_KEY: "{"}, "x")
    for device in ("tpu", "cuda:one"):
        with pytest.raises(UserError, match=f"device is '{device}'; expected cpu"):
            DepthGenerator(FILE, device=device)


def saying(path: Path, **changes) -> Path:
    """The shipped generator with other metadata, at `path`."""
    model = onnx.load(FILE)
    for one in model.metadata_props:
        if one.key == names.METADATA_KEY:
            one.value = json.dumps(json.loads(one.value) | changes)
    onnx.save(model, path)
    return path


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "1"}, "is a generator of format '1', this code reads 1"),
        ({"format": True}, "is a generator of format True, this code reads 1"),
        ({"height_px": 0}, "height_px is 0, expected 1 to 4096"),
        ({"height_px": "180"}, "height_px is '180', expected 1 to 4096"),
        ({"width_px": 320.0}, "width_px is 320.0, expected 1 to 4096"),
        ({"channels": -1}, "channels is -1, expected 1 to 2"),
        ({"most_steps": 10**9}, "most_steps is 1000000000, expected 1 to 1000"),
        ({"steps": 51}, "steps is 51, expected 1 to 50"),
        ({"steps": 0}, "steps is 0, expected 1 to 50"),
        ({"frame_correlation": 1.5}, "frame_correlation is 1.5, expected 0 to 1"),
        ({"deviation_correlation": float("nan")}, "deviation_correlation is nan, expected 0 to 1"),
        ({"stochastic": "no"}, "stochastic is 'no', expected true or false"),
        ({"camera": []}, r"camera is \[\], expected what is known of it"),
        ({"camera": {"near_m": "a"}}, "camera's near_m is 'a', expected a number"),
        ({"camera": {"far_m": float("inf")}}, "camera's far_m is inf, expected a number"),
        ({"camera": {"fx_px": 10**400}}, "camera's fx_px is 10*, expected a number"),
        (
            {"height_px": 90, "width_px": 160},
            r"'noise' has shape \['batch', 'planes', 180, 320\], its metadata says \['batch', 3, 90, 160\]",
        ),
        (
            {"sampler": "progressive", "most_steps": 8},
            "has the inputs depth, noise, steps, its metadata says depth, noise",
        ),
    ],
    ids=str,
)
def test_a_generator_that_says_what_none_can_be_is_refused(tmp_path, changes, said):
    """Correlations of 1.5 made NaN of the noise, and of the depth what nobody noticed."""
    with pytest.raises(UserError, match=f"{said}: make one with `ddgrasp ddg export`") as refused:
        DepthGenerator(saying(tmp_path / "generator.onnx", **changes), threads=1)
    assert "generator.onnx" in str(refused.value) and "\n" not in str(refused.value)


def test_what_a_generator_s_metadata_may_lack_or_have_besides(tmp_path):
    """A camera of several focal lengths has none; later releases may say more, and correlations be whole."""
    camera = {"name": "x", "fx_px": None, "near_m": 0, "far_m": 2, "firmware": "5.16"}
    path = saying(tmp_path / "generator.onnx", camera=camera, frame_correlation=1, later="more")
    assert DepthGenerator(path, threads=1).info.camera == camera


@pytest.mark.parametrize("planes", [3, 4])
def test_planes_that_a_graph_fixes_have_to_be_the_metadata_s(generator, planes):
    shapes = {"depth": ["batch", "rows", "columns"], "noise": [None, planes, 180, 320], "steps": []}
    if planes == generator.info.planes(generator.info.steps):
        names.validate_shapes(generator.info, shapes, "x")
        return
    with pytest.raises(UserError, match=r"x: 'noise' has shape \[None, 4, 180, 320\], its metadata says"):
        names.validate_shapes(generator.info, shapes, "x")


def test_a_gpu_that_onnxruntime_cannot_load_is_no_cpu(monkeypatch):
    """An onnxruntime-gpu without its libraries lists CUDA, and makes a session without."""
    listed = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(depth_noise.ort, "get_available_providers", lambda: listed)
    with pytest.raises(UserError, match="device is cuda, which onnxruntime could not load"):
        DepthGenerator(FILE, device="cuda")


def test_neither_jax_nor_pytorch_is_loaded():
    code = (
        "import sys, numpy as np\n"
        "from deploy.depth_noise import DepthGenerator\n"
        f"DepthGenerator({str(FILE)!r}, threads=1)(np.ones((1, 180, 320), np.float32))\n"
        "print(sorted({'jax', 'flax', 'torch', 'onnx', 'cv2', 'mujoco'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


# --- PyTorch ---------------------------------------------------------------------------------------


def test_tensors_give_what_arrays_give(generator, scene):
    torch = pytest.importorskip("torch")
    noise = generator.noise(2).next()
    wanted = generator.generate(scene, noise)
    made = generator.generate(torch.from_numpy(scene)[..., None], torch.from_numpy(noise))
    assert made.depth_m.shape == (*scene.shape, 1) and made.mask.dtype == torch.bool
    for tensor, array in zip(made, wanted, strict=True):
        np.testing.assert_array_equal(tensor[..., 0].numpy(), array)
    in_turns = DepthGenerator(FILE, threads=1, batch=1)
    np.testing.assert_array_equal(in_turns(torch.from_numpy(scene), noise), in_turns(scene, noise))
    half = generator(torch.from_numpy(scene).half(), noise)  # NumPy noise will do
    assert half.dtype == torch.float32
    drawn = generator.noise(2, seed=1, device="cpu")
    drawn.next()
    drawn.reset([0])
    assert generator(torch.from_numpy(scene), drawn.next()).shape == scene.shape
    assert generator(torch.from_numpy(scene)).shape == scene.shape
    with pytest.raises(UserError, match=r"Depth is torch.int16 \(2, 180, 320\)"):
        generator(torch.ones(2, 180, 320, dtype=torch.int16))


# --- the tutorial ----------------------------------------------------------------------------------


def run_blocks(*numbers: int) -> dict:
    """Names that the tutorial's Python blocks leave, one after the other."""
    left: dict = {}
    for number in numbers:
        exec(code("one_file.md")[number].replace("pretrained/ddg/generator.onnx", str(FILE)), left)
    return left


def test_the_tutorials_numpy_runs():
    left = run_blocks(0, 1)
    clean_m, reported_m, mask = left["clean_m"], left["reported_m"], left["reported_m"] == 0
    assert reported_m.shape == clean_m.shape and 0.03 < mask.mean() < 0.3
    assert left["first_m"].shape == left["second_m"].shape == clean_m.shape


def test_the_tutorials_pytorch_runs():
    torch = pytest.importorskip("torch")
    left = run_blocks(0, 2)
    assert isinstance(left["reported"], torch.Tensor) and left["reported"].shape == left["clean_m"].shape


def test_the_tutorials_isaac_lab_takes_its_cameras_tensors(generator, scene):
    torch = pytest.importorskip("torch")
    depth = torch.from_numpy(np.where(scene > 0, scene, np.inf))[..., None]
    camera = SimpleNamespace(data=SimpleNamespace(output={"distance_to_image_plane": depth}))
    noise = run_blocks(4)["CameraNoise"](str(FILE), "cpu", 2)
    made = noise(camera)
    assert made.shape == depth.shape and made.isfinite().all() and not made[:, :10, :20].any()
    before = noise.noise.next()
    noise.reset(torch.tensor([1]))
    after = noise.noise.next()
    alike = [float(np.corrcoef(before[i, 1].ravel(), after[i, 1].ravel())[0, 1]) for i in range(2)]
    assert alike[0] > 0.7 and abs(alike[1]) < 0.05


def test_the_tutorials_maniskill_runs():
    """Where ManiSkill is installed and can render."""
    pytest.importorskip("mani_skill")
    left = run_blocks(3)
    (picture,) = left["obs"]["sensor_data"].values()
    depth = picture["depth"]
    assert tuple(depth.shape) == (1, 180, 320, 1) and str(depth.dtype) == "torch.float32"
    assert 0.01 < float((depth == 0).float().mean()) < 0.9


def test_another_seed_draws_other_noise(generator, scene):
    one, other = (generator.noise(1, seed=seed).next() for seed in (1, 2))
    assert not np.array_equal(one, other)
    one, other = (DepthGenerator(FILE, threads=1, seed=seed)(scene) for seed in (5, 6))
    assert not np.array_equal(one, other)


def test_a_shape_that_is_nearly_the_generator_s_is_refused(generator):
    height, width = generator.info.height_px, generator.info.width_px
    generator.check_shape(height, round(1.015 * width))
    with pytest.raises(UserError, match="render with that aspect ratio"):
        generator.check_shape(height, round(1.04 * width))


def test_a_scene_nearer_than_the_camera_reads_is_warned_of_too(scene):
    generator = DepthGenerator(FILE, threads=1)
    near_m = generator.info.camera["near_m"]
    with pytest.warns(UserWarning, match="lies outside of the"):
        generator(np.full_like(scene, 0.9 * near_m))
