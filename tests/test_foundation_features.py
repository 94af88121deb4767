"""Feature extractors: with weights, without, and what they say about themselves."""

from dataclasses import asdict

import numpy as np
import pytest

import checkpoint_support as files
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json
from foundation import convert, features, pictures, store
from foundation.resnet import ResNet18
from weights_support import resnet18
from xla_support import optimized

FIRST_NUMBERS = (0.00240183, 0.05313183)
IMAGES = np.random.default_rng(0).integers(0, 256, (18, 32, 40, 3)).astype(np.uint8)


def test_the_built_in_extractor_is_fixed_and_says_so():
    extractor = features.load_extractor()
    assert (extractor.name, extractor.source) == ("resnet18_random_v1", "built-in")
    kernel = extractor.variables["params"]["conv1"]["kernel"]
    assert kernel[0, 0, 0, :2] == pytest.approx(FIRST_NUMBERS, abs=1e-7)
    with optimized():
        made = extractor(IMAGES)
    assert made.shape == (18, 512) and np.isfinite(made).all() and np.median(made.std(0)) > 0.5
    np.testing.assert_allclose(extractor(IMAGES[16:]), made[16:], rtol=1e-4, atol=1e-5)


def test_published_weights_are_used_where_given(tmp_path):
    arrays = resnet18()
    files.write_safetensors(
        tmp_path / "r.safetensors", {k: a for k, a in arrays.items() if a.dtype == np.float32}
    )
    directory = store.convert_file(tmp_path / "r.safetensors", tmp_path / "weights")
    extractor = features.load_extractor(directory)
    assert (extractor.name, extractor.source) == ("resnet18", store.read_manifest(directory).summary())
    wanted, _ = ResNet18().apply(convert.convert("resnet18", arrays), pictures.standardise(IMAGES[:2]))
    with optimized():
        np.testing.assert_allclose(extractor(IMAGES[:2]), wanted, atol=1e-4)
    manifest = asdict(store.read_manifest(directory)) | {"network": "video_depth_anything_small"}
    atomic_write_json(directory / store.MANIFEST, manifest)
    with pytest.raises(UserError, match="expected fid_inception or resnet18"):
        features.load_extractor(directory)
