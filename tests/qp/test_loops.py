"""Loops that instances leave one by one, against plain Python; answers beside their neighbours."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

import jaxmpc as jm
from jaxmpc.qp import jax_transformations
from jaxmpc.qp.jax_transformations import (
    BLOCK,
    attempted_first,
    group_sizes,
    in_blocks,
    kept_whole,
    repeat_while,
    true_places,
)


def collatz(start: int) -> int:
    steps = 0
    while start != 1:
        start, steps = start // 2 if start % 2 == 0 else 3 * start + 1, steps + 1
    return steps


def counted(multiplier, start):
    """Steps until 1, with the 3 of the rule as a constant of the loop."""

    def step(multiplier, state):
        n, steps = state
        return jnp.where(n % 2 == 0, n // 2, multiplier * n + 1), steps + 1

    state = jnp.asarray(start, jnp.int32), jnp.int32(0)
    return repeat_while(lambda state: state[0] != 1, step, multiplier, state)[1]


@pytest.mark.parametrize("count", [0, 1, 5, 300, 1000])
def test_each_instance_takes_its_own_number_of_steps(count):
    """Sizes below one group, of several groups, and none at all."""
    starts = np.arange(1, count + 1, dtype=np.int32)
    found = jax.jit(jax.vmap(counted, in_axes=(None, 0)))(jnp.int32(3), starts)
    np.testing.assert_array_equal(found, [collatz(int(n)) for n in starts])


@pytest.mark.parametrize("sizes", [[20, 5, 2], [5, 2], [3]])
def test_groups_that_are_filled_up(sizes, monkeypatch):
    """Groups of several sizes, the first of them the batch or not; the last instance, with copies
    of which groups are filled up, stays the longest."""
    starts = np.array([1, 2, 3] * 6 + [1, 27], np.int32)
    assert len(starts) == 20 and collatz(27) > 100
    monkeypatch.setattr(jax_transformations, "group_sizes", lambda *_: sizes)
    found = jax.jit(jax.vmap(counted, in_axes=(None, 0)))(jnp.int32(3), starts)
    np.testing.assert_array_equal(found, [collatz(int(n)) for n in starts])


def test_a_recursion_has_three_groups_on_a_gpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert group_sizes(4096, "recursion") == [4096, 1024, 128]
    assert group_sizes(1024, "recursion") == [1024]


def product(factor, n):
    """factor·n and by which way it was found: an attempt (1), which does for even n, or not (0)."""
    derived = lambda found, factor, n: (factor * n, found[1])
    return attempted_first(attempted, as_a_whole, derived, factor, n)


@jax.jit
def attempted(factor, n):
    return (jnp.where(n % 2 == 0, factor * n, jnp.nan), jnp.int32(1)), n % 2 == 0


@jax.jit
def as_a_whole(factor, n):
    return factor * n, jnp.int32(0)


@pytest.mark.cpu
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("count", [1, 5, 300])
def test_an_attempt_goes_first(count, shared):
    """In batches that are not small; its results stand where it says so, those of the whole
    elsewhere, and the derivatives are those of the product."""
    n, factor = jnp.arange(count, dtype=jnp.float32), jnp.float32(3)
    factor = factor if shared else jnp.full(count, factor)
    batch = jax.vmap(product, (None if shared else 0, 0))
    found, way = jax.jit(batch)(factor, n)
    np.testing.assert_array_equal(found, 3 * n)
    np.testing.assert_array_equal(way, (n % 2 == 0) if count > BLOCK else 0 * n)
    total = lambda factor: jnp.sum(batch(factor, n)[0])
    np.testing.assert_array_equal(jax.jit(jax.grad(total))(factor), jnp.sum(n) if shared else n)


@pytest.mark.cpu
@pytest.mark.parametrize("count", [5, 300])
def test_an_attempt_in_a_shard_map(count):
    """What is the same for all instances varies over the mesh, where others do."""
    mesh, spec = jax.make_mesh((1,), ("b",), axis_types=(AxisType.Auto,)), PartitionSpec("b")
    both = lambda function: jax.vmap(jax.value_and_grad(function, has_aux=True))
    batch = both(jax.jit(partial(product, jnp.float32(3))))
    n = jnp.arange(float(count))
    (found, way), slope = jax.jit(jax.shard_map(batch, mesh=mesh, in_specs=spec, out_specs=spec))(n)
    np.testing.assert_array_equal(found, 3 * n)
    np.testing.assert_array_equal(way, (n % 2 == 0) if count > BLOCK else 0 * n)
    np.testing.assert_array_equal(slope, 3)


@pytest.mark.first(2)
@pytest.mark.parametrize("left", [list(range(0, 300, 9)), list(range(300)), [299]])
def test_what_fills_up_groups_is_not_one_instance_that_takes_long(left):
    """Those that an attempt leaves are solved once, or twice where it leaves all."""
    solved = []

    @jax.jit
    def some(n):
        return n, ~jnp.isin(n, jnp.array(left))

    @jax.jit
    def each(n):
        jax.debug.callback(lambda n: solved.append(int(n)), n)
        return n

    batch = jax.vmap(lambda n: attempted_first(some, each, lambda found, n: n, n))
    np.testing.assert_array_equal(jax.jit(batch)(jnp.arange(300)), np.arange(300))
    jax.effects_barrier()
    most = 2 if len(left) == 300 else 1
    assert all(1 <= solved.count(n) <= most for n in left)


@pytest.mark.cpu
@pytest.mark.first(2)
@pytest.mark.parametrize("axes", [(None, 0), (0, None), (0, 0)])
def test_an_attempt_of_nested_batches(axes):
    n, factors = jnp.arange(2.0 * BLOCK).reshape(2, BLOCK), jnp.array([3.0, 5.0])
    inner = jax.vmap(product, (None, 0))
    found, way = jax.vmap(inner, axes)(
        factors if axes[0] == 0 else factors[0], n if axes[1] == 0 else n[0]
    )
    wanted = (factors[:, None] if axes[0] == 0 else 3.0) * (n if axes[1] == 0 else n[:1])
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(way, np.broadcast_to(np.arange(BLOCK) % 2 == 0, (2, BLOCK)))


@pytest.mark.parametrize("axes", [(None, 0), (0, 0), (0, None)])
def test_nested_batches(axes):
    """The outer batch has constants of its own, or states of its own, or both."""
    starts = np.arange(1, 25, dtype=np.int32).reshape(4, 6)
    multipliers = jnp.full(4, 3, jnp.int32)
    inner = jax.vmap(counted, in_axes=(None, 0))
    outer = jax.vmap(inner, in_axes=axes)
    found = outer(
        multipliers if axes[0] == 0 else jnp.int32(3), starts if axes[1] == 0 else starts[0]
    )
    wanted = starts if axes[1] == 0 else np.broadcast_to(starts[0], (4, 6))
    np.testing.assert_array_equal(found, np.vectorize(collatz)(wanted))


def test_groups_are_smaller_where_steps_have_much_work(monkeypatch):
    """On a GPU: those of 1,024 quadrupeds, of 96 variables and 1,200 rows."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert group_sizes(1024, "long") == [1024]
    assert group_sizes(1024, "long", work=2 * 1200 * 96**2) == [256, 48]
    assert group_sizes(1024, "long", work=2**40) == [256, 32]
    assert group_sizes(96, "long", work=2**40) == [96]


def test_groups_cover_and_shrink():
    for batch in (1, 31, 256, 257, 4096, 1 << 20):
        sizes = group_sizes(batch)
        assert sizes[0] <= batch and sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize("long", [10, 5])
def test_true_places(long, monkeypatch):
    """Put in their places, and looked up."""
    monkeypatch.setattr(jax_transformations, "LONG_MASK", long)
    mask = np.array([0, 1, 1, 0, 1], bool)
    np.testing.assert_array_equal(true_places(mask, 2), [1, 2])
    np.testing.assert_array_equal(true_places(mask, 4), [1, 2, 4, 5])


def test_blocks_are_the_batch():
    x = np.arange(2.0 * BLOCK + 3)
    square = lambda c, v: c * v**2
    found = jax.vmap(lambda v: in_blocks(square, jnp.float32(2), v))(x.astype(np.float32))
    np.testing.assert_allclose(found, 2 * x.astype(np.float32) ** 2, rtol=1e-6)


def test_second_derivatives_of_blocks_with_an_absent_argument():
    """Forward over reverse, where JAX does not take None for an argument of a rule; and where
    nothing but tangents is a batch, so that the rule has none."""

    def scaled(constants, data):
        return jnp.sin(constants[0] * data) if constants[1] is None else data

    def total(x, starts):
        return jnp.sum(jax.vmap(lambda s: in_blocks(scaled, (x, None), s))(starts))

    starts, x = jnp.linspace(0.1, 1, 7), jnp.float32(0.5)
    expected = -jnp.sum(starts**2 * jnp.sin(x * starts))
    for second in (jax.jacfwd(jax.grad(total)), jax.jacrev(jax.jacfwd(total))):
        np.testing.assert_allclose(second(x, starts), expected, rtol=1e-5)
    one = lambda x: in_blocks(scaled, (x, None), jnp.float32(0.7))
    expected = -0.49 * jnp.sin(0.35)
    np.testing.assert_allclose(jax.jacfwd(jax.jacfwd(one))(x), expected, rtol=1e-5)


@pytest.mark.slow
def test_an_answer_is_its_own_in_any_batch():
    """Feasible and infeasible programs side by side: those of a batch of one."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        A = np.vstack([np.eye(4), rng.standard_normal((8, 4))])
        P, u = np.diag([1.0, 2.0, 3.0, 4.0]), np.ones(12)
        q, l = 5 * rng.standard_normal((40, 4)), np.tile(-u, (40, 1))
        l[::3, 4] = 20.0  # no point keeps this row and the others
        upper = np.maximum(l, u)
        solve = lambda q, l, u: jm.solve_qp(jm.QP(P, q, A, l, u))
        many = jax.jit(jax.vmap(solve))(q, l, upper)
        assert set(np.asarray(many.status[::3])) == {jm.Status.PRIMAL_INFEASIBLE}
        for i in (0, 1, 2, 17):
            one = solve(q[i], l[i], upper[i])
            assert one.status == many.status[i]
            if one.status == jm.Status.SOLVED:
                np.testing.assert_allclose(many.z[i], one.z, atol=1e-9)


def sine_by_its_rule(again):
    """Return sin, constant but for its rule, which is made of sin once more."""
    f = jax.custom_jvp(lambda x: jax.lax.stop_gradient(jnp.sin(x)))

    @f.defjvp
    def _(primals, tangents):
        # sin x once more, of which the derivative of this derivative is made.
        y = again(f)(*primals)
        return y, jnp.cos(jnp.arcsin(y)) * tangents[0]

    return f


@pytest.mark.parametrize("batched", [False, True])
def test_rules_are_kept_in_loops_in_all_modes(batched):
    """sin'' of a function whose own derivative is 0: known through its rule alone. In a loop, which
    JAX below 0.12 linearises without the rules of what is known before."""
    f, scale = sine_by_its_rule(kept_whole), jnp.array([1.0, 0.5])

    def loop(x):
        def step(total, k):
            # What the function closes over is traced too.
            moved = kept_whole(lambda y: f(y) + 0 * x)(x / (k + 1.0))
            return total + moved, None

        return jnp.sum(jax.lax.scan(step, 0 * x, jnp.arange(2))[0])

    one = lambda x: jnp.sum(jax.vmap(loop)(x * scale)) if batched else loop(x)
    known = lambda x: -jnp.sin(x) - jnp.sin(x / 2) / 4
    at = 0.7
    expected = known(at) + (known(at / 2) / 4 if batched else 0)
    modes = {
        "reverse, reverse": jax.grad(jax.grad(one)),
        "forward, reverse": jax.jacfwd(jax.grad(one)),
        "reverse, forward": jax.grad(jax.jacfwd(one)),
        "forward, forward": jax.jacfwd(jax.jacfwd(one)),
    }
    found = {name: float(mode(at)) for name, mode in modes.items()}
    np.testing.assert_allclose(list(found.values()), expected, rtol=1e-5, err_msg=str(found))
    jitted = [float(jax.jit(mode)(at)) for mode in modes.values()]
    np.testing.assert_allclose(jitted, expected, rtol=1e-5)
