"""Every recorded array of the original networks, in float32: foundation/ computes the same numbers.

`make test-parity` runs this file, with those of distances and diffusion; fixtures come from PARITY_DIR, any
of the same kind.
"""

import re
from collections.abc import Callable
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import parity_support as parity
from foundation import convert, dpt, long_video, pictures, resample
from foundation.inception import FidInception
from foundation.resnet import ResNet18
from foundation.vit import VisionTransformer, resize_positions

MAP_RANK = 4
CAPTURE = {"capture_intermediates": True, "mutable": ["intermediates"]}


@pytest.fixture(autouse=True)
def _full_precision():
    with jax.default_matmul_precision("highest"):
        yield


def fixtures(pattern: str):
    """One test per matching fixture; one that skips where there are none."""
    found = parity.names(pattern)
    absent = pytest.param(None, marks=pytest.mark.skip(reason=parity.ABSENT), id="no fixtures")
    return pytest.mark.parametrize("name", found or [absent])


def compute(fixture: parity.Fixture, function: Callable[..., dict], *args) -> dict:
    """What the fixture recorded, of the dictionary that `function` gives, in one program."""

    def chosen(*args):
        found = function(*args)
        return {stem: found[stem] for stem in {split(name, found)[0] for name in recorded(fixture)}}

    return jax.jit(chosen)(*args)


def recorded(fixture: parity.Fixture) -> list[str]:
    """Names of the arrays under act/ and out/."""
    return [key.partition("/")[2] for key in fixture.arrays if key.startswith(("act/", "out/"))]


def check(fixture: parity.Fixture, made: dict, skip: tuple[str, ...] = ()) -> None:
    """Every array under act/ and out/ within its tolerance."""
    report = []
    for key, wanted in fixture.arrays.items():
        if not key.startswith(("act/", "out/")) or key in skip:
            continue
        got = select(key.partition("/")[2], made, wanted.shape)
        assert got.shape == wanted.shape, (key, got.shape, wanted.shape)
        error = float(np.max(np.abs(np.asarray(got, np.float64) - wanted)))
        report.append((key, error, fixture.tolerance(key)))
        print(f"{fixture.name} {key}: {error:.1e} of {fixture.tolerance(key):.1e}")
    assert report
    assert [line for line in report if not line[1] <= line[2]] == []


def split(name: str, made: dict) -> tuple[str, str]:
    """(what was computed, how it is thinned out) of the array that a fixture calls `name`."""
    stem, rule = (name, "") if name in made else (name.rpartition("_")[0], name.rpartition("_")[2])
    assert stem in made, f"nothing computed is called {name}"
    return stem, rule


def select(name: str, made: dict, shape: tuple[int, ...]) -> np.ndarray:
    """The array a fixture calls `name`, thinned out or averaged as its suffix (or its shape) says."""
    stem, rule = split(name, made)
    array = np.asarray(made[stem])
    if rule == "mean":
        return array.mean((-2, -1))
    if rule == "s":
        step = 13 if stem == "net_input" else 5 if array.shape[-1] > 20 else 3
        return array[:, :: 1 if stem == "net_input" else 16, ::step, ::step]
    if found := re.fullmatch(r"s(\d+)", rule):
        step = int(found[1])
        return array[..., step // 2 :: step, step // 2 :: step]
    if found := re.fullmatch(r"c(\d+)", rule):
        return array[..., :: int(found[1]), :, :]
    if array.ndim >= MAP_RANK and array.ndim == len(shape) and array.shape[-3] % shape[-3] == 0:
        return array[..., :: array.shape[-3] // shape[-3], :, :]
    return array


@lru_cache(maxsize=1)
def checkpoint(network: str, seed: int, gain: float) -> tuple[np.ndarray, dict]:
    """Sums over the weights of a network's fixtures, and those weights as Flax variables."""
    arrays = {
        key: parity.draw_parameter(key, target.shape, seed, gain)
        for key, target in convert.targets(network).items()
    }
    return parity.checksums(arrays), convert.convert(network, arrays)


def load(name: str) -> tuple[parity.Fixture, dict]:
    """The fixture and its weights as Flax variables."""
    fixture = parity.load(name)
    sums, variables = checkpoint(fixture.network, fixture.meta["weight_seed"], fixture.meta["gain"])
    np.testing.assert_allclose(sums, fixture.arrays["check/weights"], rtol=1e-9, atol=1e-9)
    return fixture, variables


def outputs(captured: dict) -> dict:
    """Module path joined by dots -> its (first) output; what was sown goes by its own name."""
    found = {}
    for name, value in captured.items():
        if isinstance(value, dict):
            inner = outputs(value)
            found |= {name if key == "__call__" else f"{name}.{key}": array for key, array in inner.items()}
        else:
            found[name] = value[0]
    return found


def channels_first(found: dict) -> dict:
    """Maps (N, h, w, c) as (N, c, h, w); what has another rank stays."""
    arrays = {key: value for key, value in found.items() if not isinstance(value, tuple)}
    return {key: jnp.moveaxis(x, -1, 1) if x.ndim == MAP_RANK else x for key, x in arrays.items()}


def run_depth(network: str, variables: dict, x: jax.Array) -> dict:
    """Outputs of a depth network's modules by path and by their names in fixtures. x: (B, [T,] H, W, 3)."""
    net, params = convert.depth_network(network), variables["params"]
    frames = x.shape[1] if net.video else 1
    head = {"params": params[net.head]}
    taps, encoder = VisionTransformer(net.size).apply(
        {"params": params["pretrained"]}, x.reshape(-1, *x.shape[-3:]), **CAPTURE
    )
    maps, coarse = dpt.CoarseHead(net.size, net.video).apply(head, taps, frames, **CAPTURE)
    depth, fine = dpt.FineHead(net.size).apply(head, *maps, **CAPTURE)
    found = {"depth": depth}
    for part in (encoder, coarse, fine):
        found |= outputs(part["intermediates"])
    for number in range(4):
        place = found.get(f"resize_layers.{number}", found[f"projects.{number}"])
        found[f"layer_{number + 1}"] = place
        found[f"path_{4 - number}"] = found[f"scratch.refinenet{4 - number}"]
        found[f"tap_{net.size.taps[number]}"] = taps[number].reshape(len(place), -1, net.size.width)
    found["patch_embed"] = found["patch_embed.proj"].reshape(len(taps[0]), -1, net.size.width)
    found |= {"depth_prerelu": found["scratch.output_conv2.2"], "block0": found["blocks.0"]}
    return channels_first(found)


@fixtures("dav2_*")
def test_depth_anything_v2(name):
    fixture, variables = load(name)
    x = pictures.standardise(np.moveaxis(fixture.image(), 1, -1))
    if "in/x" in fixture.arrays:
        np.testing.assert_allclose(np.moveaxis(x, -1, 1), fixture.arrays["in/x"], atol=2e-6)
    check(fixture, compute(fixture, partial(run_depth, fixture.network), variables, x))


def run_video(network: str, variables: dict, x: jax.Array) -> dict:
    """`run_depth` with the motion modules' insides; everything (B, T, ...)."""
    found = run_depth(network, variables, x)
    for number, place in enumerate(("layer_3", "layer_4", "path_4", "path_3")):
        found[f"mm{number}_in"] = found[place]
        found[f"mm{number}_out"] = found[f"motion_modules.{number}"]
    inside = "motion_modules.2.temporal_transformer"
    block = f"{inside}.transformer_blocks.0"
    found["mm2_groupnorm"] = found[f"{inside}.norm"]
    batch, frames = x.shape[:2]
    made = {
        key: value.reshape(batch, frames, *value.shape[1:])
        for key, value in found.items()
        if len(value) == batch * frames
    }
    parts = {"block": block, "ff": f"{block}.ff"}
    parts |= {f"attn{index}": f"{block}.attention_blocks.{index}" for index in range(2)}
    for theirs, ours in parts.items():  # (B h w, T, C)
        made[f"mm2_{theirs}"] = found[ours].reshape(batch, -1, *found[ours].shape[1:]).swapaxes(1, 2)
    return made


@fixtures("vda_*")
def test_video_depth_anything(name):
    fixture, variables = load(name)
    x = pictures.standardise(np.moveaxis(fixture.image(), 2, -1))
    check(fixture, compute(fixture, partial(run_video, fixture.network), variables, x))


@fixtures("vda_*_b*")
def test_video_depth_as_it_is_used(name):
    fixture, variables = load(name)
    x = pictures.standardise(np.moveaxis(fixture.image(), 2, -1))
    network = convert.depth_network(fixture.network, frames_at_once=4)
    depth = jax.jit(network)(variables["params"], x)
    np.testing.assert_allclose(
        depth, fixture.arrays["out/depth"], atol=fixture.tolerance("out/depth"), rtol=0
    )


def run_resnet18(variables: dict, x: jax.Array) -> dict:
    (features, logits), captured = ResNet18().apply(variables, x, **CAPTURE)
    found = outputs(captured["intermediates"])
    found |= {f"layer{stage}": found[f"layer{stage}.1"] for stage in range(1, 5)}
    return channels_first(found) | {"features": features, "logits": logits}


@fixtures("resnet18_*")
def test_resnet18(name):
    fixture, variables = load(name)
    x = pictures.standardise(np.moveaxis(fixture.image(), 1, -1))
    check(fixture, compute(fixture, run_resnet18, variables, x))


def run_inception(variables: dict, x: jax.Array) -> dict:
    features, captured = FidInception().apply(variables, x, **CAPTURE)
    return channels_first(outputs(captured["intermediates"])) | {"pool3": features}


@fixtures("inception_*")
def test_fid_inception(name):
    fixture, variables = load(name)
    x = jnp.asarray(np.moveaxis(fixture.image(), 1, -1), jnp.float32) / 255
    check(fixture, compute(fixture, run_inception, variables, x))


@fixtures("unit_posembed*")
def test_position_embeddings(name):
    fixture = parity.load(name)
    table = parity.draw_normal(fixture.meta["weight_seed"], "posembed_unit", (1, 1370, 8)).astype(np.float32)
    made = {}
    for key in fixture.arrays:
        if found := re.fullmatch(r"out/grid_(\d+)x(\d+)", key):
            made[key[4:]] = resize_positions(jnp.asarray(table), (int(found[1]), int(found[2])))
    check(fixture, made)


@fixtures("unit_resize*")
def test_input_sizes_and_cubic_resampling(name):
    fixture = parity.load(name)
    for height, width, size, *wanted in fixture.arrays["out/sizes"].tolist():
        image, (video_size, *video) = wanted[:2], wanted[2:]
        assert video_size > 0
        if 0 not in image:
            assert list(pictures.network_size(height, width, size, video=False)) == image, (
                height,
                width,
                size,
            )
        if 0 not in video:
            assert list(pictures.network_size(height, width, size, video=True)) == video, (
                height,
                width,
                size,
            )
    image = jnp.asarray(np.moveaxis(fixture.arrays["in/cubic_u8"], 0, -1)[None], jnp.float32) / 255
    made = {}
    for key in fixture.arrays:
        if found := re.fullmatch(r"out/cubic_(\d+)x(\d+)", key):
            made[key[4:]] = np.moveaxis(
                resample.resize_cubic(image, (int(found[1]), int(found[2])))[0], -1, 0
            )
    check(fixture, made, skip=("out/sizes",))


@fixtures("unit_stitch*")
def test_stitching_of_windows(name):
    fixture = parity.load(name)
    made = {}
    for key, windows in fixture.arrays.items():
        if found := re.fullmatch(r"in/raw_(\d+)", key):
            count = int(found[1])
            made[f"depth_{count}"] = np.stack(list(long_video.stitch(iter(windows), count)))
            made[f"frame_index_{count}"] = long_video.window_frames(count)
    check(fixture, made)
