"""Shared by all tests: one persistent JAX compilation cache, so that a second run compiles nothing."""

import os
from pathlib import Path

_CACHE = Path(__file__).parents[1] / ".cache" / "jax"

# Through the environment: subprocesses that tests start use the same cache, and JAX is not imported here.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
os.environ.setdefault("WARP_CACHE_PATH", str(_CACHE.with_name("warp")))
os.environ.setdefault("MPLBACKEND", "Agg")
