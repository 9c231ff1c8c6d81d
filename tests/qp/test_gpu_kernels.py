"""The kernels for GPUs, run by Pallas' interpreter, against the loops of XLA that they replace."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bench.families import joint

import jaxmpc as jm
from jaxmpc.qp import admm, derivative, dual, jax_transformations, solve, triton
from jaxmpc.qp.admm import ADMM, ScaledProgram, factorise, iterate, splittings
from jaxmpc.qp.admm_kernel import iterate_batch, pieces
from jaxmpc.qp.admm_kernel import suits as suits_kernel
from jaxmpc.qp.dual import Dual, DualPoint, MostSteps, dual_search, dual_search_kernel
from jaxmpc.qp.jax_transformations import true_places

STEPS = 12


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


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
        dict(n=7, m=11, B=5),  # padded rows and a tile that is not full
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
        return dual_search_kernel(dual, cold, point, jnp.int32(0), true, steps)

    return [jax.jit(jax.vmap(search))(bounds, cold, point) for search in (loop, kernel)]


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


def lowered(function, states, monkeypatch):
    """The program of a batch for a GPU, as text; no GPU is needed for it."""
    mesh_module = pytest.importorskip("jax._src.mesh")
    if not hasattr(mesh_module, "AbstractDevice"):
        pytest.skip("this JAX lowers kernels on machines with a GPU alone")
    for module in (jax_transformations, triton, derivative):
        monkeypatch.setattr(module, "on_gpu", lambda: True)
    device = mesh_module.AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    axes = dict(axis_types=(jax.sharding.AxisType.Auto,), abstract_device=device)
    program = jax.jit(function)
    try:
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((1,), ("x",), **axes)):
            return program.trace(states).lower(lowering_platforms=("cuda",)).as_text()
    except (TypeError, RuntimeError) as error:
        if "same dtypes" in str(error):
            raise
        pytest.skip(f"this JAX lowers kernels on machines with a GPU alone: {error}")


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend:DeprecationWarning")
@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.first(1)
def test_kernels_can_be_lowered_for_a_gpu(gradient, x64, monkeypatch):
    """All operations of the kernels exist in Triton's dialect."""
    plan = jax.vmap(jm.Controller(joint(), SOLVER).plan)
    if gradient:
        plan = jax.grad(lambda x, plan=plan: jnp.sum(plan(x).cost))
    # ADMM; the search on the dual and corrections, twice (two sizes each), and four loops' judges;
    # derivatives: two halves of three sizes.
    text = lowered(plan, jnp.asarray(STATES), monkeypatch)
    assert text.count("xla.gpu.triton") == (17 if gradient else 11)


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend:DeprecationWarning")
@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.first(1)
def test_kernels_can_be_lowered_outside_64_bit_mode(soft, monkeypatch):
    """Their float64 stays float64 where the mode is off as the program is lowered."""
    mpc = jm.mpc.soften(joint(), 50.0) if soft else joint()
    mpc = jax.tree.map(lambda v: np.asarray(v, np.float32), mpc)
    text = lowered(jax.vmap(lambda x: jm.solve(mpc, x)), np.float32(STATES), monkeypatch)
    assert text.count("xla.gpu.triton") > 3 and "f64" in text


def test_without_triton_there_are_no_kernels_and_one_line_says_so(monkeypatch):
    """Newer versions of JAX may leave it out."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert jax_transformations.on_gpu()
    monkeypatch.setitem(sys.modules, "jax.experimental.pallas.triton", None)
    jax_transformations.has_triton.cache_clear()
    try:
        with pytest.warns(UserWarning, match="no GPU kernel runs and plans take .* Install"):
            assert not jax_transformations.on_gpu()
        assert not jax_transformations.on_gpu()  # without another warning, which would be an error
    finally:
        jax_transformations.has_triton.cache_clear()


@pytest.mark.parametrize(
    ("n", "m", "taken"),
    [(20, 60, True), (156, 156, True), (40, 200, True), (140, 420, False), (20, 600, False)],
)
def test_matrices_beyond_shared_memory_are_left_to_xla(n, m, taken, monkeypatch):
    """As are iterates in float64, and rows that no program's registers hold."""
    monkeypatch.setattr(jax_transformations, "on_gpu", lambda: True)
    made = SimpleNamespace(A=np.zeros((m, n)))
    suits = lambda dtype, product: suits_kernel(made, (), np.dtype(dtype), product)
    assert suits("float32", triton.ROUGH) == taken == suits("float32", triton.EXACT)
    assert not suits("float64", triton.EXACT)
