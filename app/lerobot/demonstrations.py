"""Demonstrations of a run (`demos/episodes.zarr`) as episodes, with clean depth or a generator's."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from app.lerobot.episode import Episode, Picture, Source
from ddgrasp import artifacts, contract
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.layout import ACTION
from ddgrasp.shipped import holding
from demos.store import STORE, EpisodeStore

STAGE = "demos"
NOISY_STORE, NOISY_STAGE = "depth.zarr", "noisy"
"""As `ddg_jax.generate` names them, which imports JAX."""
_ENGINE = {"cpu": "MuJoCo", "jax": "MuJoCo MJX", "warp": "MuJoCo Warp"}
"""By `world.backend`."""
CLEAN_DEPTH = "its depth is clean: no holes, no noise"


def find(path: Path) -> Path | None:
    """The stage's folder, where `path` is it, a run that has it, or the store in it; None elsewhere."""
    places = (path, path / STAGE, path.parent if path.name == STORE else path)
    return next((place for place in places if (place / STORE / "zarr.json").exists()), None)


def read(folder: Path, objects: Sequence[str] = (), noisy: Path | None = None) -> Source:
    """The episodes of the stage in `folder`, of the named `objects` alone if there are any.

    Args:
      noisy: what `ddgrasp ddg generate` made of them: its depth in the place of clean depth.

    Raises:
      UserError: the stage is not finished, its store is damaged, an object is none of its own, or `noisy` was
        made of other demonstrations.
    """
    manifest = artifacts.read_manifest(folder)
    config = artifacts.config_from_json(manifest.config)
    names = config.world.objects
    for name in objects:
        if name not in names:
            raise unknown_name("object", name, names)
    store = EpisodeStore(folder / STORE)
    depth, depth_is = (store, CLEAN_DEPTH) if noisy is None else _open_noisy(noisy, folder)
    if not len(store):
        raise UserError(f"{folder} has no episode: collect some with `ddgrasp demos collect`.")
    indices = store.episodes("object_index").tolist()
    taken = [i for i, index in enumerate(indices) if not objects or names[index] in objects]
    if not taken:
        raise UserError(f"{folder} has no episode with {' or '.join(objects)}: choose others of {names}.")
    width, height = config.world.profile.width_px, config.world.profile.height_px
    disturbed = (
        " In some steps its joint steps were disturbed (standard deviation "
        f"{config.demos.action_noise:g}); `action` is what it asked for, not the disturbed step, so that "
        "recoveries are labelled."
        if config.demos.noise_share and config.demos.action_noise
        else ""
    )
    about = {
        "Robot": f"Franka Emika Panda with its hand, simulated in {_ENGINE[config.world.backend]}.",
        "Camera": f"An ideal one with a RealSense D455's view, {width} x {height}, fixed across the table; "
        f"{depth_is}.",
        "How it was made": f"A policy that sees the simulator's state, trained by PPO "
        f"{_begun(config.teacher.start)}, grasped {len(names)} "
        f"objects; episodes that failed were thrown away.{disturbed}",
    }
    poses = store.episodes("T_world_cam")
    read_one = partial(_read, store, depth, names, indices, poses)
    return Source("demonstrations", contract.PANDA.name, about, [partial(read_one, i) for i in taken])


def _begun(start: str) -> str:
    """What PPO began from, in words."""
    return {"nothing": "from nothing", "guide": "from a scripted controller"}.get(start, f"from {start}")


def _open_noisy(path: Path, folder: Path) -> tuple[EpisodeStore, str]:
    """The generated depth of the demonstrations in `folder`, and what a card says of it."""
    place = holding(path, artifacts.MANIFEST, NOISY_STAGE) or path / NOISY_STAGE
    manifest = artifacts.read_manifest(place)
    if manifest.parents.get(STAGE) != artifacts.read_artifact(folder).hash:
        raise UserError(
            f"{place} is not depth of the demonstrations in {folder}: make it with `ddgrasp ddg generate "
            f"--demos {folder}`."
        )
    without = float(manifest.metrics["invalid_fraction"])
    return EpisodeStore(place / NOISY_STORE), (
        "its depth has a camera's holes and errors as a diffusion model of depth noise draws them "
        f"(`ddgrasp ddg generate`; {without:.1%} of the pixels have none)"
    )


def _read(
    store: EpisodeStore, depth: EpisodeStore, names: Sequence[str], indices: Sequence[int], poses: np.ndarray,
    number: int,
) -> Episode:  # fmt: skip
    ends = store.ends
    first, last = int(ends[number - 1]) if number else 0, int(ends[number])

    def pictures() -> Iterator[Picture]:
        depth_mm = depth.steps("depth_mm", first, last)
        rgb = store.steps("rgb", first, last) if "rgb" in store.fields else [None] * len(depth_mm)
        yield from zip(depth_mm, rgb, strict=True)

    action = store.steps("action", first, last)
    assert action.shape[1:] == (ACTION.size,)
    return Episode(
        name=f"episode {number}",
        object_name=names[indices[number]],
        success=True,
        state=store.steps("state", first, last),
        action=action,
        pictures=pictures,
        held=np.zeros(last - first, bool),
        T_world_cam=poses[number],
    )
