"""A controller as a stored program of JAX (StableHLO), for other processes, languages and years."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxmpc.checks import fail, require_kind, require_package, require_untraced
from jaxmpc.export.c_files import GIVE_PROBLEM, prepared_paths
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM

PLATFORMS = ("cpu", "cuda")
KNOWN = (*PLATFORMS, "rocm", "tpu")


def export_jax(
    mpc: MPC,
    path: str | Path,
    solver: ADMM | None = None,
    *,
    dtype: str = "float64",
    platforms: tuple[str, ...] = PLATFORMS,
    overwrite: bool = False,
) -> Path:
    """Write the plans of a batch of any size from 1 on as one file that needs jax alone to run.

        program = jax.export.deserialize(path.read_bytes())
        plan = program.call(x0s, references, input_references)

    x0s (b, n), then the states (b, n) and inputs (b, m) to track, constant over the horizon, and,
    where the problem limits or weighs input rates, the previous inputs (b, m): arrays of `dtype`
    (with "float64" call it under `jax.enable_x64(True)`). The result is a dictionary of states
    (b, N+1, n), inputs (b, N, m), slack, cost, status and the two residuals (b,), as in the `Plan`
    of `solve`. The instances of a batch take their Newton steps together, in one
    group. JAX promises that later releases read the file for at least six months.

    platforms: on which the file runs: of cpu, cuda, rocm, tpu. Returns the path. Raises ValueError
    for an invalid problem and a file that exists, unless overwrite; ImportError without flatbuffers
    (the extra `export`).
    """
    require_package("flatbuffers", "export")
    require_kind("mpc", mpc, MPC, cure=GIVE_PROBLEM)
    require_untraced("mpc", mpc)
    solver, path = ADMM() if solver is None else solver, Path(path)
    require_kind("solver", solver, ADMM)
    if dtype not in ("float64", "float32"):
        fail("dtype", f"{dtype!r}", 'Give "float64" or "float32"')
    if isinstance(platforms, str) or not platforms or not set(platforms) <= set(KNOWN):
        cure = f"Give a tuple of some of {', '.join(map(repr, KNOWN))}, such as ('cpu',)"
        fail("platforms", f"{platforms!r}", cure)
    try:
        jax.devices("cpu")
    except RuntimeError:
        fail("JAX_PLATFORMS", f"only {jax.default_backend()}", "Add the platform cpu to it")
    (path,) = prepared_paths(path.parent, [path.name], overwrite)
    n, m = mpc.system.n, mpc.system.m

    def plan(x0: Any, reference: Any, input_reference: Any, *previous: Any) -> dict[str, Any]:
        found = controller.plan(x0, reference, None, input_reference, *previous)
        names = ("states", "inputs", "slack", "cost", "status", "primal_residual", "dual_residual")
        return {name: getattr(found, name) for name in names}

    with jax.enable_x64(dtype == "float64"):
        mpc = jax.tree.map(lambda v: jnp.asarray(v, dtype), mpc)
        controller = Controller(mpc, solver)
        (b,) = jax.export.symbolic_shape("b")
        sizes = (n, n, m, m) if mpc.input_in_state else (n, n, m)
        given = [jax.ShapeDtypeStruct((b, size), dtype) for size in sizes]
        # As for a CPU: kernels for GPUs are neither of any size of batch nor for other platforms.
        with jax.default_device("cpu"):
            program = jax.export.export(jax.jit(jax.vmap(plan)), platforms=platforms)(*given)
    path.write_bytes(program.serialize())
    return path
