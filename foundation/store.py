"""Converted weights on disk: a folder per network with an Orbax checkpoint and a manifest, written last.

`manifest.json` says which published file the numbers came from (its SHA-256), under which licence, and which
network they belong to. Reading it needs no JAX.
"""

import hashlib
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_json, read_json, replaced_folder
from ddgrasp.versions import library_versions
from foundation import catalog

MANIFEST = "manifest.json"
CHECKPOINT = "variables"
WEIGHTS_DIR = Path("weights")
"""Where converted weights go and are looked for, unless told otherwise."""
FORMAT_VERSION = 1


@dataclass(frozen=True)
class WeightsManifest:
    """Where converted weights came from."""

    network: str
    """A name of foundation/catalog.py."""
    source_file: str
    source_sha256: str
    licence: str
    published: str
    parameters: int
    """How many numbers."""
    versions: dict[str, str]
    created: str
    """UTC time of the conversion."""
    format_version: int = FORMAT_VERSION

    def summary(self) -> dict[str, str]:
        """What reports say about weights that were used."""
        return {"network": self.network, "source_sha256": self.source_sha256, "licence": self.licence}


BUILT_IN = "built-in"
"""What reports say where no published weights were used."""


def convert_file(file: Path, weights_dir: Path = WEIGHTS_DIR) -> Path:
    """Converts a published checkpoint into a folder of `weights_dir`, which is returned.

    An earlier conversion of the same network is replaced once the new one is complete.

    Raises UserError for a file that is damaged or does not fit a known network, or where other files are.
    """
    from foundation.checkpoint_files import read_checkpoint
    from foundation.convert import convert, recognise

    arrays = read_checkpoint(file)
    network = recognise({key: tuple(array.shape) for key, array in arrays.items()})
    _check_place(weights_dir / network)
    _check_version(file, network)
    _check_relative(file, network)
    variables = convert(network, arrays)
    entry = catalog.get_entry(network)
    with file.open("rb") as opened:
        digest = hashlib.file_digest(opened, "sha256")
    manifest = WeightsManifest(
        network=network,
        source_file=file.name,
        source_sha256=digest.hexdigest(),
        licence=entry.licence,
        published=entry.published,
        parameters=_count(variables["params"]),
        versions=library_versions(),
        created=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    )
    with replaced_folder(weights_dir / network) as folder:
        _save(folder / CHECKPOINT, variables)
        atomic_write_json(folder / MANIFEST, asdict(manifest))
    return weights_dir / network


def _check_place(folder: Path) -> None:
    """UserError if an earlier conversion is not all that is there: it would go away with it."""
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if others := sorted(names - {MANIFEST, CHECKPOINT}):
        raise UserError(
            f"{folder} holds {others[0]}, which is no part of converted weights and would be deleted: move "
            "it, or give another --out."
        )


def read_manifest(directory: Path) -> WeightsManifest:
    """The manifest of converted weights; UserError, with the remedy, if there are none."""
    path = directory / MANIFEST
    if not path.exists():
        raise UserError(
            f"{directory} holds no converted weights: get a file that `ddgrasp weights list` names and run "
            "`ddgrasp weights convert FILE`."
        )
    value = read_json(path)
    if isinstance(value, dict) and value.pop("max_depth_m", 0):  # 0 in those that were written before
        raise UserError(
            f"{directory} holds weights for metric depth, which nothing uses: convert the file that "
            "`ddgrasp weights list` names."
        )
    names = {field.name for field in fields(WeightsManifest)}
    if not isinstance(value, dict) or value.keys() != names or value["format_version"] != FORMAT_VERSION:
        raise UserError(f"{path} was written by another version of this project: convert the weights again.")
    return WeightsManifest(**value)


def manifest_of(directory: Path, families: tuple[str, ...]) -> WeightsManifest:
    """`read_manifest` of weights that `load` takes; UserError if they are of another network."""
    manifest = read_manifest(directory)
    if families and not any(manifest.network.startswith(family) for family in families):
        raise UserError(f"{directory} holds weights of {manifest.network}; expected {' or '.join(families)}.")
    return manifest


def load(directory: Path, families: tuple[str, ...] = ()) -> tuple[WeightsManifest, dict[str, Any]]:
    """Manifest and Flax variables (NumPy float32) of converted weights.

    Args:
      families: networks, or families of depth networks, of which it must be one; any if empty.

    Raises UserError if there are none, of another network, or damaged.
    """
    from foundation.convert import variable_shapes

    manifest = manifest_of(directory, families)
    return manifest, _restore(directory / CHECKPOINT, variable_shapes(manifest.network))


def installed(weights_dir: Path = WEIGHTS_DIR) -> dict[str, WeightsManifest]:
    """Folder name, which is the network's -> manifest that can be read."""
    return {name: read for name, read in _folders(weights_dir).items() if isinstance(read, WeightsManifest)}


def unreadable(weights_dir: Path = WEIGHTS_DIR) -> dict[str, str]:
    """Name of each other folder of weights -> what is wrong with its manifest, and the remedy."""
    return {name: str(read) for name, read in _folders(weights_dir).items() if isinstance(read, UserError)}


def _folders(weights_dir: Path) -> dict[str, WeightsManifest | UserError]:
    found: dict[str, WeightsManifest | UserError] = {}
    for path in sorted(weights_dir.glob(f"[!.]*/{MANIFEST}")):
        try:
            found[path.parent.name] = read_manifest(path.parent)
        except UserError as error:
            found[path.parent.name] = error
    return found


def _check_version(file: Path, network: str) -> None:
    """Depth Anything's first version has the same arrays as its second, and reads other layers of them."""
    if network.startswith(catalog.IMAGE_DEPTH) and file.name.startswith("depth_anything_vit"):
        raise UserError(
            f"{file.name} looks like a model of Depth Anything's first version, which is another network: "
            f"take {catalog.get_entry(network).file}."
        )


def _check_relative(file: Path, network: str) -> None:
    """Weights for metric depth have the same arrays as those for relative depth, and give something else."""
    if "metric" in file.name and network.startswith((catalog.IMAGE_DEPTH, catalog.VIDEO_DEPTH)):
        raise UserError(
            f"{file.name} looks like a model of metric depth, which is not supported: take "
            f"{catalog.get_entry(network).file}."
        )


def _save(path: Path, variables: dict[str, Any]) -> None:
    import orbax.checkpoint as ocp

    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.absolute(), variables)


def _restore(path: Path, shapes: dict[str, Any]) -> dict[str, Any]:
    import jax
    import numpy as np
    import orbax.checkpoint as ocp

    target = jax.tree.map(lambda leaf: np.empty(leaf.shape, np.float32), shapes)
    try:
        with ocp.StandardCheckpointer() as checkpointer:
            variables = checkpointer.restore(path.absolute(), target)
    except (ValueError, FileNotFoundError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{path} is damaged ({reason}): convert the weights again.") from None
    wrong = jax.tree.map(lambda leaf, wanted: leaf.shape != wanted.shape, variables, shapes)
    if any(jax.tree.leaves(wrong)):
        raise UserError(f"{path} has arrays of other shapes than the network: convert the weights again.")
    return variables


def _count(tree: dict[str, Any]) -> int:
    return sum(_count(value) if isinstance(value, dict) else int(value.size) for value in tree.values())
