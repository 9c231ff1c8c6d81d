"""The kernels for GPUs, run without one, against the loops of XLA that they replace; their texts
for Triton, run by NumPy in its place; and that Triton compiles them."""

import ast
import functools
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import triton_in_numpy
from bench.families import joint

import jaxmpc as jm
from jaxmpc.mpc import solve_stagewise
from jaxmpc.mpc.stagewise import recursion_kernels
from jaxmpc.qp import admm, derivative, dual, jax_transformations, kernel, newton, solve
from jaxmpc.qp.admm import ADMM, ScaledProgram, factorise, iterate, splittings
from jaxmpc.qp.admm_kernel import iterate_batch, pieces
from jaxmpc.qp.admm_kernel import suits as suits_kernel
from jaxmpc.qp.dual import Dual, DualPoint, MostSteps, dual_search, dual_search_kernel
from jaxmpc.qp.jax_transformations import true_places
from jaxmpc.qp.triton_source import triton_source

STEPS = 12


def scaled_batch(n, m, B, *, soft=False, balls=(), stages=1, dtype=jnp.float32, seed=0):
    """Random programs that share P and A, in ADMM's coordinates: factor, q (B, n), bounds, t."""
    rng = np.random.default_rng(seed)
    A = jnp.asarray(0.3 * rng.standard_normal((m, n)))
    l, u = -rng.uniform(0.1, 1, (B, m)), rng.uniform(0.1, 1, (B, m))
    l[:, ::5], q, in_balls = -np.inf, rng.standard_normal((B, n)), m - sum(balls)
    l[:, in_balls:] = u[:, in_balls:] = 0.0
    fields = {}
    if soft:
        odd = (np.arange(m) % 2 == 1) & (np.arange(m) < in_balls)
        fields |= {"soft_linear": np.where(odd, 1.0, np.inf), "soft_quadratic": 2.0 * odd}
    if balls:
        fields |= {"balls": balls, "radius": rng.uniform(0.5, 1, len(balls))}
    rho = np.linspace(0.5, 2, stages)[:, None] * np.ones(m)
    settings = ADMM(iterations=STEPS, rho=rho)
    made = jax.jit(lambda A: factorise(jnp.eye(n), A, settings, balls))(A)

    def one(q, l, u):
        qp = solve.as_arrays(jm.QP(jnp.eye(n), q, A, l, u, **fields))
        program = ScaledProgram.of(qp, made)
        return program.q, program.bounds

    data = made, *jax.jit(jax.vmap(one))(q, l, u), rng.standard_normal((B, m))
    return jax.tree.map(lambda v: jnp.asarray(v, dtype) if v.dtype.kind == "f" else v, data)


@pytest.mark.parametrize(
    "case",
    [
        dict(n=7, m=11, B=5, stages=2),  # padded rows and a tile that is not full
        pytest.param(dict(n=20, m=60, B=17, stages=3), marks=pytest.mark.slow),
        dict(n=10, m=150, B=3, dtype=jnp.float64),  # low rank, two pieces
        pytest.param(dict(n=20, m=21, B=20, soft=True), marks=pytest.mark.slow),
        dict(n=10, m=30, B=4, soft=True, balls=(2, 3)),
    ],
)
@pytest.mark.first(1)
def test_admm_in_one_kernel_is_the_loop(case, x64):
    made, q, bounds, t = scaled_batch(**case)
    alpha = jnp.asarray(1.7, t.dtype)
    loop = lambda q, b, t: iterate(splittings(made, q), b, t, STEPS, alpha)
    found = iterate_batch(made, alpha, q, bounds, t, STEPS)
    rounding = 1e3 * jnp.finfo(t.dtype).eps
    for ours, wanted in zip(found, jax.jit(jax.vmap(loop))(q, bounds, t), strict=True):
        np.testing.assert_allclose(ours, wanted, atol=rounding)
    assert iterate_batch(made, alpha, q, bounds, t, 0)[0] is t


@pytest.mark.parametrize("count", [1, 16, 17, 60, 100, 156, 200, 300, 512])
def test_pieces_cover_all_rows(count):
    found = pieces(count)
    assert len(found) <= 2 and sum(size for _, size in found) >= count
    assert all(size >= 16 and size & (size - 1) == 0 for _, size in found)
    assert [first for first, _ in found] == [0, found[0][1]][: len(found)]


def searches(case, first, more):
    """The end of the search by XLA's loop and by the kernel, and which instances are optimal."""
    made, q, bounds, t = scaled_batch(**case, dtype=jnp.float64)
    start = 0.02 * t * (jnp.abs(t) > 1)
    limit, steps = jnp.asarray(1e7), MostSteps(first, more)
    points = jax.jit(jax.vmap(lambda q, b, y: DualPoint.of(made.A, q, b, y)))
    cold, point = points(q, bounds, 0 * start), points(q, bounds, start)

    def loop(bounds, cold, point):
        dual = Dual(made.A, made.S, bounds, limit)
        return dual_search(dual, cold, point, jnp.asarray(True), steps)

    def kernel(bounds, cold, point):
        dual, true = Dual(made.A, made.S, bounds, limit), jnp.asarray(True)
        return dual_search_kernel(dual, cold, point, true, steps)

    return [jax.jit(jax.vmap(search))(bounds, cold, point) for search in (loop, kernel)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "first"),
    [
        (dict(n=7, m=11, B=9), 24),
        (dict(n=20, m=30, B=6, soft=True), 24),
        pytest.param(dict(n=20, m=40, B=6), 24, marks=pytest.mark.slow),
        (dict(n=20, m=40, B=6), 2),  # which is too few: all begin once more
        pytest.param(dict(n=40, m=100, B=3), 24, marks=pytest.mark.slow),  # three kernels
    ],
)
@pytest.mark.first(1)
def test_the_search_on_the_dual_in_a_kernel_is_the_loop(case, first, x64):
    (wanted, there), (found, found_there) = searches(case, first, 60)
    np.testing.assert_array_equal(found_there, there)
    assert np.all(there)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


@pytest.mark.slow
def test_a_search_that_is_lost_begins_once_more(x64):
    """Programs whose first search, of three steps, does not end; by a second one all are solved."""
    case = dict(n=20, m=60, B=30)
    (_, lost), _ = searches(case, 3, 0)
    (_, found), _ = searches(case, 3, 60)
    assert not np.all(lost) and np.all(found)


STATES = np.linspace(-1, 1, 6)[:, None] * np.array([1.1, 1.4])


@pytest.mark.slow
def test_damped_systems_in_a_kernel_are_those_of_xla(x64):
    """Of every size, in float64, with rows that depend on each other and soft ones."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((120, 60))
    A[7] = A[3]
    A /= np.linalg.norm(A, axis=1)[:, None]
    on = np.zeros((6, 120), bool)
    for row, count in zip(on, (0, 1, 5, 16, 20, 48), strict=True):
        row[rng.choice(120, count, replace=False)] = True
    on[2, [3, 7]] = True
    W = jax.vmap(lambda on: true_places(on, 48))(on)
    slack = jnp.asarray(rng.uniform(0, 1e-3, (6, 48)) * (rng.random((6, 48)) < 0.5))
    b = jnp.where(W < 120, rng.standard_normal((6, 48)), 0.0)
    S = jnp.asarray(A @ A.T)
    each = lambda function: jax.vmap(lambda *v: function(S, *v, 1e-6, 4))(W, slack, b)
    found, wanted = each(derivative.damped_kernel), each(derivative.damped)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)
    whole = np.asarray(S)[np.ix_(W[5], W[5])] + np.diag(slack[5])
    np.testing.assert_allclose(whole @ found[5], b[5], atol=1e-9)


# Settings of no other test: programs that are traced for a GPU must not be taken for others.
SOLVER = jm.ADMM(newton_steps=1001)


@pytest.mark.slow
@pytest.mark.parametrize("soft", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_plans_by_kernels_are_those_without(soft, x64, monkeypatch):
    """Statuses of infeasible states too."""
    far = np.array([[1.49, 1.99]])  # beyond the limit after one step
    states, mpc = np.concatenate([STATES, far]), replace(joint(), horizon=8)
    if soft:
        mpc = replace(
            mpc,
            soft=jm.Soft(np.array([[0.0, 1.0]]), upper=np.array([0.5]), rho=5.0, quadratic=20.0),
        )
    plans = lambda solver: jax.jit(jax.vmap(jm.Controller(mpc, solver).plan))(states)
    wanted = plans(jm.ADMM())
    for module in (dual, admm):
        monkeypatch.setattr(module, "has_kernels", lambda rows: rows > 0)
    found = plans(SOLVER)
    np.testing.assert_array_equal(found.status, wanted.status)
    solved = np.asarray(wanted.status) == jm.Status.SOLVED
    assert solved[:-1].all() and not solved[-1]
    np.testing.assert_allclose(found.inputs[solved], wanted.inputs[solved], atol=1e-8)
    np.testing.assert_allclose(found.gap[solved], wanted.gap[solved], atol=1e-9)


@pytest.fixture
def texts(monkeypatch, x64):
    """The names of kernels that are called, each of which its text computes, too."""
    names, by_jax = [], kernel.kernel_p.impl

    def both(*args, **params):
        found, program = by_jax(*args, **params), params["kernel"]
        text = triton_source(program, params["batched"], params["batch"])
        by_text = triton_in_numpy.run(text, program, args, params["batch"])
        # Of a search y and v: the count of its steps may differ by rounding.
        count = 2 if program.name == "dual_steps" else len(found)
        for ours, others in zip(found[:count], by_text, strict=False):
            rounding = 1e3 * np.finfo(ours.dtype).eps * max(1.0, np.abs(np.asarray(ours)).max())
            np.testing.assert_allclose(others, ours, atol=rounding)
        names.append(program.name)
        return found

    monkeypatch.setattr(kernel.kernel_p, "impl", both)
    return names


def random_of(dtype):
    """A source of random arrays of batches of two, of this type."""
    rng = np.random.default_rng(0)
    return lambda *shape: jnp.asarray(0.4 * rng.standard_normal((2, *shape)), dtype)


def call_admm(**case):
    made, q, bounds, t = scaled_batch(**case)
    iterate_batch(made, jnp.asarray(1.7, t.dtype), q, bounds, t, STEPS)


def call_search(**case):
    made, q, bounds, _ = scaled_batch(**case, dtype=jnp.float64)
    limit, true, steps = jnp.asarray(1e7), jnp.asarray(True), MostSteps(24, 60)

    def search(bounds, cold):
        dual = Dual(made.A, made.S, bounds, limit)
        return dual_search_kernel(dual, cold, cold, true, steps)

    points = jax.jit(jax.vmap(lambda q, b: DualPoint.of(made.A, q, b, jnp.zeros_like(b.l))))
    cold = points(q, bounds)
    jax.vmap(search)(bounds, cold)


def call_damped():
    S, b = jnp.eye(12) + 0.1, random_of(jnp.float64)(6)
    W = jnp.array([[2, 5, 7, 12, 12, 12], [0, 1, 2, 3, 4, 12]])
    jax.vmap(lambda W, b: derivative.damped_kernel(S, W, 0 * b, b, 1e-6, 2))(W, b)


def call_in_registers():
    least = lambda a, b, x, y: ([jnp.minimum(a * x, y)], [jnp.max(x * y), jnp.sum(x) + b])
    x, y = random_of(jnp.float64)(6)
    kernel.in_one_program(least, [x[0], y[1]], [(x, 0.0), (y, 1.0)], [6], 2)


def call_line_search(soft):
    # (The steps end before the minimum is found; of some seeds rounding decides which way they go.)
    made, q, bounds, t = scaled_batch(n=7, m=11, B=3, soft=soft, dtype=jnp.float64, seed=4)

    def both(bounds, t):
        given = bounds, 1e3, t, jnp.ones_like(t), jnp.asarray(-5.0), jnp.asarray(1.0)
        return newton.line_minimum(*given), newton._line_minimum(*given)

    found, wanted = jax.vmap(both)(bounds, t)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    one = jax.tree.map(lambda v: v[0], bounds)
    slopes = lambda minimum: jax.grad(
        lambda s: minimum(one, 1e3, t[0], 1 + 0 * t[0], s, 1.0 + 0 * s)
    )
    found, wanted = (slopes(f)(-5.0) for f in (newton.line_minimum, newton._line_minimum))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def call_recursions(dtype):
    N, n, m, random = 3, 5, 2, random_of(dtype)

    def weights(*shape):
        W = np.asarray(random(*shape))
        return jnp.asarray(W @ W.swapaxes(-1, -2) + np.eye(shape[-1], dtype=dtype))

    A, B, Q, R = random(N, n, n), random(N, n, m), weights(N + 1, n, n), weights(N, m, m)
    gains = jax.vmap(recursion_kernels._riccati_kernel)(Q, R, A, B)
    gx, gu = random(N + 1, n), random(N, m)
    jax.vmap(recursion_kernels._tracking_kernel)(gains, A, B, gx, gu)
    jax.vmap(recursion_kernels._riccati_in_pieces)(Q, R, A, B)
    w, start, given = map(np.asarray, (gx[:, 1:], gx[:, 0], A))
    jax.vmap(recursion_kernels._recurrence_in_pieces)(A, given @ given, 0 * given[:, 0])
    for adjoint in (False, True):
        again = functools.partial(recursion_kernels._recurrence_kernel, adjoint=adjoint)
        jax.vmap(again, in_axes=(None, 0, 0))(given[0], w, start)


RECURSIONS = {
    "riccati_stages",
    "riccati_pieces",
    "riccati_ends",
    "tracking_stages",
    "recurrence_stages",
    "products_of_pieces",
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("calls", "names"),
    [
        (lambda: call_admm(n=7, m=40, B=5, stages=2), {"admm_steps"}),
        (lambda: call_admm(n=10, m=30, B=4, soft=True, balls=(2, 3)), {"admm_steps"}),
        pytest.param(
            lambda: call_admm(n=8, m=40, B=18, stages=2, dtype=jnp.float64),
            {"admm_steps"},
            marks=pytest.mark.slow,
        ),
        (lambda: call_search(n=7, m=11, B=4), {"dual_steps"}),
        pytest.param(
            lambda: call_search(n=20, m=30, B=2, soft=True), {"dual_steps"}, marks=pytest.mark.slow
        ),
        (call_damped, {"damped_steps"}),
        (call_in_registers, {"in_registers"}),
        pytest.param(lambda: call_line_search(False), {"in_registers"}, marks=pytest.mark.slow),
        pytest.param(lambda: call_line_search(True), {"in_registers"}, marks=pytest.mark.slow),
        pytest.param(lambda: call_recursions(jnp.float64), RECURSIONS, marks=pytest.mark.slow),
        pytest.param(lambda: call_recursions(jnp.float32), RECURSIONS, marks=pytest.mark.slow),
    ],
    ids=[
        "rows",
        "balls",
        "stages",
        "search",
        "soft",
        "damped",
        "registers",
        "line",
        "soft line",
        "recursions",
        "recursions in float32",
    ],
)
def test_texts_of_kernels_compute_what_the_kernels_do(calls, names, texts, monkeypatch):
    monkeypatch.setattr(newton, "has_kernels", lambda rows: True)
    calls()
    assert set(texts) == names


def test_derivatives_of_plans_without_rows_on_a_gpu(monkeypatch, x64):
    """There are no rows to gather."""
    monkeypatch.setattr(derivative, "on_gpu", lambda: True)
    controller = jm.Controller(jm.MPC(joint().system, np.eye(2), np.eye(1), 2), SOLVER)
    plans = jax.vmap(lambda x: controller(x).u)
    assert jax.eval_shape(jax.jacrev(plans), jnp.ones((3, 2))).shape == (3, 1, 3, 2)


def test_derivatives_in_the_model_of_plans_stage_by_stage_on_a_gpu(monkeypatch, x64):
    """The scale of the rows depends on the model by a recursion, too."""
    monkeypatch.setattr(recursion_kernels, "on_gpu", lambda: True)
    mpc = replace(joint(), horizon=3)
    of = lambda B: replace(mpc, system=replace(mpc.system, B=B))
    cost = lambda B: solve_stagewise(of(B), np.ones(2), solver=SOLVER).cost
    assert jax.eval_shape(jax.grad(cost), np.array(mpc.system.B)).shape == (2, 1)


def test_a_kernel_of_batches_of_batches(texts):
    """Of arguments that have both axes, one of them, or none, and with a grid of its own."""

    def products(a, b, c, out):
        i = kernel.program() * 16 + kernel.indices(16)
        part = kernel.load(a.at[i]) * kernel.load(b.at[i]) + c[0]
        kernel.store(out.at[i], part)

    one = kernel.call(products, jax.ShapeDtypeStruct((32,), jnp.float64), grid=2)
    rng = np.random.default_rng(0)
    a, b = jnp.asarray(rng.standard_normal((3, 2, 32))), jnp.asarray(rng.standard_normal((2, 32)))
    c = jnp.asarray(rng.standard_normal((3, 1)))
    inner = jax.vmap(one, in_axes=(0, 0, None))
    found = jax.vmap(inner, in_axes=(0, None, 0))(a, b, c)
    np.testing.assert_allclose(found, a * b + c[:, None], rtol=1e-15, atol=1e-15)
    found = jax.vmap(inner, in_axes=(1, None, None))(a.swapaxes(0, 1), b, c[0])
    np.testing.assert_allclose(found, a * b + c[0], rtol=1e-15, atol=1e-15)
    with pytest.raises(NotImplementedError, match="no text in Triton for the operation sin"):
        sines = lambda a, out: kernel.store(out.at[kernel.indices(16)], jnp.sin(a[0]))
        kernel.call(sines, jax.ShapeDtypeStruct((16,), jnp.float64))(a[0, 0])


def test_kernels_are_traced_inside_functions_of_known_data():
    """`on_host` leaves what they are made of to be traced, inside a trace and outside."""

    def double(a, out):
        at = kernel.indices(16)
        kernel.store(out.at[at], 2 * kernel.load(a.at[at]) + a[0])

    a = np.arange(1.0, 17.0, dtype=np.float32)
    call = jax_transformations.on_host(kernel.call(double, jax.ShapeDtypeStruct((16,), a.dtype)))
    found = [call(a)]
    jax.make_jaxpr(lambda v: (found.append(call(a)), v)[1])(0.0)
    for each in found:
        np.testing.assert_array_equal(each, 2 * a + 1)


def test_kernels_traced_by_several_threads_are_those_of_one():
    """Each keeps its own stores while it is traced."""

    def counts(out):
        for k in range(20):
            kernel.store(out.at[kernel.indices(16) + 16 * k], jnp.full(16, k + 1))

    def one(_):
        return kernel.call(counts, jax.ShapeDtypeStruct((320,), jnp.int32))()

    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(one, range(8)):
            np.testing.assert_array_equal(found, np.repeat(np.arange(20) + 1, 16))


def lowered(function, states, monkeypatch, compiler=None):
    """Lower the program of a batch for a GPU, which needs none; return the texts of its kernels.

    compiler: of (function of Triton, types of its arguments, warps)."""
    found = []

    def triton_call(
        *args, kernel, grid, name, num_warps, num_stages, out_shape=None, enable_fp_fusion=None
    ):  # fmt: skip
        assert enable_fp_fusion is True  # from Triton 3.10 on not by default
        if compiler is not None:
            compiler(kernel, [*args, *out_shape], num_warps)
        found.append(kernel)
        return [jnp.zeros(v.shape, v.dtype) for v in out_shape]

    monkeypatch.setitem(sys.modules, "jax_triton", SimpleNamespace(triton_call=triton_call))
    monkeypatch.setattr(kernel, "has_jax_triton", lambda: True)
    if compiler is None:
        monkeypatch.setattr(kernel, "triton_function", lambda text: text)
    for module in (jax_transformations, kernel, derivative):
        monkeypatch.setattr(module, "on_gpu", lambda: True)
    jax.jit(function).trace(states).lower(lowering_platforms=("cuda",))
    return found


@pytest.mark.long
@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.first(1)
def test_kernels_can_be_lowered_for_a_gpu(gradient, x64, monkeypatch):
    """Their operations have a text in Triton, which is Python."""
    plan = jax.vmap(jm.Controller(joint(), SOLVER).plan)
    if gradient:
        plan = jax.grad(lambda x, plan=plan: jnp.sum(plan(x).cost))
    # ADMM; the search on the dual, twice (two sizes each); judges;
    # a line search; derivatives: two halves of three sizes.
    texts = lowered(plan, jnp.asarray(STATES), monkeypatch)
    assert len(texts) == (14 if gradient else 8)
    for text in texts:
        ast.parse(text)


@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.first(1)
def test_kernels_can_be_lowered_outside_64_bit_mode(soft, monkeypatch):
    """Their float64 stays float64 where the mode is off as the program is lowered."""
    mpc = jm.mpc.soften(joint(), 50.0) if soft else joint()
    mpc = jax.tree.map(lambda v: np.asarray(v, np.float32), mpc)
    texts = lowered(jax.vmap(lambda x: jm.solve(mpc, x)), np.float32(STATES), monkeypatch)
    assert len(texts) > 3 and any("tl.float64" in text for text in texts)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", [80, 89, 90, 100])
def test_triton_compiles_the_kernels(architecture, x64, monkeypatch):
    """For Ampere, Ada, Hopper and Blackwell, where Triton is installed; no GPU is needed."""
    triton = pytest.importorskip("triton")
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    names = {"float64": "*fp64", "float32": "*fp32", "int32": "*i32"}

    def compiler(function, arguments, warps):
        types = [names[str(v.dtype)] for v in arguments]
        signature = dict(zip(function.arg_names, types, strict=True))
        source = ASTSource(function, signature, {}, {})
        options = dict(num_warps=warps, num_stages=1, enable_fp_fusion=True)
        target = GPUTarget("cuda", architecture, 32)
        made = triton.compile(source, target=target, options=options)
        assert ".entry" in made.asm["ptx"] and made.metadata.shared < 227_000

    plan = jax.vmap(jm.Controller(joint(), SOLVER).plan)
    gradient = jax.grad(lambda x: jnp.sum(plan(x).cost))
    assert lowered(gradient, jnp.asarray(STATES), monkeypatch, compiler)


@pytest.mark.slow
def test_jax_triton_takes_the_kernels(x64, monkeypatch):
    """The one that is installed, told that the GPU is an H100. None is needed, but JAX's plugin."""
    pytest.importorskip("jax_triton")
    pytest.importorskip("jax_cuda13_plugin")
    from jaxlib import gpu_triton

    monkeypatch.setattr(gpu_triton, "get_compute_capability", lambda device: 90)
    for module in (jax_transformations, kernel, derivative):
        monkeypatch.setattr(module, "on_gpu", lambda: True)
    plan = jax.vmap(jm.Controller(joint(), SOLVER).plan)
    traced = jax.jit(jax.grad(lambda x: jnp.sum(plan(x).cost))).trace(jnp.asarray(STATES))
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("triton_kernel_call") >= 14  # as in test_kernels_can_be_lowered_for_a_gpu


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend:DeprecationWarning")
@pytest.mark.parametrize(
    ("soft", "solver", "least"),
    [
        (False, jm.ADMM(iterations=7, newton_steps=0, dtype="float32"), 1),
        pytest.param(False, SOLVER, 7, marks=pytest.mark.slow),
        pytest.param(True, SOLVER, 7, marks=pytest.mark.slow),
    ],
)
def test_pallas_takes_the_kernels(soft, solver, least, x64, monkeypatch):
    """Where jax-triton is not installed. Lowering needs no GPU."""
    mesh_module = pytest.importorskip("jax._src.mesh")
    try:
        device = mesh_module.AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    except (AttributeError, TypeError):
        pytest.skip("this JAX lowers kernels of Pallas on machines with a GPU alone")
    monkeypatch.setattr(kernel, "has_jax_triton", lambda: False)
    for module in (jax_transformations, kernel, derivative):
        monkeypatch.setattr(module, "on_gpu", lambda: True)
    axes = dict(axis_types=(jax.sharding.AxisType.Auto,), abstract_device=device)
    mpc = jm.mpc.soften(joint(), 50.0) if soft else joint()
    program = jax.jit(jax.vmap(jm.Controller(mpc, solver).plan))
    try:
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((1,), ("x",), **axes)):
            traced = program.trace(jnp.asarray(STATES))
            text = traced.lower(lowering_platforms=("cuda",)).as_text()
    except (TypeError, RuntimeError) as error:
        if "same dtypes" in str(error):
            raise
        pytest.skip(f"this JAX lowers kernels of Pallas on machines with a GPU alone: {error}")
    assert text.count("xla.gpu.triton") >= least


def test_without_a_compiler_there_are_no_kernels_and_one_line_says_so(monkeypatch):
    """Newer versions of JAX may leave out Pallas' Triton backend."""
    caches = jax_transformations.has_jax_triton, jax_transformations.has_compiler
    clear = lambda: [found.cache_clear() for found in caches]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setitem(sys.modules, "jax_triton", None)
    clear()
    try:
        assert jax_transformations.on_gpu()
        monkeypatch.setitem(sys.modules, "jax.experimental.pallas.triton", None)
        clear()
        with pytest.warns(UserWarning, match="no GPU kernel runs and plans take .* Install"):
            assert not jax_transformations.on_gpu()
        assert not jax_transformations.on_gpu()  # without another warning, which would be an error
        for name in ("jax_triton", "triton"):
            monkeypatch.setitem(sys.modules, name, ModuleType(name))
        clear()
        assert jax_transformations.on_gpu()
    finally:
        clear()


@pytest.mark.slow
def test_limits_far_below_the_cost(x64, monkeypatch):
    """min ½p|z|² + q'z with |z| ≤ 1 and |q| = 1e16 p: what brings z to its limits is less than the
    rounding of the multipliers, in which the kernel's search tells it."""
    monkeypatch.setattr(dual, "has_kernels", lambda rows: True)
    box, q = np.eye(2), np.array([-1e6, 5e5])
    found = jax.jit(lambda q: jm.solve_qp(jm.QP(1e-10 * box, q, box, -np.ones(2), np.ones(2))))(q)
    assert found.status == jm.Status.SOLVED
    np.testing.assert_allclose(found.z, [1, -1], rtol=0, atol=1e-9)


def test_no_kernels_where_programs_run_on_a_cpu_beside_a_gpu(tmp_path, monkeypatch):
    """Elsewhere than on a GPU the programs of a kernel run one after the other."""
    from jaxmpc.export import export_jax

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax_transformations, "has_compiler", lambda: True)
    for device, there in ((None, True), (jax.devices("cpu")[0], False), ("cpu", False)):
        with jax.default_device(device):
            assert jax_transformations.on_gpu() == there
    few = jm.ADMM(iterations=7, newton_steps=0)
    traced = jax.make_jaxpr(jax.vmap(jm.Controller(joint(), few).plan))(np.float32(STATES))
    assert "gpu_kernel" in str(traced)
    pytest.importorskip("flatbuffers")
    monkeypatch.setattr(kernel.kernel_p, "bind", None)
    export_jax(joint(), tmp_path / "plan", few, dtype="float32")


@pytest.mark.parametrize(
    ("n", "m", "taken"),
    [(20, 60, True), (156, 156, True), (40, 200, True), (140, 420, False), (20, 600, False)],
)
def test_matrices_beyond_shared_memory_are_left_to_xla(n, m, taken, monkeypatch):
    """As are iterates in float64, and rows that no program's registers hold."""
    monkeypatch.setattr(jax_transformations, "on_gpu", lambda: True)
    made = SimpleNamespace(A=np.zeros((m, n)))
    suits = lambda dtype, product: suits_kernel(made, (), np.dtype(dtype), product)
    assert suits("float32", kernel.ROUGH) == taken == suits("float32", kernel.EXACT)
    assert not suits("float64", kernel.EXACT)
