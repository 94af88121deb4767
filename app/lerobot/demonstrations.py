"""Demonstrations of a run (`demos/episodes.zarr`) as episodes."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from app.lerobot.episode import Episode, Picture, Source
from ddgrasp import artifacts, contract
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.layout import ACTION
from demos.store import EpisodeStore

STORE, STAGE = "episodes.zarr", "demos"
"""As `demos.stage` names them, which imports JAX."""


def find(path: Path) -> Path | None:
    """The stage's folder, where `path` is it, a run that has it, or the store in it; None elsewhere."""
    places = (path, path / STAGE, path.parent if path.name == STORE else path)
    return next((place for place in places if (place / STORE / "zarr.json").exists()), None)


def read(folder: Path, objects: Sequence[str] = ()) -> Source:
    """The episodes of the stage in `folder`, of the named `objects` alone if there are any.

    Raises:
      UserError: the stage is not finished, its store is damaged, or an object is none of its own.
    """
    manifest = artifacts.read_manifest(folder)
    config = artifacts.config_from_json(manifest.config)
    names = config.world.objects
    for name in objects:
        if name not in names:
            raise unknown_name("object", name, names)
    store = EpisodeStore(folder / STORE)
    indices = store.episodes("object_index").tolist()
    taken = [i for i, index in enumerate(indices) if not objects or names[index] in objects]
    if not taken:
        raise UserError(f"{folder} has no episode with {' or '.join(objects)}: choose others of {names}.")
    width, height = config.world.profile.width_px, config.world.profile.height_px
    noise = f"standard deviation {config.demos.action_noise:g}" if config.demos.noise_share else "none"
    about = {
        "Robot": "Franka Emika Panda with its hand, simulated in MuJoCo MJX.",
        "Camera": f"An ideal one with a RealSense D455's view, {width} x {height}, fixed across the table; "
        "its depth is clean: no holes, no noise.",
        "How it was made": f"A policy that sees the simulator's state, trained by PPO, grasped {len(names)} "
        "objects; episodes that failed were thrown away. In some steps its joint steps were disturbed "
        f"({noise}); `action` is what it asked for, not the disturbed step, so that recoveries are labelled.",
    }
    poses = store.episodes("T_world_cam")
    read_one = partial(_read, store, names, indices, poses)
    return Source("demonstrations", contract.PANDA.name, about, [partial(read_one, i) for i in taken])


def _read(
    store: EpisodeStore, names: Sequence[str], indices: Sequence[int], poses: np.ndarray, number: int
) -> Episode:
    ends = store.ends
    first, last = int(ends[number - 1]) if number else 0, int(ends[number])

    def pictures() -> Iterator[Picture]:
        depth_mm = store.steps("depth_mm", first, last)
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
