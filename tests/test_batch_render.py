"""The renderers of batches against MuJoCo's OpenGL and the ray caster in NumPy, with all twelve objects."""

import jax
import numpy as np
import pytest

from ddgrasp.errors import UserError
from mjx_envs import scene
from mjx_envs.render import batch_render, render_check

COUNT = 12


@pytest.fixture(scope="module")
def scenes():
    return render_check.random_scenes(COUNT)


def make_renderer(name, scenes, **options):
    """Warp on its CPU device where there is no GPU."""
    if name == "warp":
        return batch_render.warp_renderer(scenes.camera, **options)
    return batch_render.make_renderer(name, scenes.camera, **options)


@pytest.fixture(scope="module")
def renderers(scenes):
    """Name -> the renderer of whole pictures, compiled once."""
    return {name: jax.jit(make_renderer(name, scenes)) for name in batch_render.RENDERERS}


@pytest.mark.parametrize("name", batch_render.RENDERERS)
def test_pictures_agree_with_open_gl(name, scenes, renderers, open_gl):
    expected = render_check.draw_with_open_gl(scenes, open_gl)
    seen = renderers[name](scenes.geoms, scenes.T_world_cam)
    measures = render_check.compare(seen, expected)
    print(name, {key: f"{value:.2g}" for key, value in measures.items()})
    assert render_check.violations(measures) == []
    slots = scene.slot_ids(scene.build_model(layout=scenes.table.layout))
    assert np.isin(expected.segmentation, slots).any(axis=(1, 2)).mean() > 0.8  # objects are in view


@pytest.mark.parametrize("name", batch_render.RENDERERS)
def test_pictures_agree_with_numpy(name, scenes, renderers):
    expected = render_check.draw_with_numpy(scenes)
    seen = renderers[name](scenes.geoms, scenes.T_world_cam)
    assert render_check.violations(render_check.compare(seen, expected)) == []


@pytest.mark.parametrize("name", batch_render.RENDERERS)
def test_depth_alone_is_the_same_depth(name, scenes, renderers):
    whole = renderers[name](scenes.geoms, scenes.T_world_cam)
    alone = jax.jit(make_renderer(name, scenes, depth_only=True))(scenes.geoms, scenes.T_world_cam)
    assert alone.rgb is None and alone.segmentation is None
    assert np.mean(np.abs(alone.depth_m - whole.depth_m) > 2e-5) < 5e-4
    near = jax.jit(make_renderer(name, scenes, depth_only=True, far_m=0.8))(scenes.geoms, scenes.T_world_cam)
    assert 0 < float(near.depth_m.max()) <= 0.8 < float(alone.depth_m.max())


def test_a_picture_that_is_off_is_found(scenes, renderers):
    """The check can fail: another camera's pictures, another geom, another light."""
    renderer = renderers["jax"]
    seen = jax.tree.map(np.asarray, renderer(scenes.geoms, scenes.T_world_cam))
    assert render_check.violations(render_check.compare(seen, seen)) == []
    nearer = scenes.T_world_cam.copy()
    nearer[:, :3, 3] += 0.02 * nearer[:, :3, 2]
    assert {"median_depth_error_m", "depth_off_by_5_mm"} <= _beyond(renderer(scenes.geoms, nearer), seen)
    assert _beyond(seen._replace(segmentation=seen.segmentation + 1), seen) == {"other_geom"}
    assert _beyond(seen._replace(rgb=seen.rgb * 0.8), seen) == {"mean_colour_error"}


def _beyond(ours, expected):
    """Names of the measures beyond their limits."""
    return {line.split()[0] for line in render_check.violations(render_check.compare(ours, expected))}


def test_unknown_renderers_and_warp_without_a_gpu_are_refused(scenes):
    with pytest.raises(UserError, match="'wrap'.*Did you mean 'warp'"):
        batch_render.make_renderer("wrap", scenes.camera)
    if any(device.platform == "gpu" for device in jax.devices()):
        pytest.skip("this machine has a GPU")
    with pytest.raises(UserError, match="needs an NVIDIA GPU"):
        batch_render.make_renderer("warp", scenes.camera)
