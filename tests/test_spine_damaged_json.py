"""JSON and YAML nested too deep, or with a number too long to be read, is damaged as any other is."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from app.lerobot import deployments
from ddgrasp import config_file, contract, generator_metadata, policy_metadata
from ddgrasp.errors import UserError
from ddgrasp.files import read_json
from ddgrasp.progress import CURVES, Progress, read_curves
from deploy.trial_log import read_log
from recording_support import write_depth
from sensors.recordings.folders import folder_source
from sensors.recordings.recording import Recording

NESTED, LONG = "[" * 100_000, '{"depth_unit_m": 1' + "0" * 5000 + "}"


def _recording(text: str, folder: Path) -> object:
    path = write_depth(folder / "a", [np.full((4, 6), 900, np.uint16)])
    (path / "meta.json").write_text(text)
    return Recording.open(path)


def _import(text: str, folder: Path) -> object:
    path = write_depth(folder / "a", [np.full((4, 6), 900, np.uint16)])
    (path / "meta.json").write_text(text)
    return folder_source(path, 0.0, {})


def _config(text: str, folder: Path) -> object:
    (folder / "a.yaml").write_text(f"preset: debug\nseed: {text[:5000]}\n")
    return config_file.read(folder / "a.yaml")


def _json(text: str, folder: Path) -> object:
    (folder / "a.json").write_text(text)
    return read_json(folder / "a.json")


def _log(text: str, folder: Path) -> object:
    (folder / "a.jsonl").write_text(f"{{}}\n{text}\n{{}}\n")
    return read_log(folder / "a.jsonl")


def _steps(text: str, folder: Path) -> object:
    (folder / "steps.jsonl").write_text(text)
    return deployments._steps(folder / "steps.jsonl")


def _generator(text: str, folder: Path) -> object:
    return generator_metadata.read({generator_metadata.METADATA_KEY: text}, "a.onnx")


def _policy(text: str, folder: Path) -> object:
    return policy_metadata.validate({contract.ONNX_METADATA_KEY: text}, "a.onnx")


@pytest.mark.parametrize("text", [NESTED, LONG], ids=["nested", "long"])
@pytest.mark.parametrize(
    ("read", "said"),
    [
        (_recording, "meta.json: not valid JSON .* repair it or record again"),
        (_import, "meta.json: cannot be read .* repair it, or take it away"),
        (_config, "a.yaml is no YAML: "),
        (_json, "a.json is not valid JSON .* mend it, or delete it"),
        (_log, "a.jsonl: line 2 of 3 is damaged"),
        (_steps, "steps.jsonl is damaged .* move its folder elsewhere"),
        (_generator, "a.onnx has damaged metadata .* make one with `ddgrasp ddg export`"),
        (_policy, "a.onnx has damaged metadata .* make one with `ddgrasp export`"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, read: Callable[[str, Path], object], said: str, text: str):
    with pytest.raises(UserError, match=said) as refused:
        read(text, tmp_path)
    assert "\n" not in str(refused.value)


def test_curves_and_the_clock_do_without_what_cannot_be_read(tmp_path):
    (tmp_path / CURVES).write_text(f'{NESTED}\n{LONG}\n{{"step": 1, "loss": 2.0}}\n')
    assert read_curves(tmp_path) == {"loss": [(1, 2.0)]}
    Progress(tmp_path, quiet=True).close()
    (clock,) = [file for file in tmp_path.iterdir() if file.name != CURVES]
    clock.write_text(NESTED)
    assert Progress(tmp_path, quiet=True).seconds < 60
