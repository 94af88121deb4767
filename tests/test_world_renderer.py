"""`world.renderer`: what stages draw with, and the line that refuses what cannot run here."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import pytest

from app.commands.checks import check_devices
from ddgrasp.config import WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from demos.rollout import Roller
from ppo import policy

ROOT = Path(__file__).parents[1]
REFUSED = "renderer 'warp' needs "
WARP = replace(PRESETS["debug"], world=replace(PRESETS["debug"].world, renderer="warp"))

without_gpu = pytest.mark.skipif(
    any(device.platform == "gpu" for device in jax.devices()), reason="Warp's renderer runs here"
)


def test_a_wrong_name_is_refused_with_the_nearest():
    with pytest.raises(UserError, match=r"world.renderer 'wrap'. Did you mean 'warp'"):
        WorldConfig(renderer="wrap")  # pyright: ignore[reportArgumentType]


@without_gpu
def test_it_is_refused_before_any_work_and_where_stages_draw(tmp_path):
    with pytest.raises(UserError, match=REFUSED):
        check_devices(WARP, tmp_path)
    with pytest.raises(UserError, match=REFUSED):
        Roller(WARP, policy.load(ROOT / "pretrained" / "teacher"), 2)
    assert not list(tmp_path.iterdir())


@without_gpu
def test_a_run_ends_with_one_line(tmp_path):
    command = [sys.executable, "-m", "app.cli", "run", "--preset", "debug", "--world.renderer", "warp"]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "run")], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith(f"ddgrasp: {REFUSED}") and done.stderr.count("\n") == 1
    assert "choose jax" in done.stderr or "pip install" in done.stderr
