"""JAX's modes × public functions: results are those of the mode that the library uses itself.

A CPU counts as several devices only where a flag says so before JAX is imported: `shard_map` and
meshes are tried in a process of their own.
"""

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jaxmpc as jm
from jaxmpc.mpc import NonlinearMPC, Task, solve_nonlinear, solve_stagewise

A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0.005], [0.1]])
XS = np.random.default_rng(0).uniform(-2.2, 2.2, (8, 2)).astype(np.float32)


def system():
    return jm.LinearSystem(A, B, dt=0.1)


def problem(**more):
    return jm.MPC(**{
        "system": system(), "Q": [1.0, 0.5], "R": 0.1, "horizon": 3, "states": jm.Box(-2, 2),
        "inputs": jm.Box(-1, 1), "terminal_cost": [2.0, 1.0], **more,
    })  # fmt: skip


def soft_problem(**more):
    return problem(soft=jm.Soft([[1.0, 0.0]], upper=[0.5], rho=3.0, quadratic=1.0), **more)


def rich_problem():
    """Every kind of row and cost that a condensed problem has."""
    return soft_problem(
        outputs=jm.Outputs([[1.0, 1.0]], [-3.0], [3.0], D=[[0.1]]), input_rate_weight=[0.1],
        input_rate_limit=0.8, terminal_set=jm.Ellipsoid(np.eye(2), 9.0),
        stage_weights=np.array([1.0, 2.0, 1.0]),
    )  # fmt: skip


@pytest.mark.parametrize(
    "call",
    [
        jm.feasible_polytope,
        lambda mpc: jm.feasible.boundary(mpc, 4).points,
        lambda mpc: jm.map_feasible_set(mpc, XS).label,
        lambda mpc: jm.solve_many(mpc, XS).inputs,
        lambda mpc: len(jm.explicit.critical_regions(mpc)),
        lambda mpc: jm.explicit.exact_penalty(mpc).rho_bar,
    ],
)
def test_what_is_known_is_computed_inside_traces(call):
    """Functions of known data give what they give outside of jit."""
    mpc, found = problem(), []
    jax.make_jaxpr(lambda v: (found.append(call(mpc)), v)[1])(0.0)
    jax.tree.map(np.testing.assert_array_equal, found[0], call(mpc))


@cache
def controller():
    return jm.Controller(problem())


def program(x):
    """A quadratic program whose linear term is x."""
    rows = jnp.array([[1.0, 1.0], [1.0, -1.0]], x.dtype)
    return jm.QP(P=jnp.eye(2, dtype=x.dtype), q=x, A=rows, l=-jnp.ones_like(x), u=jnp.ones_like(x))


def bent(x, u):
    # Of an array of NumPy in a function that is alive JAX 0.11 and 0.12 keep the type that it had
    # in the mode in which it was traced first: it is made one of the type of x here.
    return jnp.asarray(A, x.dtype) @ x + jnp.asarray(B, x.dtype) @ u + 0.01 * jnp.sin(x)


def nonlinear(x):
    """From half the state: every plan is feasible, so that rounding decides nothing."""
    task = Task(lambda point: point.x[:1] ** 2, weight=np.eye(1), upper=3.0)
    return solve_nonlinear(NonlinearMPC(problem(), bent, (task,)), 0.5 * x)


def looped(x):
    """A loop that the user writes, which carries the plan."""

    def sample(before, _):
        control = controller()(x, before)
        return control, control.u

    return jax.lax.scan(sample, controller().start(x), None, length=2)[1]


def robot(x):
    plant = jm.LinearPlant(system(), jm.Box([-2, -2], [2, 2]), jm.Box([-1.0], [1.0]))
    return jm.simulate(jm.RobotController(plant, problem()), plant, x, 2).states


# Functions of a state (2,), each a pytree of arrays.
FUNCTIONS = {
    "plan": lambda x: controller().plan(x),
    "derivative": lambda x: jax.grad(lambda x: jm.solve(rich_problem(), x).cost)(x),
    "stagewise": lambda x: solve_stagewise(soft_problem(), x).inputs,
    "data": lambda x: jm.solve(problem(Q=jnp.diag(1 + x**2)), x).inputs,
    "qp": lambda x: jm.solve_qp(program(x)).z,
    "lqr": lambda x: jm.lqr(system(), jnp.diag(1 + x**2), 0.1).K,
    "loop": looped,
    "simulate": lambda x: jm.simulate(controller(), system(), x, 2).states,
    "unrolled": lambda x: (
        jm.solve(problem(), x, solver=jm.ADMM(20, newton_steps=2, differentiate="unrolled")).inputs
    ),
    "fixed": lambda x: (
        jm.solve(rich_problem(), x, solver=jm.ADMM(20, newton_steps=5, fixed=True)).inputs
    ),
    "jacobian": lambda x: jax.jacfwd(lambda x: jm.solve(problem(), x).inputs)(x),
    "nonlinear": nonlinear,
    "robot": robot,
}
FEW = ("plan",)
HELD_BACK = {"explicit": ("loop",)}  # JAX's own: a carry that starts without a sharding


def many(name):
    """The function of a batch. The controller is made here, not while the function is traced."""
    controller()
    return jax.vmap(FUNCTIONS[name])


def near(one, other):
    jax.tree.map(lambda v, w: np.testing.assert_allclose(v, w, rtol=2e-3, atol=2e-3), one, other)


@pytest.mark.long
def test_a_plan_is_traced_without_implicit_promotion_on_a_mesh_that_is_not_the_context():
    """Arrays have explicit axes in their type without `jax.set_mesh` too. The modes act on what is
    traced, so that nothing need be compiled here."""
    mesh = jax.make_mesh((1,), ("b",), axis_types=(AxisType.Explicit,))
    batch = jax.device_put(XS, NamedSharding(mesh, PartitionSpec("b")))
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        found = jax.jit(many("plan")).trace(batch).out_info
    assert found.inputs.shape == (len(XS), 3, 1)


def of_constants():
    """Programs of x whose other data are arrays of JAX that are made before, several of them in
    the first."""
    one, two, eye, gain = jnp.ones(1), jnp.zeros(2), jnp.eye(2), jnp.zeros((1, 2))
    none = jnp.zeros((2, 2))
    inputs, disturbance, nine = jm.Box(-one, one), jm.Box(-one, one), jnp.array(9.0)
    moves = jm.LinearSystem(jnp.array(A), jnp.array(B))
    qp = program(two)
    first = lambda data: data[0][:1]
    task = Task(first, weight=one, target=one, lower=-one, upper=one, rho=nine)
    with_x = lambda x, **more: jm.solve(problem(system=moves, inputs=inputs, **more), x).inputs
    robust = dict(disturbance=disturbance, disturbance_matrix=0.01 * B)
    return {
        "several": partial(
            with_x,
            prestabilise=gain,
            terminal_set=jm.Ellipsoid(eye, nine, center=two),
            input_rate_limit=one,
            input_rate_weight=one,
            outputs=jm.Outputs(eye, -nine * jnp.ones(2)),
        ),
        "stages": lambda x: solve_stagewise(problem(system=moves, inputs=inputs), x).inputs,
        "nonlinear": lambda x: (
            solve_nonlinear(NonlinearMPC(problem(inputs=inputs), bent, (task,)), x).inputs
        ),
        "disturbance": partial(with_x, control_horizon=2, **robust),
        "gain": partial(with_x, prestabilise=gain),
        "no gain": partial(with_x, prestabilise=gain, control_horizon=2),
        "disturbance alone": partial(with_x, **robust),
        "center": partial(with_x, terminal_set=jm.Ellipsoid(eye, nine, center=two)),
        "rates": partial(with_x, input_rate_limit=one, input_rate_weight=one),
        "soft": lambda x: jm.solve(jm.soften(problem(system=moves), nine), x, two).inputs,
        "outputs": partial(with_x, outputs=jm.Outputs(eye, -nine * jnp.ones(2))),
        "qp": lambda x: jm.solve_qp(replace(qp, q=x)).z,
        "linear program": lambda x: jm.solve_qp(replace(qp, q=x, P=none)).z,
    }


@pytest.mark.long
@pytest.mark.parametrize("name", of_constants())
@pytest.mark.first(4)
def test_constants_inside_jit_may_be_arrays_of_jax(name):
    """Operations on them are traced there: what is asked of their values is asked of NumPy."""
    with jax.enable_x64(True):
        x = jnp.array([0.5, 0.0])
        assert jax.eval_shape(of_constants()[name], x).dtype == x.dtype


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_implicit_promotion(name):
    """Neither of ranks nor of types, by a user who has forbidden both."""
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        found = jax.jit(many(name))(XS)
    near(found, jax.jit(many(name))(XS))


def test_labels_without_implicit_promotion():
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        found = jm.map_feasible_set(problem(), XS).label
    np.testing.assert_array_equal(found, jm.map_feasible_set(problem(), XS).label)


@pytest.mark.slow
def test_without_jit():
    mpc = jm.MPC(jm.LinearSystem([[1.0]], [1.0]), 1.0, 1.0, 2, inputs=jm.Box(-1, 1))
    with jax.disable_jit():
        plan = jm.solve(mpc, 3.0)
    np.testing.assert_allclose(plan.inputs, [[-1.0], [0.0]], atol=1e-5)


@pytest.mark.slow
def test_debugging_modes():
    """Feasible or not, no NaN is made on the way, and no tracer stays behind."""
    with jax.debug_nans(True), jax.checking_leaks():
        for x, status in ((XS[2], jm.Status.SOLVED), (np.array([3.0, 3.0]), 3)):
            assert jm.solve(problem(), x).status == status


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
def test_half_precision(kind):
    """Computed in float32, as there are no factorizations in half precision."""
    cast = lambda tree: jax.tree.map(lambda v: jnp.asarray(v, kind), tree)
    plan = jm.solve(cast(problem()), cast(XS[2]))
    assert plan.inputs.dtype == np.float32 and plan.status == jm.Status.SOLVED
    want = jm.solve(jax.tree.map(lambda v: v.astype(np.float32), cast(problem())), cast(XS[2]))
    np.testing.assert_array_equal(plan.inputs, want.inputs)
    found = jm.solve_qp(cast(program(jnp.array([2.0, 0.5]))))
    assert found.z.dtype == np.float32 and found.status == jm.Status.SOLVED


def check_shard_map(names):
    """One batch shared by four devices, with JAX's default check of what varies over them."""
    from jax.sharding import AxisType
    from jax.sharding import PartitionSpec as P

    mesh = jax.make_mesh((4,), ("b",), axis_types=(AxisType.Auto,))
    for name in names:
        parts = jax.shard_map(many(name), mesh=mesh, in_specs=P("b"), out_specs=P("b"))
        near(jax.jit(parts)(XS), jax.jit(many(name))(XS))
        print(name, flush=True)


def check_explicit(names):
    """A mesh with explicit axes, the default of jax.make_mesh: shardings are types."""
    from jax.sharding import NamedSharding
    from jax.sharding import PartitionSpec as P

    mesh = jax.make_mesh((4,), ("b",))
    for name in names:
        if name in HELD_BACK["explicit"]:
            continue
        batch, function = jax.device_put(XS, NamedSharding(mesh, P("b"))), many(name)
        with jax.set_mesh(mesh):
            found = jax.jit(function)(batch)
        near(found, jax.jit(many(name))(XS))
        print(name, flush=True)


def in_a_process(check, names):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4".strip()
    code = f"import test_modes; test_modes.check_{check}({list(names)})"
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True,
        env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-500:] + done.stderr[-2000:]


@pytest.mark.first(1)
@pytest.mark.parametrize("check", ["shard_map", "explicit"])
@pytest.mark.slow
def test_several_devices(check):
    in_a_process(check, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("check", ["shard_map", "explicit"])
def test_several_devices_all(check):
    in_a_process(check, [name for name in FUNCTIONS if name not in FEW])


def test_lightly_optimised_programs_are_whole_ones_inside_others():
    """JAX refuses options of the compiler inside another program."""
    from jaxmpc.qp.jax_transformations import compiled_lightly

    square = compiled_lightly(0, static_argnames="twice")(
        lambda x, *, twice: x**2 * (2 if twice else 1)
    )
    x = jnp.arange(3.0)
    for call in (square, jax.jit(square, static_argnames="twice")):
        np.testing.assert_array_equal(call(x, twice=True), [0, 2, 8])
    np.testing.assert_array_equal(jax.vmap(lambda v: square(v, twice=False))(x), [0, 1, 4])
    np.testing.assert_array_equal(jax.grad(lambda v: square(v, twice=False)[1])(x), [0, 2, 0])
    inside = jax.jit(lambda: square(jnp.ones(2), twice=False))
    np.testing.assert_array_equal(inside(), [1, 1])
