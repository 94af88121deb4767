"""How a CPU computes convolutions: on jaxlib 0.10 by Eigen, which is faster here than the library it prefers.

XLA hands convolutions to YNNPACK there. In turns in one process, two AMD EPYC cores beside a training: a
training step of the student takes 1.33 times as long with it, of the generator 1.33, drawing six evaluations
1.45 (`docs/accelerators.md`); the student's forward pass as long, PPO's gradient steps a little less long.
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
