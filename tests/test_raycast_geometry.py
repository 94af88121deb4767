"""Ray intersections and normals against values derived by hand."""

import math
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_envs.render import ray_geometry

INF = math.inf
DOWN, FORWARD = (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)

# kind, size, origin, direction, t, normal (None for a miss). t counts lengths of `direction`.
CASES = [
    ("plane", (0, 0, 1), (5, -7, 3), DOWN, 3.0, (0, 0, 1)),
    ("plane", (0, 0, 1), (0, 0, 3), (3, 0, -1), 3.0, (0, 0, 1)),
    ("plane", (0, 0, 1), (0, 0, 3), (0, 0, 1), INF, None),
    ("plane", (0, 0, 1), (0, 0, 3), (1, 0, 0), INF, None),
    ("plane", (0, 0, 1), (0, 0, -3), (0, 0, 1), INF, None),  # seen from above only
    ("plane", (0.5, 1, 1), (0.49, 0.99, 2), DOWN, 2.0, (0, 0, 1)),
    ("plane", (0.5, 1, 1), (0.51, 0, 2), DOWN, INF, None),
    ("plane", (0, 1, 1), (9, 1.01, 2), DOWN, INF, None),  # infinite along x alone
    ("sphere", (0.5, 0, 0), (-2, 0, 0), FORWARD, 1.5, (-1, 0, 0)),
    ("sphere", (0.5, 0, 0), (-2, 0, 0), (2, 0, 0), 0.75, (-1, 0, 0)),
    ("sphere", (0.5, 0, 0), (-2, 0.3, 0), FORWARD, 1.6, (-0.8, 0.6, 0)),  # 3-4-5
    ("sphere", (0.5, 0, 0), (-2, 0.51, 0), FORWARD, INF, None),
    ("sphere", (0.5, 0, 0), (2, 0, 0), FORWARD, INF, None),  # behind
    ("sphere", (0.5, 0, 0), (0, 0, 0), FORWARD, INF, None),  # from inside
    ("sphere", (0, 0, 0), (-2, 0, 0), FORWARD, INF, None),
    ("box", (0.1, 0.2, 0.3), (-1, 0, 0), FORWARD, 0.9, (-1, 0, 0)),
    ("box", (0.1, 0.2, 0.3), (0, 2, 0.1), (0, -1, 0), 1.8, (0, 1, 0)),
    ("box", (0.1, 0.2, 0.3), (0, 0, 1), DOWN, 0.7, (0, 0, 1)),
    ("box", (1, 1, 1), (-2, -1.5, 0), (1, 1, 0), 1.0, (-1, 0, 0)),
    ("box", (0.1, 0.2, 0.3), (-1, 0.21, 0), FORWARD, INF, None),
    ("box", (0.1, 0.2, 0.3), (0, 0, 0), FORWARD, INF, None),
    ("box", (0, 0, 0), (-1, 0, 0), FORWARD, INF, None),
    ("cylinder", (0.5, 1, 0), (-2, 0, 0.9), FORWARD, 1.5, (-1, 0, 0)),
    ("cylinder", (0.5, 1, 0), (-2, 0.3, 0), FORWARD, 1.6, (-0.8, 0.6, 0)),
    ("cylinder", (0.5, 1, 0), (-2, 0, 1.1), FORWARD, INF, None),
    ("cylinder", (0.5, 1, 0), (0.2, 0, 3), DOWN, 2.0, (0, 0, 1)),
    ("cylinder", (0.5, 1, 0), (0.6, 0, 3), DOWN, INF, None),
    ("cylinder", (0.5, 1, 0), (-1, 0, 2), (1, 0, -1), 1.0, (0, 0, 1)),  # enters by the top's centre
    ("cylinder", (0, 0, 0), (-2, 0, 0), FORWARD, INF, None),
    ("capsule", (0.5, 1, 0), (-2, 0, 0.9), FORWARD, 1.5, (-1, 0, 0)),
    ("capsule", (0.5, 1, 0), (-2, 0, 1.3), FORWARD, 1.6, (-0.8, 0, 0.6)),
    ("capsule", (0.5, 1, 0), (-2, 0, -1.3), FORWARD, 1.6, (-0.8, 0, -0.6)),
    ("capsule", (0.5, 1, 0), (0, 0, 4), DOWN, 2.5, (0, 0, 1)),
    ("capsule", (0.5, 1, 0), (0, 0.3, 4), DOWN, 2.6, (0, 0.6, 0.8)),
    ("capsule", (0.5, 1, 0), (-2, 0, 1.51), FORWARD, INF, None),
    ("capsule", (0.5, 1, 0), (0, 0, 0), FORWARD, INF, None),
    ("capsule", (0, 0, 0), (-2, 0, 0), FORWARD, INF, None),
]


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_intersections_and_normals_are_those_derived_by_hand(xp: ModuleType) -> None:
    for kind, size, origin, direction, expected_t, expected_normal in CASES:
        case = f"{kind} {size} from {origin} along {direction}"
        size, origin, direction = (np.float32(v) for v in (size, origin, direction))
        t = ray_geometry.HIT[kind](xp, tuple(origin), tuple(xp.asarray([d]) for d in direction), size)
        assert t.dtype == np.float32, case
        np.testing.assert_allclose(t, [expected_t], atol=1e-5, err_msg=case)
        if expected_normal is not None:
            point = tuple(xp.asarray([o + expected_t * d]) for o, d in zip(origin, direction, strict=True))
            normal = ray_geometry.NORMAL[kind](xp, point, size)
            np.testing.assert_allclose(np.ravel(normal), expected_normal, atol=1e-5, err_msg=case)


@pytest.mark.parametrize("kind", ["sphere", "box", "cylinder", "capsule"])
def test_random_hits_lie_on_the_surface_and_face_the_ray(kind: str) -> None:
    """Signed distance written independently of the intersections, in float64."""
    rng = np.random.default_rng(0)
    size = np.array([0.1, 0.15, 0.2])
    direction = rng.normal(size=(3, 4000))
    origin = rng.uniform(-0.15, 0.15, size=(3, 4000)) - 2 * direction / np.linalg.norm(direction, axis=0)
    t = ray_geometry.HIT[kind](np, tuple(origin), tuple(direction), size)
    hit = np.isfinite(t)
    point = (origin + np.where(hit, t, 0) * direction)[:, hit]
    normal = np.stack(ray_geometry.NORMAL[kind](np, tuple(point), size))
    assert 1000 < hit.sum() < 4000
    np.testing.assert_allclose(_signed_distance(kind, point, size), 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, atol=1e-9)
    assert (np.sum(normal * direction[:, hit], axis=0) < 1e-9).all()
    outside = point + 1e-3 * normal
    np.testing.assert_allclose(_signed_distance(kind, outside, size), 1e-3, atol=1e-9)
    middle = -np.sum(origin * direction, axis=0) / np.sum(direction**2, axis=0)
    closest = origin + middle * direction
    assert (_signed_distance(kind, closest, size)[~hit] > -1e-9).all()


def _signed_distance(kind: str, p: np.ndarray, size: np.ndarray) -> np.ndarray:
    if kind == "sphere":
        return np.linalg.norm(p, axis=0) - size[0]
    if kind == "capsule":
        axis = np.stack([p[0], p[1], np.maximum(abs(p[2]) - size[1], 0)])
        return np.linalg.norm(axis, axis=0) - size[0]
    if kind == "cylinder":
        q = np.stack([np.hypot(p[0], p[1]) - size[0], abs(p[2]) - size[1]])
    else:
        q = abs(p) - size[:, None]
    return np.linalg.norm(np.maximum(q, 0), axis=0) + np.minimum(q.max(axis=0), 0)
