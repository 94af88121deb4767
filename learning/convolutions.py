"""How a CPU computes convolutions: on jaxlib 0.10 by Eigen, which is faster here than the library it prefers.

XLA hands convolutions to YNNPACK there. On two AMD EPYC cores a training step of the student takes 1.3 times
as long with it, of the generator 1.3 to 1.5, drawing generated depth 1.4; the student's forward pass and
PPO's gradient steps as long, to within what was measured twice (`benchmarks/convolutions.py`,
`docs/accelerators.md`).
"""

import importlib.metadata
from importlib.util import find_spec

OPTION = "xla_cpu_experimental_ynn_fusion_type"
"""What YNNPACK computes: nothing, if it is empty."""
_VERSIONS = ("0.10.",)
"""Those of jaxlib on which this was measured; another one may not know the option, and refuses to compile."""


def compiler_options() -> dict[str, str] | None:
    """For `jax.jit` of a program with convolutions; None where an accelerator may be what compiles it."""
    accelerated = any(find_spec(plugin) is not None for plugin in ("jax_plugins", "libtpu"))
    if accelerated or not importlib.metadata.version("jaxlib").startswith(_VERSIONS):
        return None
    return {OPTION: ""}
