"""Published checkpoint files: read without running them, recognised, refused, converted, stored."""

import json
import pickle
import struct
import zipfile
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np
import pytest

import checkpoint_support as files
import parity_support as parity
import weights_support
from app.cli import main
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json
from foundation import catalog, convert, store
from foundation.checkpoint_files import read_checkpoint
from foundation.pickled_tensors import read_pth

ARRAYS = {
    "a.weight": np.arange(6, dtype=np.float32).reshape(2, 3),
    "a.bias": np.array([1.5, -2], np.float16),
    "n": np.array(7, np.int64),
}


def assert_same(made: dict, wanted: dict) -> None:
    assert made.keys() == wanted.keys()
    for key, array in wanted.items():
        assert made[key].dtype == array.dtype
        np.testing.assert_array_equal(made[key], array)


@pytest.mark.parametrize("wrapper", ["", "state_dict", "model"])
def test_pth_of_the_zip_format(tmp_path, wrapper):
    files.write_pth(tmp_path / "x.pth", ARRAYS, wrapper=wrapper)
    assert_same(read_pth(tmp_path / "x.pth"), ARRAYS)


def test_pth_of_the_older_format(tmp_path):
    files.write_legacy_pth(tmp_path / "x.pth", ARRAYS)
    assert_same(read_pth(tmp_path / "x.pth"), ARRAYS)
    whole = (tmp_path / "x.pth").read_bytes()
    (tmp_path / "x.pth").write_bytes(whole[:-4])
    with pytest.raises(UserError, match="ends early"):
        read_pth(tmp_path / "x.pth")
    claimed = struct.pack("<q", 6), struct.pack("<q", 2**44)
    (tmp_path / "x.pth").write_bytes(whole.replace(*claimed))
    with pytest.raises(UserError, match="ends early"):
        read_pth(tmp_path / "x.pth")
    text_of_16_tb = b"\x80\x04\x8d" + struct.pack("<Q", 2**44)
    (tmp_path / "x.pth").write_bytes(text_of_16_tb)
    with pytest.raises(UserError, match=r"no readable PyTorch checkpoint: \w"):
        read_pth(tmp_path / "x.pth")


def test_a_tensor_may_be_a_strided_view(tmp_path):
    base = np.arange(6, dtype=np.float32)
    body = files.state_pickle({"x": base}, "").replace(
        files.integer(0) + files.integers([6]) + files.integers([1]),
        files.integer(1) + files.integers([2, 2]) + files.integers([1, 3]),
    )
    with zipfile.ZipFile(tmp_path / "x.pth", "w") as archive:
        archive.writestr("x/data.pkl", b"\x80\x02" + body + b".")
        archive.writestr("x/data/0", base.tobytes())
    np.testing.assert_array_equal(read_pth(tmp_path / "x.pth")["x"], [[1, 4], [2, 5]])


def test_safetensors_and_a_common_prefix(tmp_path):
    arrays = {f"module.{name}": array for name, array in ARRAYS.items() if array.dtype == np.float32}
    files.write_safetensors(tmp_path / "x.safetensors", arrays)
    made = read_checkpoint(tmp_path / "x.safetensors")
    np.testing.assert_array_equal(made["a.weight"], ARRAYS["a.weight"])


class Bomb:
    def __reduce__(self):
        return Path.touch, (Path("exploded"),)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_nothing_in_a_pickle_is_run(tmp_path, monkeypatch, protocol):
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("bomb.pth", "w") as archive:
        archive.writestr("x/data.pkl", pickle.dumps({"a": Bomb()}, protocol))
    Path("bare.pth").write_bytes(pickle.dumps({"a": Bomb()}, protocol))
    for name in ("bomb.pth", "bare.pth"):
        with pytest.raises(UserError):
            read_pth(Path(name))
    assert not Path("exploded").exists()
    pickle.loads(pickle.dumps(Bomb(), protocol))
    assert Path("exploded").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda body: body.replace(b"_rebuild_tensor_v2", b"_rebuild_tensor_v9"),
            "torch._utils _rebuild_tensor_v9",
        ),
        (lambda body: body.replace(b"FloatStorage", b"PlainStorage"), "torch PlainStorage"),
        (lambda body: body.replace(files.integers([2, 3]), files.integers([2, 4])), "outside its storage"),
        (lambda body: body[:40], "no readable"),
        (lambda body: body.replace(b"storage", b"garbage"), "no plain storage"),
    ],
)
def test_damaged_files_are_named(tmp_path, damage, message):
    arrays = {"a.weight": ARRAYS["a.weight"]}
    with zipfile.ZipFile(tmp_path / "x.pth", "w") as archive:
        archive.writestr("x/data.pkl", damage(b"\x80\x02" + files.state_pickle(arrays, "") + b"."))
        archive.writestr("x/data/0", arrays["a.weight"].tobytes())
    with pytest.raises(UserError, match=message):
        read_pth(tmp_path / "x.pth")


def test_files_of_other_kinds_are_named(tmp_path):
    (tmp_path / "x.pth").write_bytes(b"not a checkpoint")
    (tmp_path / "x.txt").write_bytes(b"text")
    (tmp_path / "x.safetensors").write_bytes(struct.pack("<Q", 1 << 40) + b"{}")
    header = {"x": {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]}}
    short = json.dumps(header).encode()
    (tmp_path / "y.safetensors").write_bytes(struct.pack("<Q", len(short)) + short + bytes(8))
    (tmp_path / "z.safetensors").write_bytes(struct.pack("<Q", 100_000) + b"[" * 100_000)
    for name, message in (
        ("x.pth", "neither"), ("x.txt", "expected one of"), ("x.safetensors", "header"),
        ("y.safetensors", "offsets 0 to 16 in 8 bytes"), ("z.safetensors", "no readable safetensors file"),
        ("none.pth", "does not exist"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=message):
            read_checkpoint(tmp_path / name)


# --- networks ------------------------------------------------------------------------------------


@pytest.fixture
def resnet18() -> dict[str, np.ndarray]:
    return weights_support.resnet18()


KEY_FILES = {
    "depth_anything_v2_small": "keys_dav2_vits.txt",
    "video_depth_anything_small": "keys_vda_vits.txt",
    "resnet18": "keys_resnet18.txt",
    "fid_inception": "keys_inception_fid.txt",
}


@pytest.mark.parametrize("network", KEY_FILES)
def test_keys_are_those_of_the_published_files(network):
    path = parity.DIRECTORY.parent / KEY_FILES[network]
    if not path.exists():
        pytest.skip(parity.ABSENT)
    lines = (line.split("\t") for line in path.read_text().splitlines())
    published = {key: tuple(json.loads(shape)) for key, shape in lines}
    assert {key: target.shape for key, target in convert.targets(network).items()} == published
    assert convert.recognise(published) == network


@pytest.mark.parametrize(
    ("network", "published_millions"),
    [("depth_anything_v2_base", 97.5), ("depth_anything_v2_large", 335.3)],
)
def test_larger_sizes_from_the_same_code(network, published_millions):
    keys = {key: target.shape for key, target in convert.targets(network).items()}
    assert convert.recognise(keys) == network
    count = sum(int(np.prod(shape)) for shape in keys.values())
    assert count / 1e6 == pytest.approx(published_millions, abs=0.1)
    video = network.replace(catalog.IMAGE_DEPTH, catalog.VIDEO_DEPTH)
    shapes = {key: target.shape for key, target in convert.targets(video).items()}
    assert convert.recognise(shapes) == video
    encoder = {key for key in keys if key.startswith("pretrained.")}
    assert encoder == {key for key in shapes if key.startswith("pretrained.")}


def test_a_file_that_does_not_fit_is_refused_by_key(resnet18):
    wrong = dict(resnet18)
    del wrong["layer2.0.conv1.weight"]
    wrong["layer9.weight"] = np.zeros(3, np.float32)
    wrong["fc.bias"] = np.zeros(10, np.float32)
    with pytest.raises(UserError) as error:
        convert.convert("resnet18", wrong)
    for part in (
        "1 missing: layer2.0.conv1.weight", "1 surplus: layer9.weight",
        "1 misshapen: fc.bias is [10], expected [1000]",
    ):  # fmt: skip
        assert part in str(error.value)
    with pytest.raises(UserError, match="122 missing|102 missing"):
        convert.convert("resnet18", {})
    with pytest.raises(UserError, match="transformer.wte"):
        convert.recognise({"transformer.wte": (3, 4)})
    with pytest.raises(UserError, match="fc.bias holds values that are not finite"):
        convert.convert("resnet18", resnet18 | {"fc.bias": np.full(1000, np.nan, np.float32)})


def test_counters_of_batch_norms_may_be_absent(resnet18):
    older = {key: array for key, array in resnet18.items() if not key.endswith("num_batches_tracked")}
    assert len(older) == len(resnet18) - 20
    variables = convert.convert("resnet18", older)
    kernel = variables["params"]["conv1"]["kernel"]
    assert kernel.shape == (7, 7, 3, 64)
    assert kernel[1, 2, 0, 5] == resnet18["conv1.weight"][5, 0, 1, 2]
    assert variables["params"]["fc"]["kernel"][3, 4] == resnet18["fc.weight"][4, 3]


def test_conversion_is_stored_with_its_origin_and_loads_back(tmp_path, resnet18):
    file = tmp_path / "resnet18.pth"
    files.write_pth(file, resnet18)
    directory = store.convert_file(file, tmp_path / "weights")
    manifest, variables = store.load(directory, (catalog.RESNET18,))
    wanted = convert.convert("resnet18", resnet18)
    jax.tree.map(np.testing.assert_array_equal, variables, wanted)
    assert (manifest.network, manifest.source_file) == ("resnet18", "resnet18.pth")
    assert manifest.parameters == 11_689_512
    assert len(manifest.source_sha256) == 64
    assert store.installed(tmp_path / "weights") == {"resnet18": manifest}
    with pytest.raises(UserError, match="expected video_depth_anything"):
        store.load(directory, (catalog.VIDEO_DEPTH,))
    with pytest.raises(UserError, match="weights convert"):
        store.load(tmp_path)
    (directory / store.MANIFEST).write_text('{"format_version": 1}')
    with pytest.raises(UserError, match="another version"):
        store.load(directory)
    (directory / store.MANIFEST).write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        store.load(directory)


def test_a_conversion_takes_no_file_away_that_is_not_its_own(tmp_path, resnet18):
    file = tmp_path / "weights" / "resnet18" / "resnet18.pth"  # in the very folder
    file.parent.mkdir(parents=True)
    files.write_pth(file, resnet18)
    with pytest.raises(UserError, match=r"resnet18 holds resnet18\.pth, which is no part of converted"):
        store.convert_file(file, tmp_path / "weights")
    assert [path.name for path in file.parent.iterdir()] == ["resnet18.pth"]
    elsewhere = file.replace(tmp_path / "resnet18.pth")
    for _ in range(2):  # an earlier conversion is replaced
        assert store.convert_file(elsewhere, tmp_path / "weights") == tmp_path / "weights" / "resnet18"


@pytest.mark.parametrize(
    ("network", "name"),
    [
        ("depth_anything_v2_small", "depth_anything_v2_metric_hypersim_vits"),
        ("video_depth_anything_small", "metric_video_depth_anything_vits"),
    ],
)
def test_weights_for_metric_depth_are_refused_by_name(tmp_path, network, name):
    shapes = {key: target.shape for key, target in convert.targets(network).items()}
    file = tmp_path / f"{name}.safetensors"
    files.write_safetensors(file, {key: np.zeros(shape, np.float32) for key, shape in shapes.items()})
    with pytest.raises(
        UserError, match=f"{file.name} .* not supported: take {catalog.ENTRIES[network].file}"
    ):
        store.convert_file(file, tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


def test_manifests_that_state_a_range_of_metric_depth(tmp_path):
    name = "depth_anything_v2_small"
    manifest = store.WeightsManifest(name, "x.pth", "ab12", "Apache-2.0", "here", 1, {}, "today")
    atomic_write_json(tmp_path / store.MANIFEST, asdict(manifest) | {"max_depth_m": 0.0})
    assert store.read_manifest(tmp_path) == manifest
    atomic_write_json(tmp_path / store.MANIFEST, asdict(manifest) | {"max_depth_m": 20.0})
    with pytest.raises(UserError, match=f"{tmp_path} holds weights for metric depth.* weights list"):
        store.read_manifest(tmp_path)


def test_weights_of_depth_anything_s_first_version_are_refused(tmp_path):
    shapes = {key: target.shape for key, target in convert.targets("depth_anything_v2_small").items()}
    file = tmp_path / "depth_anything_vits14.safetensors"  # the same arrays, of which it reads other layers
    files.write_safetensors(file, {key: np.zeros(shape, np.float32) for key, shape in shapes.items()})
    with pytest.raises(UserError, match=r"_vits14.safetensors looks like .* first version.*: take depth_any"):
        store.convert_file(file, tmp_path / "weights")
    assert not (tmp_path / "weights").exists()
    file = file.rename(tmp_path / "depth_anything_v2_vits.safetensors")
    assert store.convert_file(file, tmp_path / "weights").name == "depth_anything_v2_small"


def test_one_damaged_folder_hides_no_other(tmp_path, capsys):
    for name, text in (("resnet18", "{"), ("fid_inception", '{"format_version": 0}')):
        (tmp_path / name).mkdir()
        (tmp_path / name / store.MANIFEST).write_text(text)
    name = "depth_anything_v2_small"
    manifest = store.WeightsManifest(name, "x.pth", "ab12", "Apache-2.0", "here", 1, {}, "today")
    atomic_write_json(tmp_path / name / store.MANIFEST, manifest)
    assert store.installed(tmp_path) == {name: manifest}
    reasons = store.unreadable(tmp_path)
    assert reasons.keys() == {"resnet18", "fid_inception"}
    assert "not valid JSON" in reasons["resnet18"] and "another version" in reasons["fid_inception"]
    assert main(["weights", "list", "--out", str(tmp_path)]) == 0
    listed = capsys.readouterr().out
    assert all(reason in listed for reason in reasons.values())
    assert f"installed in {tmp_path / name}, from x.pth" in listed


def test_the_catalog_states_licences():
    assert len(catalog.ENTRIES) == 8
    for name, entry in catalog.ENTRIES.items():
        free = name.endswith("small") or name in ("fid_inception", "resnet18")
        assert free != ("non-commercial" in entry.licence), name
    with pytest.raises(UserError, match="Did you mean 'resnet18'"):
        catalog.get_entry("resnet81")


# --- the command line ----------------------------------------------------------------------------


def test_convert_and_list(tmp_path, capsys, resnet18):
    assert main(["weights", "list", "--out", str(tmp_path / "weights")]) == 0
    listed = capsys.readouterr().out
    assert listed.count("not installed") == len(catalog.ENTRIES)
    for name, entry in catalog.ENTRIES.items():
        assert name in listed and entry.file in listed and entry.licence in listed
    file = tmp_path / "resnet18-f37072fd.pth"
    files.write_pth(file, resnet18)
    assert main(["weights", "convert", str(file), "--out", str(tmp_path / "weights")]) == 0
    assert "resnet18, 11,689,512 numbers" in capsys.readouterr().out
    assert main(["weights", "list", "--out", str(tmp_path / "weights")]) == 0
    assert f"installed in {tmp_path / 'weights' / 'resnet18'}, from {file.name}" in capsys.readouterr().out
    files.write_pth(file, resnet18 | {"layer9.weight": np.zeros(3, np.float32)})
    assert main(["weights", "convert", str(file), "--out", str(tmp_path / "weights")]) == 2
    assert "1 surplus: layer9.weight" in capsys.readouterr().err
    assert "resnet18" in store.installed(tmp_path / "weights")
