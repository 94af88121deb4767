"""What convolutions are computed by: Eigen on a CPU with jaxlib 0.10, what XLA chooses anywhere else."""

import importlib.metadata

import jax
import jax.numpy as jnp
import pytest

from learning import convolutions


def test_no_convolution_is_left_to_the_slower_library():
    if (options := convolutions.compiler_options()) is None:
        pytest.skip("this jaxlib is not 0.10, or compiles for an accelerator")
    picture, kernel = jnp.ones((16, 28, 36, 64)), jnp.ones((3, 3, 64, 64))

    def convolve(x, w):
        return jax.lax.conv_general_dilated(x, w, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))

    compiled = jax.jit(convolve, compiler_options=options).lower(picture, kernel).compile()
    assert "ynn_fusion" not in compiled.as_text()


@pytest.mark.parametrize(
    ("version", "plugin"), [("0.12.0", None), ("0.10.2", "jax_plugins"), ("0.10.2", "libtpu")]
)
def test_other_versions_and_accelerators_are_left_alone(monkeypatch, version, plugin):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    monkeypatch.setattr(convolutions, "find_spec", lambda name: name if name == plugin else None)
    assert convolutions.compiler_options() is None


def test_a_cpu_with_that_version_is_told(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.10.2")
    monkeypatch.setattr(convolutions, "find_spec", lambda name: None)
    assert convolutions.compiler_options() == {convolutions.OPTION: ""}
