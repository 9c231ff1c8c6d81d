"""Public objects as pytrees: equality, donation, replacement, derivatives, stored programs."""

import dataclasses
import importlib
import pkgutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import jaxmpc as jm
from jaxmpc.pytrees import pytree
from jaxmpc.sets.convex_sets import ConvexSet

SYSTEM = jm.LinearSystem([[1, 0.1], [0, 1]], [0.005, 0.1], dt=0.1, state_names=("q", "v"))
X0 = np.array([1.0, -0.3], np.float32)


def problem(**changes):
    return jm.MPC(**{
        "system": SYSTEM, "Q": [1.0, 0.5], "R": 0.1, "horizon": 3, "inputs": jm.Box(-1, 1),
        "terminal_cost": [2.0, 1.0], **changes,
    })  # fmt: skip


def classes():
    """Each dataclass of the package that is not of the command line."""
    for module in pkgutil.walk_packages(jm.__path__, "jaxmpc."):
        if not module.name.startswith(("jaxmpc.app", "jaxmpc.__main__")):
            found = vars(importlib.import_module(module.name)).values()
            yield from (
                c for c in found
                if isinstance(c, type) and dataclasses.is_dataclass(c)
                and c.__module__ == module.name
            )  # fmt: skip


def test_no_class_compares_arrays():
    """A dataclass that may hold arrays is equal to itself alone: == of arrays has no truth. (Sets
    are equal as sets, by their LPs.)"""
    scalars = {int, float, str, bool, int | None, float | None, bool | None}
    words = ("numpy", "Array", "Any", "Reals", "jaxmpc.")
    own = {"ADMM", "ConstantPart", "Switch"}  # settings, constants
    for c in classes():
        if issubclass(c, ConvexSet):
            continue
        kinds = {f.type for f in dataclasses.fields(c)} - scalars
        if any(word in str(kind) for kind in kinds for word in words) and c.__name__ not in own:
            assert c.__eq__ is object.__eq__, c
            assert hash(object.__new__(c)) is not None or c.__hash__ is not None


@pytest.mark.long
def test_equality_and_hash():
    mpc = problem(
        soft=jm.Soft([[1.0, 0.0]], upper=[1.0]), outputs=jm.Outputs([[1.0, 1.0]], [-3], [3])
    )
    light = jm.ADMM(newton_steps=0)
    shapes = jax.eval_shape(lambda mpc, x0: jm.solve(mpc, x0, solver=light), mpc, X0)
    plan = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shapes)
    for one in (mpc, plan, plan.multipliers, mpc.soft, mpc.outputs, jm.Controller(problem())):
        other = replace(one)
        assert one == one and one != other and len({one, other}) == 2
    settings = jm.ADMM(iterations=20, rho=np.ones(3))
    assert settings == jm.ADMM(iterations=20, rho=np.ones(3)) != jm.ADMM(iterations=20)
    assert hash(settings) == hash(replace(settings)) and settings != "settings"


@pytest.mark.slow
@pytest.mark.parametrize("choice", [False, True])
def test_prestabilise_is_no_leaf(choice):
    """jit, vmap and grad take a problem as argument, whatever it says of prestabilisation."""
    mpc, plain = problem(prestabilise=choice), jm.solve(problem(), X0)
    plan = jax.jit(jm.solve)(mpc, X0)
    np.testing.assert_allclose(plan.inputs, plain.inputs, atol=1e-4)
    slope = jax.grad(lambda mpc: jm.solve(mpc, X0).cost)(mpc)
    assert slope.Q.shape == (2, 2) and np.isfinite(slope.system.A).all()
    two = jax.tree.map(lambda v: np.stack([v, v]), mpc)
    np.testing.assert_array_equal(jax.vmap(jm.solve, (0, None))(two, X0).status, [1, 1])
    assert bool(mpc.prestabilise.on) is choice and repr(mpc.prestabilise) == repr(choice)


@pytest.mark.slow
def test_controller_is_rebuilt_where_it_is_replaced():
    controller, other = jm.Controller(problem()), problem(Q=[100.0, 0.5])
    changed = replace(controller, mpc=other)
    np.testing.assert_array_equal(changed.plan(X0).inputs, jm.Controller(other).plan(X0).inputs)
    assert replace(controller, solver=jm.ADMM(rho=3.0)).factor.rho[0, 0] == 3.0
    with pytest.raises((TypeError, ValueError), match="condensed"):
        replace(controller, condensed=None)
    assert "\n" not in repr(controller) and len(repr(controller)) < 100


def test_donated_controller():
    """No array of it is another's, nor the user's."""
    Q = jnp.array([1.0, 0.5])
    mpc, solver = problem(Q=Q), jm.ADMM(newton_steps=0)  # compiles fastest
    step = jax.jit(lambda c, x: (c, c.plan(x).inputs), donate_argnums=0)
    want = step(jm.Controller(problem(), solver), X0)[1]
    controller = jm.Controller(mpc, solver)
    leaves = [v for v in jax.tree.leaves(controller) if v.size]
    assert len({v.unsafe_buffer_pointer() for v in leaves}) == len(leaves)
    again, inputs = step(controller, X0)
    assert all(v.is_deleted() for v in leaves) and not mpc.Q.is_deleted()
    np.testing.assert_allclose(inputs, want, atol=1e-6)
    np.testing.assert_allclose(step(again, X0)[1], want, atol=1e-6)


@pytest.mark.slow
def test_stored_programs():
    """jax.export stores problems and controllers as arguments, plans as results."""
    names = dict(constrain_initial=False, constrained_stages=(np.int64(1), 2))
    rich = problem(
        soft=(jm.Soft([[1.0, 0.0]], upper=[1.0], stages=(1, 2)),), prestabilise=True,
        terminal_set=jm.Ellipsoid(np.eye(2), 9.0), states=jm.Polytope(np.eye(2), [2, 2]), **names,
    )  # fmt: skip
    rich = jax.tree.map(jnp.asarray, rich)
    for function, first in ((jm.solve, rich), (lambda c, x: c(x)[1], jm.Controller(problem()))):
        stored = export.export(jax.jit(function))(first, X0).serialize()
        plan = export.deserialize(stored).call(first, X0)
        np.testing.assert_allclose(plan.inputs, function(first, X0).inputs, atol=1e-5)
        assert isinstance(plan, jm.mpc.Plan) and b"jaxmpc.Plan" in stored


def test_what_cannot_be_stored_says_so():
    task = jm.mpc.Task(lambda point: point.x, weight=1.0)
    problem_ = jm.NonlinearMPC(problem(), lambda x, u: x, (task,))
    with pytest.raises(ValueError, match="holds <function .* Close the program over it"):
        export.export(jax.jit(lambda p: p.mpc.Q))(problem_).serialize()


def test_names_are_told_apart():
    with pytest.raises(ValueError, match="Duplicate"):
        pytree(dataclasses.dataclass(type("Plan", (), {})))


def test_objects_print_in_a_few_lines():
    """Large and traced arrays as type and shape, no field that has its default."""
    assert repr(jm.ADMM()) == "ADMM()"
    assert repr(jm.ADMM(5, rho=np.ones((4, 9)))) == "ADMM(iterations=5, rho=float64 (4, 9))"
    assert repr(jm.Box([-1, -2], [1, 2])) == "Box(lower=[-1., -2.], upper=[1., 2.])"
    text = repr(jm.Controller(problem()).condensed)
    assert all(len(line) <= 100 for line in text.splitlines()) and len(text.splitlines()) < 10
    traced = []
    jax.make_jaxpr(lambda x: traced.append(repr(jm.ADMM(rho=x))))(np.float32(1))
    assert traced == ["ADMM(rho=traced float32 ())"]
    assert repr(jax.tree.map(lambda _: None, jm.Box(1.0, 2.0))) == "Box(lower=None, upper=None)"
    donated = jnp.ones(2)
    donated.delete()
    assert repr(jm.ADMM(rho=donated)) == "ADMM(rho=float32 (2,))"
    keyed = jm.closed_loop.Noise(process=[0.1, 0.1], seed=jax.random.key(0))
    assert repr(keyed).startswith("Noise(process=[0.1, 0.1], seed=key<")
