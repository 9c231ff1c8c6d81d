"""The explicit law as C code, compiled and called, beside the regions and the solver."""

import ctypes
import shutil
import subprocess
from dataclasses import replace

import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.export import export_explicit_c

CC, CXX = map(shutil.which, ("cc", "c++"))
AS_CPP = "-x c++ -std=c++11 -Wall -Wextra -Wpedantic -Werror -fsyntax-only".split()
compiled = pytest.mark.skipif(CC is None, reason="there is no C compiler")


def built(regions, folder, dtype="float64", **options):
    """Return x → (u, status) of the compiled law."""
    export_explicit_c(regions, folder, dtype=dtype, **options)
    strict = "-std=c99 -O2 -Wall -Wextra -Wpedantic -Werror -shared -fPIC".split()
    library = folder / f"{dtype}.so"
    subprocess.run([CC, *strict, folder / "law.c", "-lm", "-o", library], check=True)
    if CXX is not None:
        subprocess.run([CXX, *AS_CPP, folder / "law.c"], check=True)
    call, m = ctypes.CDLL(str(library)).law_evaluate, regions.mpc.system.m

    def law(x):
        x, u = np.ascontiguousarray(x, dtype), np.zeros(m, dtype)
        status = call(*(v.ctypes.data_as(ctypes.c_void_p) for v in (x, u)))
        return u, status

    return law


@pytest.fixture(scope="module")
def regions():
    return jm.explicit.critical_regions(problems.joint_o_inf(6))


@pytest.mark.long
@compiled
@pytest.mark.parametrize("dtype, error", [("float64", 1e-9), ("float32", 2e-4)])
def test_every_state_has_the_input_of_its_region(regions, tmp_path, dtype, error):
    """Random states in and around the feasible set, and the vertices of all regions."""
    law = built(regions, tmp_path, dtype)
    points = np.concatenate([r.vertices for r in regions.regions])
    lower, upper = points.min(axis=0), points.max(axis=0)
    x = np.random.default_rng(0).uniform(1.2 * lower, 1.2 * upper, (4000, 2))
    wanted = regions.law(x)
    for state, u in zip(x, wanted, strict=True):
        found, status = law(state)
        near = np.min(np.abs(np.concatenate([
            np.asarray(r.polytope.H) @ state - np.asarray(r.polytope.h) for r in regions.regions
        ])))  # fmt: skip
        if near > 1e-5:  # elsewhere rounding may choose the other region
            assert status == (2 if np.isnan(u[0]) else 1)
        if status == 1 and not np.isnan(u[0]):
            np.testing.assert_allclose(found, u, rtol=0, atol=error)
        assert abs(found[0]) <= 2
    for vertex in points:
        assert law(vertex)[1] == 1
    assert law([np.nan, 0.0]) == (0, 3)


@compiled
@pytest.mark.parametrize("dtype, error", [("float64", 1e-9), ("float32", 2e-4)])
@pytest.mark.long
def test_where_many_facets_meet(tmp_path, dtype, error):
    """Rounding gives signs there that fit no region, and led to a leaf far away."""
    A = np.array([[1.0, 1, 1], [0, 1, 1], [0, 0, 1]])
    B = np.array([[-0.6, -0.8], [-1.7, -0.4], [0.9, 0.2]])
    states = jm.Box([-1.8, -1.4, -2.7], [1.8, 1.4, 2.7])
    mpc = jm.MPC(
        jm.LinearSystem(A, B), np.eye(3), 0.1 * np.eye(2), 3, terminal_cost=np.eye(3),
        states=states, inputs=jm.Box([-0.3] * 2, [0.3] * 2), terminal_set=states,
    )  # fmt: skip
    regions = jm.explicit.critical_regions(mpc)
    law, points = built(regions, tmp_path, dtype), [r.vertices for r in regions.regions]
    for vertex, u in zip(np.vstack(points), regions.law(np.vstack(points)), strict=True):
        found, status = law(vertex)
        assert status == 1
        np.testing.assert_allclose(found, u, rtol=0, atol=error)


@pytest.mark.long
@compiled
def test_a_law_in_other_units(regions, tmp_path):
    """The code is that of the plain problem, also where states' units are far apart."""
    mpc, random = regions.mpc, np.random.default_rng(0)
    points = np.concatenate([r.vertices for r in regions.regions])
    inside = [random.dirichlet(np.ones(len(r.vertices)), 20) @ r.vertices for r in regions.regions]
    extent = np.ptp(points, axis=0)
    states = np.concatenate([*inside, 0.6 * random.uniform(-extent, extent, (500, 2))])
    sides = [np.asarray(r.polytope.H) @ states.T - np.asarray(r.polytope.h)[:, None]
             for r in regions.regions]  # fmt: skip
    states = states[np.min(np.abs(np.concatenate(sides)), axis=0) > 1e-5]
    plain = built(regions, tmp_path)
    wanted = [plain(x) for x in states]
    for i, x in enumerate(2.0 ** np.array([[-40, -40], [30, 30], [-25, 25], [25, -25]])):
        scaled = replace(
            mpc, system=jm.LinearSystem(x[:, None] * mpc.system.A / x, x[:, None] * mpc.system.B),
            Q=mpc.Q / x / x[:, None], terminal_cost=mpc.terminal_cost / x / x[:, None],
            states=jm.Box(x * mpc.states.lower, x * mpc.states.upper),
            terminal_set=jm.Polytope(mpc.terminal_set.H / x, mpc.terminal_set.h),
        )  # fmt: skip
        folder = tmp_path / str(i)
        folder.mkdir()
        law = built(jm.explicit.critical_regions(scaled), folder)
        for state, (u, status) in zip(states, wanted, strict=True):
            found, said = law(x * state)
            assert said == status
            np.testing.assert_allclose(found, u, rtol=0, atol=1e-9)


@compiled
@pytest.mark.parametrize("dtype, error", [("float64", 1e-9), ("float32", 2e-4)])
def test_a_law_far_from_the_origin(tmp_path, dtype, error):
    """Kelvin, world coordinates: sums about 0 in float32 are wrong by 1e-4, here by 1e-7 of X_N."""
    home, A = np.array([300.0, -80.0]), np.array([[1.0, 0.1], [0.0, 1.0]])
    system = jm.LinearSystem(A, [[0.005], [0.1]], c=home - A @ home)
    limits = jm.Box(home - [1.0, 2.0], home + [1.0, 2.0])
    mpc = jm.MPC(system, np.eye(2), [[0.1]], 4, limits, jm.Box([-5.0], [5.0]))
    regions = jm.explicit.critical_regions(mpc, reference=home)
    law = built(regions, tmp_path, dtype)
    points = np.concatenate([r.vertices for r in regions.regions])
    lower, upper = points.min(axis=0), points.max(axis=0)
    x = np.random.default_rng(0).uniform(lower, upper, (300, 2)).astype(dtype)
    wanted = regions.law(x.astype(float))
    facets, offsets, _ = regions.facets
    unit = np.linalg.norm(facets, axis=1)
    near = np.min(np.abs(facets @ x.T - offsets[:, None]) / unit[:, None], axis=0)
    for state, u, far in zip(x, wanted, near > 1e-4, strict=True):
        found, status = law(state)
        if far:  # elsewhere rounding may choose the other region
            assert status == (2 if np.isnan(u[0]) else 1)
        if status == 1 and not np.isnan(u[0]):
            np.testing.assert_allclose(found, u, rtol=0, atol=error)


@compiled
@pytest.mark.slow
def test_closed_loop_is_the_solvers(tmp_path):
    """With previous inputs in the state: as many numbers as the problem has parameters."""
    system = jm.LinearSystem([[1.0, 0.2], [0.0, 1.0]], [[0.0], [0.2]])
    mpc = jm.MPC(
        system, np.eye(2), [[0.1]], 4, jm.Box([-1.0, -1.0], [1.0, 1.0]), jm.Box([-1.0], [1.0]),
        input_rate_limit=0.5,
    )  # fmt: skip
    law = built(jm.explicit.critical_regions(mpc), tmp_path)
    x, u = np.array([0.8, 0.3]), np.zeros(1)
    with jax.enable_x64(True):
        for _ in range(6):
            plan = jm.solve(mpc, x, previous_input=u)
            found, status = law(np.concatenate([x, u]))
            assert status == 1
            np.testing.assert_allclose(found, plan.inputs[0], rtol=0, atol=1e-7)
            x, u = np.asarray(system.A) @ x + np.asarray(system.B) @ found, found


def test_bad_input(regions, tmp_path):
    with pytest.raises(ValueError, match="regions: are not all of the law.*export_c, --law steps"):
        export_explicit_c(replace(regions, complete=False, reason="stopped"), tmp_path)
    with pytest.raises(ValueError, match="name: '2x'"):
        export_explicit_c(regions, tmp_path, name="2x")
    export_explicit_c(regions, tmp_path)
    with pytest.raises(ValueError, match=r"law\.h: exists"):
        export_explicit_c(regions, tmp_path)
    export_explicit_c(regions, tmp_path, overwrite=True)
