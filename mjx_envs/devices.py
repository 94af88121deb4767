"""One mesh over all devices of all hosts; its only axis is environments.

Environments never talk to each other, so each device steps its own share, physics backends that are host
callbacks or foreign kernels included; what learns from all of them is left to XLA's partitioner.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

ENVS = "envs"
"""Name of the mesh's axis."""


def make_mesh() -> Mesh:
    """A mesh of every device that JAX sees, on all hosts."""
    return Mesh(np.array(jax.devices()), (ENVS,), axis_types=(AxisType.Auto,))


def over_envs(mesh: Mesh, axis: int = 0) -> NamedSharding:
    """Arrays whose `axis` counts environments, a share of them on each device."""
    return NamedSharding(mesh, PartitionSpec(*[None] * axis, ENVS))


def replicated(mesh: Mesh) -> NamedSharding:
    """Arrays of which every device has the whole."""
    return NamedSharding(mesh, PartitionSpec())


def each(mesh: Mesh, function: Callable) -> Callable:
    """`function` of one environment for a batch, whose size must be a multiple of the mesh's.

    Like `jax.vmap(function)`, but every device calls it on its own share and nothing is communicated.
    """
    spec = PartitionSpec(ENVS)
    return jax.shard_map(jax.vmap(function), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)


def shard_index() -> jax.Array:
    """() int32 which share the traced code works on; -1 outside of `each`, where it works on the whole."""
    axes = jax.sharding.get_abstract_mesh().manual_axes
    return jax.lax.axis_index(axes) if axes else jnp.int32(-1)
