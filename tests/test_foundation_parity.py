"""Every recorded array of the original networks, in float32: foundation/ computes the same numbers.

`make test-parity` runs this file alone; fixtures come from PARITY_DIR, any of the same kind.
"""

import re
import sys
from functools import lru_cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import parity_support as parity

from foundation import convert, dpt, long_video, pictures, resample
from foundation.inception import FidInception
from foundation.resnet import ResNet18
from foundation.vit import VisionTransformer, resize_positions

MAP_RANK = 4


@pytest.fixture(autouse=True)
def _full_precision():
    with jax.default_matmul_precision("highest"):
        yield


def fixtures(pattern: str):
    """One test per matching fixture; one that skips where there are none."""
    found = parity.names(pattern)
    absent = pytest.param(None, marks=pytest.mark.skip(reason=parity.ABSENT), id="no fixtures")
    return pytest.mark.parametrize("name", found or [absent])


def check(fixture: parity.Fixture, made: dict, skip: tuple[str, ...] = ()) -> None:
    """Every array under act/ and out/ within its tolerance."""
    compared, report = 0, []
    for key, wanted in fixture.arrays.items():
        group, _, name = key.partition("/")
        if group not in ("act", "out") or key in skip:
            continue
        got = select(name, made, wanted.shape)
        assert got.shape == wanted.shape, (key, got.shape, wanted.shape)
        error = float(np.max(np.abs(np.asarray(got, np.float64) - wanted)))
        report.append((key, error, fixture.tolerance(key)))
        compared += 1
    assert compared > 0
    for key, error, tolerance in report:
        print(f"{fixture.name} {key}: {error:.1e} of {tolerance:.1e}")
    assert [line for line in report if not line[1] <= line[2]] == []


def select(name: str, made: dict, shape: tuple[int, ...]) -> np.ndarray:
    """The array a fixture calls `name`, thinned out or averaged as its suffix (or its shape) says."""
    stem, rule = name, ""
    if name not in made:
        stem, _, rule = name.rpartition("_")
    assert stem in made, f"nothing computed is called {name}"
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
    return {
        key: np.moveaxis(np.asarray(value), -1, 1) if value.ndim == MAP_RANK else value
        for key, value in found.items()
        if not isinstance(value, tuple)
    }


def run_depth(network: str, variables: dict, x: jax.Array) -> dict:
    """Outputs of every module of a depth network, by path, and `depth`. x: (B, [T,] H, W, 3)."""
    net, params = convert.depth_network(network), variables["params"]
    frames = x.shape[1] if net.video else 1
    capture = {"capture_intermediates": True, "mutable": ["intermediates"]}
    head = {"params": params[net.head]}
    taps, encoder = VisionTransformer(net.size).apply(
        {"params": params["pretrained"]}, x.reshape(-1, *x.shape[-3:]), **capture
    )
    maps, coarse = dpt.CoarseHead(net.size, net.video).apply(head, taps, frames, **capture)
    depth, fine = dpt.FineHead(net.size).apply(head, *maps, **capture)
    found = (
        outputs(encoder["intermediates"]) | outputs(coarse["intermediates"]) | outputs(fine["intermediates"])
    )
    found |= {"depth": depth, "depth_prerelu": found["scratch.output_conv2.2"]}
    for number in range(4):
        place = found.get(f"resize_layers.{number}", found[f"projects.{number}"])
        found[f"layer_{number + 1}"] = place
        found[f"path_{4 - number}"] = found[f"scratch.refinenet{4 - number}"]
        found[f"tap_{net.size.taps[number]}"] = taps[number].reshape(
            taps[number].shape[0], -1, net.size.width
        )
    found |= (
        {"patch_embed": found["patch_embed.proj"].reshape(x.shape[0], -1, net.size.width)}
        if frames == 1
        else {}
    )
    found["block0"] = found["blocks.0"]
    return channels_first(found)


@fixtures("dav2_*")
def test_depth_anything_v2(name):
    fixture, variables = load(name)
    x = pictures.standardise(np.moveaxis(fixture.image(), 1, -1))
    if "in/x" in fixture.arrays:
        np.testing.assert_allclose(np.moveaxis(x, -1, 1), fixture.arrays["in/x"], atol=2e-6)
    check(fixture, run_depth(fixture.network, variables, x))


@fixtures("vda_*")
def test_video_depth_anything(name):
    fixture, variables = load(name)
    image = np.moveaxis(fixture.image(), 2, -1)
    batch, frames = image.shape[:2]
    x = pictures.standardise(image)
    found = run_depth(fixture.network, variables, x)
    places = {0: "layer_3", 1: "layer_4", 2: "path_4", 3: "path_3"}
    for number, place in places.items():
        found[f"mm{number}_in"] = found[place]
        found[f"mm{number}_out"] = found[f"motion_modules.{number}"]
    inside = "motion_modules.2.temporal_transformer"
    block = f"{inside}.transformer_blocks.0"
    found["mm2_groupnorm"] = found[f"{inside}.norm"]
    made = {
        key: np.asarray(value).reshape(batch, frames, *value.shape[1:])
        for key, value in found.items()
        if value.shape[0] == batch * frames
    }
    for ours, theirs in (
        (f"{block}.attention_blocks.0", "mm2_attn0"),
        (f"{block}.attention_blocks.1", "mm2_attn1"),
        (f"{block}.ff", "mm2_ff"),
        (block, "mm2_block"),
    ):
        value = np.asarray(found[ours])  # (B h w, T, C)
        made[theirs] = value.reshape(batch, -1, *value.shape[1:]).swapaxes(1, 2)
    check(fixture, made)


@fixtures("resnet18_*")
def test_resnet18(name):
    fixture, variables = load(name)
    x = pictures.standardise(np.moveaxis(fixture.image(), 1, -1))
    (features, logits), captured = ResNet18().apply(
        variables, x, capture_intermediates=True, mutable=["intermediates"]
    )
    found = outputs(captured["intermediates"])
    found |= {f"layer{stage}": found[f"layer{stage}.1"] for stage in range(1, 5)}
    check(fixture, channels_first(found) | {"features": features, "logits": logits})


@fixtures("inception_*")
def test_fid_inception(name):
    fixture, variables = load(name)
    x = jnp.asarray(np.moveaxis(fixture.image(), 1, -1), jnp.float32) / 255
    features, captured = FidInception().apply(
        variables, x, capture_intermediates=True, mutable=["intermediates"]
    )
    check(fixture, channels_first(outputs(captured["intermediates"])) | {"pool3": features})


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
