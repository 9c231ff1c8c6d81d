"""Runs before any test module, hence before jax is imported: settings of JAX for tests.

Most of the time of a test goes into compiling programs that run once: LLVM's optimisations are off,
which halves that. `JAX_DISABLE_MOST_OPTIMIZATIONS=0 pytest` runs the tests on optimised programs.

A CPU bug of old jaxlibs: from 0.7.0 until 0.11.1, XLA's fusion emitters recompute long chains of
small operations again and again (a step of a 7-joint robot is 500 times slower). The flag is
unknown to later versions, which abort on it. And one thread for OpenBLAS, whose threads wait for
each other on busy cores. The library itself never touches the environment.
"""

import gc
import os
import re
from importlib.metadata import version

import pytest

_jaxlib = tuple(int(part) for part in re.findall(r"\d+", version("jaxlib"))[:3])
if (0, 7, 0) <= _jaxlib < (0, 11, 1):
    _flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{_flags} --xla_cpu_use_fusion_emitters=false".strip()
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Compiled programs keep memory maps, of which a process may have 65,530."""
    yield
    import jax

    jax.clear_caches()
    gc.collect()
