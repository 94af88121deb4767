"""ImageNet's ResNet-18 as the student's first encoder weights."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

import checkpoint_support as files
from ddgrasp.config import Config, EncoderConfig, StudentConfig, WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from foundation import convert, store
from student_jax import dagger, policy, pretrained_encoder
from weights_support import resnet18

PROFILE = WorldConfig().profile
RESNET18 = StudentConfig(
    encoder=EncoderConfig(stem="conv7", width=64, stage_blocks=(2, 2, 2, 2), output_stride=32),
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Folder of converted ResNet-18 weights, and its parameters."""
    arrays = resnet18()
    folder = tmp_path_factory.mktemp("weights")
    files.write_pth(folder / "resnet18.pth", arrays)
    return store.convert_file(folder / "resnet18.pth", folder), convert.convert("resnet18", arrays)["params"]


def fresh_encoder(config: StudentConfig) -> dict:
    shapes = policy.param_shapes(config, PROFILE)["encoder"]
    return jax.tree.map(lambda leaf: np.full(leaf.shape, 7.0, np.float32), shapes)


@pytest.mark.parametrize("stride", [32, 8])
@pytest.mark.parametrize("norm", ["group", "none"])
def test_every_convolution_is_taken_over(weights, norm, stride):
    directory, theirs = weights
    config = replace(
        RESNET18,
        encoder=replace(RESNET18.encoder, weights=str(directory), norm=norm, output_stride=stride),
    )
    fresh = fresh_encoder(config)
    made, source = pretrained_encoder.load_into(fresh, config), pretrained_encoder.source(config)
    shapes = jax.tree.map(np.shape, fresh)
    assert jax.tree.map(np.shape, made) == shapes
    assert isinstance(source, dict) and source["network"] == "resnet18"
    np.testing.assert_array_equal(
        made["stage2_block0"]["shortcut"]["conv"]["kernel"], theirs["layer3.0"]["downsample.0"]["kernel"]
    )
    np.testing.assert_array_equal(
        made["stage3_block1"]["second"]["conv"]["kernel"], theirs["layer4.1"]["conv2"]["kernel"]
    )
    if norm == "group":
        np.testing.assert_array_equal(
            made["stage0_block0"]["first"]["norm"]["scale"], theirs["layer1.0"]["bn1"]["scale"]
        )
    untouched = [
        path[0].key
        for path, leaf in jax.tree_util.tree_leaves_with_path(made)
        if path[-1].key == "kernel" and np.all(leaf == 7)
    ]
    assert untouched and not any(name.startswith(("stem", "stage")) for name in untouched)


def test_colours_stand_for_frames(weights):
    directory, theirs = weights
    config = replace(
        RESNET18,
        encoder=replace(RESNET18.encoder, weights=str(directory)),
        picture=replace(RESNET18.picture, channels=("valid", "relief")),
    )
    kernel = pretrained_encoder.load_into(fresh_encoder(config), config)["stem"]["conv7"]["conv"]["kernel"]
    assert kernel.shape == (7, 7, 6, 64)
    for frame in range(3):
        np.testing.assert_array_equal(kernel[:, :, 2 * frame + 1], theirs["conv1"]["kernel"][:, :, frame])
        assert not kernel[:, :, 2 * frame].any()


def test_another_encoder_is_refused_and_none_is_said(weights):
    directory, _ = weights
    small = StudentConfig(encoder=EncoderConfig(weights=str(directory)))
    with pytest.raises(UserError, match="student.encoder.stem is 'space_to_depth'.*'conv7'"):
        pretrained_encoder.load_into({}, small)
    with pytest.raises(UserError, match="depth or relief"):
        pretrained_encoder.load_into(
            {},
            replace(
                RESNET18,
                encoder=replace(RESNET18.encoder, weights="x", pooling="mean"),
                hand_view=replace(RESNET18.hand_view, size_px=0),
                picture=replace(RESNET18.picture, channels=("valid",)),
            ),
        )
    encoder = {"stem": {}}
    assert pretrained_encoder.load_into(encoder, StudentConfig()) == encoder
    assert pretrained_encoder.source(StudentConfig()) == "built-in"
    with pytest.raises(UserError, match="both say where to start"):
        pretrained_encoder.source(
            replace(RESNET18, encoder=replace(RESNET18.encoder, weights="x"), init_from="y")
        )
    with pytest.raises(UserError, match="weights convert"):
        pretrained_encoder.source(replace(RESNET18, encoder=replace(RESNET18.encoder, weights="nowhere")))


def test_a_student_begins_with_the_weights_that_its_report_names(weights, tmp_path, monkeypatch):
    directory, theirs = weights
    student = replace(RESNET18, encoder=replace(RESNET18.encoder, weights=str(directory)))
    monkeypatch.setattr(dagger, "init_params", lambda *_: {"encoder": fresh_encoder(student)})
    nobody: Any = None
    trainer = dagger.Trainer(Config("test", student=student), nobody, nobody, tmp_path, Progress(quiet=True))
    trainer._restore()
    np.testing.assert_array_equal(
        trainer.params["encoder"]["stage3_block1"]["second"]["conv"]["kernel"],
        theirs["layer4.1"]["conv2"]["kernel"],
    )
