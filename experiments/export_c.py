"""Exported C code along closed loops: against the controller, against precise plans, beside OSQP's
generated code.

    python experiments/export_c.py [--samples 1000] [--iterations 100]

Needs a C compiler (cc) and, for the rival, osqp and cmake. Both codes run the same number of
iterations with warm starts on the same states, compiled with -O3 in double; OSQP's with its own
defaults for rho, and its termination test off, so that both take a fixed number of steps.
"""

import argparse
import ctypes
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from bench.families import half_widths, problem

import jaxmpc as jm

FLAGS = "-std=c99 -O3 -shared -fPIC".split()


def arm() -> jm.MPC:
    """A planar arm with two equal links, linearised hanging down: q and dq, torques."""
    robot = jm.load_robot("arm2")
    return jm.robot_mpc(robot, np.r_[100.0, 100.0, 1.0, 1.0], [0.1, 0.1], 20)


def compiled(mpc: jm.MPC, solver: jm.ADMM, dtype: str, folder: Path):
    """`step(x) -> (u, status, seconds)` of the exported code, and its bytes (code, data)."""
    jm.export.export_c(mpc, folder, solver, name="law", dtype=dtype, overwrite=True)
    library = folder / f"law_{dtype}.so"
    subprocess.run(["cc", *FLAGS, str(folder / "law.c"), "-lm", "-o", str(library)], check=True)
    size = sizes([library])
    call = ctypes.CDLL(str(library)).law_step
    memory, kind = np.zeros(100_000), np.dtype(dtype)
    u = np.zeros(mpc.system.m, kind)

    def step(x: np.ndarray | None):
        if x is None:
            memory[:] = 0
            return None
        x = np.ascontiguousarray(x, kind)
        at = [ctypes.c_void_p(v.ctypes.data) for v in (memory, x, u)]
        begin = time.perf_counter()
        status = call(at[0], at[1], None, None, at[2], None)
        return u.astype(float), status, time.perf_counter() - begin

    return step, size


def explicit(mpc: jm.MPC, folder: Path):
    """The same for the explicit law: regions and a search tree, nothing solved."""
    regions = jm.explicit.critical_regions(mpc)
    jm.export.export_explicit_c(regions, folder, name="law", overwrite=True)
    text = (folder / "law_sizes.h").read_text().split()
    depth = text[text.index("law_DEPTH") + 1]
    print(f"{'':15}explicit law: {len(regions)} regions, tree of depth {depth}")
    library = folder / "law.so"
    subprocess.run(["cc", *FLAGS, str(folder / "law.c"), "-lm", "-o", str(library)], check=True)
    call, u = ctypes.CDLL(str(library)).law_evaluate, np.zeros(mpc.system.m)

    def step(x: np.ndarray | None):
        if x is None:
            return None
        at = [ctypes.c_void_p(v.ctypes.data) for v in (np.ascontiguousarray(x), u)]
        begin = time.perf_counter()
        status = call(*at)
        return u.copy(), status, time.perf_counter() - begin

    return step, sizes([library])


def sizes(files: list[Path]) -> tuple[int, int]:
    """Bytes of code, and of constant and changing data, by `size -A`."""
    code = data = 0
    for file in files:
        out = subprocess.run(["size", "-A", str(file)], capture_output=True, text=True, check=True)
        for line in out.stdout.splitlines():
            parts = line.split()
            if len(parts) >= 2 and parts[0].startswith("."):
                code += int(parts[1]) * parts[0].startswith(".text")
                data += int(parts[1]) * parts[0].startswith((".rodata", ".data", ".bss"))
    return code, data


def osqp_code(mpc: jm.MPC, iterations: int, folder: Path):
    """The same for OSQP's generated code; the condensed QP in its own units."""
    import osqp
    from scipy import sparse

    with jax.enable_x64(True):
        controller = jm.Controller(mpc, jm.ADMM(iterations=iterations, newton_steps=0))
        c = jax.tree.map(np.asarray, controller.condensed)
    moved = np.abs(c.C).max(axis=1) > 0
    C, D, d = c.C[moved], c.D[moved], c.d[moved]
    lower, upper = c.lower[moved], c.upper[moved]
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(np.triu(c.P)), c.f, sparse.csc_matrix(C), lower - d, upper - d,
        max_iter=iterations, check_termination=0, adaptive_rho=0, verbose=False, warm_starting=True,
    )  # fmt: skip
    solver.codegen(str(folder), parameters="vectors", extension_name="rival", force_rewrite=True)
    sources = [*folder.glob("*.c"), *folder.glob("src/*.c")]
    sources = [s for s in sources if s.name not in ("emosqp.c", "example.c", "rivalmodule.c")]
    library = folder / "rival.so"
    # Functions with types that ctypes can call.
    glue = folder / "glue.c"
    glue.write_text(GLUE)
    includes = [
        "-I",
        str(folder / "inc/public"),
        "-I",
        str(folder / "inc/private"),
        "-I",
        str(folder),
    ]
    subprocess.run(
        ["cc", "-O3", "-shared", "-fPIC", *includes, *map(str, {*sources, glue}), "-lm", "-o",
         str(library)],
        check=True, capture_output=True,
    )  # fmt: skip
    lib = ctypes.CDLL(str(library))
    lib.rival_solution.restype = ctypes.c_void_p
    at = lambda v: ctypes.c_void_p(v.ctypes.data)
    nz = len(c.f)

    def step(x: np.ndarray | None):
        if x is None:
            return None
        q, l, u = c.F @ x + c.f, lower - D @ x - d, upper - D @ x - d
        begin = time.perf_counter()
        lib.rival_step(at(q), at(l), at(u))
        seconds = time.perf_counter() - begin
        z = np.ctypeslib.as_array(
            ctypes.cast(lib.rival_solution(), ctypes.POINTER(ctypes.c_double)), (nz,)
        )
        first = c.Psi[0] @ x + c.Omega[0] @ z + c.psi[0]
        return np.clip(first, mpc.inputs.lower, mpc.inputs.upper), 0, seconds

    return step, sizes([library])


GLUE = """
#include "osqp.h"
#include "workspace.h"
void rival_step(double *q, double *l, double *u) {
  osqp_update_data_vec(&solver, q, l, u);
  osqp_solve(&solver);
}
double *rival_solution(void) { return solver.solution->x; }
"""


def starts_of(mpc: jm.MPC, half: np.ndarray, count: int) -> np.ndarray:
    """Random states with a plan."""
    states = np.random.default_rng(0).uniform(-half, half, (40 * count, len(half)))
    with jax.enable_x64(True):
        solved = np.asarray(jm.solve_many(mpc, states).status) == jm.Status.SOLVED
    return states[solved][:count]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--iterations", type=int, default=100)
    given = parser.parse_args()
    solver = jm.ADMM(iterations=given.iterations, newton_steps=0)
    arm_limits = np.asarray(arm().states.upper)
    systems = {
        "joint": (joint := problem("joint"), half_widths(joint)),
        "springs, n = 8": (springs := problem("springs8"), half_widths(springs)),
        "two-link arm": (arm(), 0.5 * arm_limits),
    }
    print("system       code            |u - law|  |u - plan|  mean us  worst us  code B   data B")
    for name, (mpc, half) in systems.items():
        starts = starts_of(mpc, half, 20)
        length = given.samples // 20
        with tempfile.TemporaryDirectory() as base, jax.enable_x64(True):
            law, precise = jm.Controller(mpc, solver), jm.Controller(mpc)
            A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
            c = 0 if mpc.system.c is None else np.asarray(mpc.system.c)
            states, laws, plans, good = [], [], [], []
            for x in starts:
                control = best = None
                for _ in range(length):
                    control, best = law(x, control), precise(x, best)
                    u, v = np.asarray(control.u), np.asarray(best.u)
                    states.append(x), laws.append(u), plans.append(v)
                    good.append(int(best.plan.status) == jm.Status.SOLVED)
                    x = A @ x + B @ u + c
            good = np.array(good)
            codes = {}
            for dtype in ("float64", "float32"):
                (folder := Path(base, dtype)).mkdir()
                codes[f"jaxmpc {dtype}"] = compiled(mpc, solver, dtype, folder)
            try:
                codes["OSQP"] = osqp_code(mpc, given.iterations, Path(base, "osqp"))
            except (ImportError, subprocess.CalledProcessError) as error:
                print(f"{name}: no code of OSQP: {error}", getattr(error, "stderr", b"")[-500:])
            if mpc.dimension == 2:  # few regions; springs and arm have too many
                (folder := Path(base, "explicit")).mkdir()
                codes["explicit law"] = explicit(mpc, folder)
            for label, (step, (code, data)) in codes.items():
                best_times = np.full(len(states), np.inf)
                for _ in range(5):  # the least of five: other processes interrupt
                    inputs = []
                    for k, x in enumerate(states):
                        if k % length == 0:
                            step(None)
                        u, _, seconds = step(x)
                        inputs.append(u)
                        best_times[k] = min(best_times[k], seconds)
                error = np.abs(np.array(inputs) - np.array(laws)).max()
                off = np.abs(np.array(inputs) - np.array(plans))[good].max()
                law_error = f"{error:9.1e}" if label.startswith("jaxmpc") else "        -"
                print(
                    f"{name:<15}{label:<15} {law_error} {off:10.1e} {1e6 * best_times.mean():9.1f}"
                    f" {1e6 * best_times.max():8.1f} {code:8d} {data:9d}", flush=True,
                )  # fmt: skip
            print(f"{'':15}{good.sum()} of {len(good)} states have a plan")


if __name__ == "__main__":
    main()
