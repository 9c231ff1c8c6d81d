"""One bad reading, NaN or far off: a finite input within the limits; the next sample forgets it.

By hand, ten million calls of each kind and type (on a GPU, minutes):

    python tests/mpc/test_bad_readings.py 10000000
"""

import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxmpc as jm

BASE = jm.MPC(
    jm.LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1), np.diag([10.0, 1]), [[0.1]], 8,
    states=jm.Box([-1.0, -2], [1, 2]), inputs=jm.Box([-2.0], [2]),
)  # fmt: skip
BALL = {"terminal_set": jm.Ellipsoid(np.diag([4.0, 4]), 1.0)}
RATES = {"input_rate_limit": 0.5}
KINDS = {
    "all": lambda: replace(jm.mpc.soften(BASE, 50.0), **BALL, **RATES),
    "ball": lambda: replace(BASE, **BALL), "rates": lambda: replace(BASE, **RATES),
    "box": lambda: BASE, "soft": lambda: jm.mpc.soften(BASE, 50.0),
}  # fmt: skip
READINGS = [np.nan, np.inf, -np.inf, 1e4, -1e8, 1e15, 1e200, -1.7e308]
SAMPLES, AT = 8, 4
GOOD = np.array([0.2, 0.0])


def loop(controller, x):
    """Inputs and plans along readings x (SAMPLES, n); beside each plan that of a controller which
    has seen nothing but the last input."""

    def sample(memory, x):
        before, last = memory
        # Side by side, so that one solve is compiled.
        pair = jax.tree.map(lambda *v: jnp.stack(v), before, the_input_alone(controller, x, last))
        both = jax.vmap(controller, (None, 0))(x, pair)
        control, cold = (jax.tree.map(lambda v, i=i: v[i], both) for i in (0, 1))
        (u, plan, _), cold = control, cold.plan
        return (control, u), (u, plan.status, plan.inputs[0], cold.status, cold.inputs[0])

    memory = controller.start(x[0]), jnp.zeros(controller.mpc.system.m)
    return jax.lax.scan(sample, memory, x)[1]


def the_input_alone(controller, x, last):
    """What a controller has to remember that remembers nothing but the input `last`."""
    start = controller.start(x)
    inputs = jnp.broadcast_to(last, start.memory.inputs.shape)
    return start._replace(u=last, memory=start.memory._replace(inputs=inputs))


def readings(good):
    x = np.broadcast_to(good, (len(READINGS), SAMPLES, len(good))).copy()
    x[:, AT, 0] = READINGS
    return x


@pytest.mark.long
@pytest.mark.first(1)
@pytest.mark.parametrize(
    "steps", [{"newton_steps": 0, "iterations": 1000}, {}], ids=["ADMM", "exact"]
)
@pytest.mark.parametrize("kind", KINDS)
def test_controller(kind, steps):
    with jax.enable_x64(True):
        controller = jm.Controller(KINDS[kind](), jm.ADMM(**steps))
        found = jax.jit(jax.vmap(partial(loop, controller)))(readings(GOOD))
        u, status, planned, cold_status, cold = jax.tree.map(np.asarray, found)
    assert np.isfinite(u).all() and np.abs(u).max() <= 2
    if kind in ("rates", "all"):
        assert np.abs(np.diff(u[:3, :, 0], axis=1)).max() <= 0.5 + 1e-9  # where there is no plan
    assert (status[:3, AT] == jm.Status.NON_FINITE).all()
    after = np.s_[:, AT + 1 :]
    solved = status[after] == jm.Status.SOLVED
    assert solved[cold_status[after] == jm.Status.SOLVED].all()
    assert solved.all()
    np.testing.assert_allclose(planned[after][solved], cold[after][solved], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("linearize", ["set-point", "state", "trajectory"])
def test_robot_controller(linearize):
    pytest.importorskip("mujoco")
    with jax.enable_x64(True):
        robot = jm.load_robot("pendulum")
        mpc = jm.robot_mpc(robot, horizon=8)
        controller = jm.RobotController(robot, mpc, linearize=linearize)
        good = np.zeros(robot.state_size) + 0.1
        found = jax.jit(jax.vmap(partial(loop, controller)))(readings(good))
        u, status, planned, cold_status, cold = jax.tree.map(np.asarray, found)
    limits = robot.input_limits
    assert np.isfinite(u).all() and (u >= limits.lower).all() and (u <= limits.upper).all()
    after = np.s_[:, AT + 1 :]
    np.testing.assert_array_equal(status[after], jm.Status.SOLVED)
    size = np.abs(cold[after]).max()
    np.testing.assert_allclose(planned[after], cold[after], atol=0.02 * size)


@pytest.mark.slow
def test_a_memory_that_is_not_finite():
    """It counts as none, whoever made it."""
    with jax.enable_x64(True):
        controller = jm.Controller(KINDS["rates"]())
        x = np.array(GOOD)
        broken = jax.tree.map(lambda v: jnp.full_like(v, jnp.nan) if v.dtype == float else v,
                              controller.start(jnp.asarray(x)))  # fmt: skip
        u, plan, _ = controller(x, broken)
        assert plan.status == jm.Status.SOLVED and np.isfinite(u).all()
        np.testing.assert_allclose(u, controller(x).u, atol=1e-8)


@pytest.mark.slow
def test_joint_without_rates_gives_zero():
    u, plan, _ = jm.Controller(problems.joint(5))(np.array([np.nan, 0.0]))
    assert plan.status == jm.Status.NON_FINITE and u == 0


FEW = 8  # samples of a fuzzed loop


def fuzzed(controller, key):
    """Counts along a loop whose readings, and what is carried, are garbage now and then.

    Beside each plan that claims to be solved lies one made without a memory in the same precision:
    its cost must be the same, and its states must be those that its inputs lead to.
    """
    mpc = controller.mpc
    dtype = jnp.result_type(float)
    A, B = mpc.system.A, mpc.system.B
    rates = mpc.input_rate_limit is not None
    small = 1e-9 if dtype == jnp.float64 else 1e-5

    def garbage(key, like):
        """Of any size and sign; a quarter are not finite; a half of the entries stay."""
        which, size, sign, keep = jax.random.split(key, 4)
        most = float(jnp.finfo(dtype).maxexp) * 0.301
        found = 10.0 ** jax.random.uniform(size, like.shape, dtype, -most, most)
        found = jnp.where(jax.random.bernoulli(sign, 0.5, like.shape), found, -found)
        kind = jax.random.randint(which, like.shape, 0, 12)
        for i, value in enumerate((jnp.nan, jnp.inf, -jnp.inf)):
            found = jnp.where(kind == i, value, found)
        return jnp.where(jax.random.bernoulli(keep, 0.5, like.shape), found, like)

    def sample(state, key):
        before, last, spoilt = state
        keys = jax.random.split(key, 4)
        good = jax.random.uniform(keys[0], (2,), dtype, -0.3, 0.3)
        bad, broken = jax.random.bernoulli(keys[1], jnp.array([0.3, 0.1]))
        x = jnp.where(bad, garbage(keys[2], good), good)
        floats = lambda v: jnp.issubdtype(v.dtype, jnp.floating)
        before = jax.tree.map(
            lambda v: jnp.where(broken, garbage(keys[3], v), v) if floats(v) else v, before
        )
        last = jnp.where(jnp.isfinite(before.u), before.u, 0.0)
        control = controller(x, before)
        (u, plan, _), cold = control, controller(x, the_input_alone(controller, x, last)).plan
        claimed = (plan.status == jm.Status.SOLVED) & ~broken
        step = lambda x, u: (A @ x + B @ u,) * 2
        led = jax.lax.scan(step, x, plan.inputs)[1]
        size = 1 + jnp.abs(led).max()
        counts = {
            "not finite": ~jnp.all(jnp.isfinite(u)),
            "beyond limits": ~jnp.all(jnp.abs(u) <= 2),
            "steps beyond": rates & ~broken & jnp.any(jnp.abs(u - last) > 0.5 * (1 + 4 * small)),
            "solved without number": (plan.status == jm.Status.SOLVED) & ~jnp.all(jnp.isfinite(x)),
            "solved elsewhere": claimed
            & (jnp.abs(led - plan.states[1:]).max() > 1e3 * small * size),
            "solved at another cost": claimed & (cold.status == jm.Status.SOLVED)
            & (jnp.abs(plan.cost - cold.cost) > 1e3 * small * (1 + jnp.abs(cold.cost))),
            "not forgotten": spoilt & ~bad & ~broken & (cold.status == jm.Status.SOLVED)
            & (plan.status != jm.Status.SOLVED),
            "solved": plan.status == jm.Status.SOLVED,
        }  # fmt: skip
        return (control, u, bad | broken), jax.tree.map(jnp.int32, counts)

    start = jnp.zeros(2, dtype)
    memory = controller.start(start), jnp.zeros(1, dtype), jnp.bool_(False)
    counts = jax.lax.scan(sample, memory, jax.random.split(key, FEW))[1]
    return jax.tree.map(lambda v: v.sum(0), counts)


LAWS = ("Controller", "set-point", "state", "trajectory")
# What each refuses: a terminal ellipsoid, which is not softened, and input rates stage by stage.
PAIRS = [
    (law, kind) for law in LAWS for kind in KINDS
    if law == "Controller" or kind in ("box", "soft") or (law, kind) == ("set-point", "rates")
]  # fmt: skip


def made(law, kind):
    if law == "Controller":
        return jm.Controller(KINDS[kind]())
    plant = jm.LinearPlant(BASE.system, BASE.states, BASE.inputs)
    return jm.RobotController(plant, KINDS[kind](), linearize=law)


def fuzz(law, kind, x64, calls, most=2**17):
    """Sum of the counts over some calls."""
    with jax.enable_x64(x64):
        controller = made(law, kind)
        loops = min(-(-calls // FEW), most)
        run = jax.jit(lambda keys: jax.tree.map(
            jnp.sum, jax.vmap(partial(fuzzed, controller))(keys)))  # fmt: skip
        parts = -(-calls // (FEW * loops))
        found = [run(jax.random.split(jax.random.key(i), loops)) for i in range(parts)]
    total = {name: sum(int(part[name]) for part in found) for name in found[0]}
    return total | {"calls": parts * loops * FEW}


@pytest.mark.slow
@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize(("law", "kind"), PAIRS)
def test_garbage(law, kind, x64):
    counts = fuzz(law, kind, x64, 4000)
    assert counts.pop("solved") > 0.5 * counts.pop("calls")
    assert not any(counts.values()), counts


if __name__ == "__main__":
    for law, kind in PAIRS:
        for x64 in (False, True):
            found = fuzz(law, kind, x64, int(sys.argv[1]))
            print(law, kind, "float64" if x64 else "float32", found, flush=True)
