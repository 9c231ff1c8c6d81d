"""devices=: results do not depend on how many devices share the work, nor on how many processes.

CPUs count as several devices only where a flag says so before JAX is imported: the checks run in a
process of their own, on four devices, and two more are the processes of `jax.distributed`.
"""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

FLAG = "--xla_force_host_platform_device_count"
# Of one joint: states of a box somewhat larger than its limits, some infeasible, one not finite.
COUNT, SHAPE = 203, 16
Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])


def problem():
    import jaxmpc as jm

    return jm.MPC(
        jm.LinearSystem([[1, 0.1], [0, 1]], [[0], [0.2]], dt=0.1), Q, R, 5,
        states=jm.Box([-1.5, -2], [1.5, 2]), inputs=jm.Box(-2, 2), terminal_cost=Q,
    )  # fmt: skip


def states(count=COUNT):
    x = np.random.default_rng(0).uniform([-1.6, -2.1], [1.6, 2.1], (count, 2))
    x[count // 2] = np.nan
    return x


def same(one, other):
    """Assert that two pytrees have the same bits."""
    import jax

    jax.tree.map(np.testing.assert_array_equal, one, other)


def near(one, other, to=1e-9):
    """Assert that two pytrees agree to `to`, relative to numbers above one."""
    import jax

    jax.tree.map(lambda v, w: np.testing.assert_allclose(v, w, rtol=to, atol=to), one, other)


def map_of(x, horizon=5, **options):
    """The labels of states and their proofs. The ADMM stage decides all with the short horizon."""
    import jaxmpc as jm

    mpc = replace(problem(), horizon=horizon)
    found = jm.map_feasible_set(mpc, x, **options).labels
    return {
        name: getattr(found, name)
        for name in ("label", "status", "start", "plan", "cut_normal", "cut_offset")
    }


def prove_by_hand(x, found):
    """Assert that plans keep the limits and that half-spaces exclude their states."""
    yes, no = found["label"] == 1, found["label"] == -1
    assert yes.sum() + no.sum() == len(x) - 1  # one is not finite
    plans, mpc, rolled = found["plan"][yes], problem(), x[yes].T
    assert np.abs(plans).max() <= 2
    for k in range(plans.shape[1] - 1):
        rolled = mpc.system.A @ rolled + mpc.system.B @ plans[:, k].T
        assert (np.abs(rolled).max(axis=1) <= [1.5 + 1e-9, 2 + 1e-9]).all()
    assert (np.sum(found["cut_normal"][no] * x[no], axis=1) > found["cut_offset"][no]).all()


def check_map():
    """The same bits on one, two and four devices, whichever; a few states on more devices."""
    import jax

    x = states()
    one = map_of(x, chunk=64)
    for devices in (1, 2, 4, jax.devices()[1:3], np.array(jax.devices()[::-1])):
        same(map_of(x, chunk=64, devices=devices), one)
    # With the Newton stage, which gathers other states side by side on each device: other rounding,
    # hence other plans, as valid.
    left, whole = (map_of(x, 20, iterations=2, chunk=64, devices=d) for d in (4, None))
    same(left["label"], whole["label"])
    yes = one["label"] == 1
    assert 100 < yes.sum() and 10 < (one["label"] == -1).sum() and np.all(one["label"][~yes] <= 0)
    prove_by_hand(x, one)
    prove_by_hand(x, left)
    # The shape of the programs differs here, and the rounding of matrix products with it.
    few, want = map_of(x[:3], dtype="float64", devices=4), map_of(x[:3], dtype="float64")
    same(few["label"], want["label"])
    near(few["plan"], want["plan"])  # half-spaces amplify the rounding of small multipliers
    assert map_of(np.zeros((0, 2)), devices=2)["label"].shape == (0,)


def check_map_of_policies():
    """Labels under affine policies, of numbers of states that devices do not share equally."""
    import jaxmpc as jm

    mpc = replace(
        problem(), horizon=2, disturbance=jm.Box([-0.02, -0.02], [0.02, 0.02]), policy="affine"
    )
    x = states(23)
    find = lambda **options: jm.map_feasible_set(mpc, x, **options).labels
    names = "label", "status", "start", "plan", "cut_normal", "cut_offset"
    one = find()
    assert min(np.sum(one.label == v) for v in (1, -1)) > 3
    for devices in (2, 3, 4):
        for chunk in (None, 5, 16):
            other = find(devices=devices, chunk=chunk)
            for name in names:
                np.testing.assert_allclose(
                    getattr(other, name), getattr(one, name), rtol=1e-12, atol=1e-12
                )


def check_plans():
    """The same bits where each device gets as many states as one did; else to rounding."""
    import jax

    import jaxmpc as jm

    x, mpc, solver = states(), problem(), jm.ADMM(30, newton_steps=5)
    solve = lambda x, **options: jm.solve_many(mpc, x, solver, dtype="float64", **options)
    one = solve(x, chunk=SHAPE)
    for count in (1, 2, 4):
        same(solve(x, chunk=count * SHAPE, devices=count), one)
    solved = one.status == jm.Status.SOLVED
    assert solved.sum() > 100
    rows = lambda tree, where: jax.tree.map(lambda v: v[where], tree)
    other = solve(x, chunk=70, devices=jax.devices()[:3])
    same(other.status, one.status)
    near((other.inputs[solved], other.cost[solved]), (one.inputs[solved], one.cost[solved]))
    near(solve(x[:3], devices=4).inputs, rows(one.inputs, slice(3)))
    assert solve(np.zeros((0, 2)), devices=2).inputs.shape == (0, 5, 1)


def check_plans_left_there():
    """Each device keeps an equal part of the plans, in order, however many pieces it takes."""
    import jax

    import jaxmpc as jm

    x, mpc, solver = states(204), problem(), jm.ADMM(30, newton_steps=5)
    solve = lambda x, **options: jm.solve_many(mpc, x, solver, dtype="float64", **options)
    one, rows = solve(x), lambda tree, where: jax.tree.map(lambda v: v[where], tree)
    solved = one.status == jm.Status.SOLVED
    for chunk, devices in ((None, 4), (64, 4), (64, None)):
        there = solve(x, chunk=chunk, devices=devices, to_host=False)
        for leaf in jax.tree.leaves(there):
            assert len(leaf.addressable_shards) == (devices or 1)
            assert {len(part.data) for part in leaf.addressable_shards} == {204 // (devices or 1)}
        host = jax.tree.map(np.asarray, there)
        same(host.status, one.status)
        near(rows(host, solved).inputs, rows(one, solved).inputs)
    few = solve(x[:203], chunk=64, devices=4, to_host=False)  # whole on each
    near(np.asarray(few.inputs)[solved[:203]], rows(one, slice(203)).inputs[solved[:203]])


def check_data_of_other_devices():
    """Programs run where JAX's own do: where their data were put, or on `jax.default_device`."""
    import jax

    import jaxmpc as jm

    first, other = jax.devices()[:2]
    x, solver = states(11)[:5], jm.ADMM(30, newton_steps=5)
    with jax.enable_x64(True):
        there = jax.device_put(x, other)
        controller = jm.Controller(problem(), solver)
        solve = lambda x, controller=controller: jm.solve_many(controller, x, to_host=False).inputs
        one = solve(x)
        assert one.devices() == {first}
        moved = [solve(there), solve(x, jax.device_put(controller, other))]
        with jax.default_device(other):
            moved.append(solve(x))
        for inputs in moved:
            assert inputs.devices() == {other}
            same(inputs, one)
        loops = lambda x: jm.simulate_many(controller, problem().system, x, 2).states
        same(loops(there), loops(x))
    same(jm.map_feasible_set(problem(), there).label, jm.map_feasible_set(problem(), x).label)


def check_large_results():
    """Copies by several threads, into parts of arrays that are there."""
    from jaxmpc.batches import COPIED, joined

    parts = [
        (np.random.default_rng(i).uniform(size=(COPIED // 40, 7)), np.arange(i)) for i in (5, 3)
    ]
    found = joined(parts)
    same(found, tuple(np.concatenate(each) for each in zip(*parts, strict=True)))
    out = np.zeros((len(found[0]) - 9, 7)), np.zeros(7, int)
    joined(parts, out)
    same(out, (found[0][:-9], found[1][:7]))


def check_loops():
    """Each loop with a plant of its own, in chunks whose last one is filled up."""
    import jax

    import jaxmpc as jm

    x, mpc = states(23)[:11], problem()
    plant = jm.LinearPlant(mpc.system, mpc.states, mpc.inputs)
    B = np.asarray(mpc.system.B) * np.linspace(0.9, 1.1, 11)[:, None, None]
    with jax.enable_x64(True):
        controller = jm.Controller(mpc, jm.ADMM(30, newton_steps=0))
        run = lambda **options: jm.simulate_many(
            controller, plant, x, 4, variations={"B": B}, **options
        )
        one = run(chunk=2)
        for count in (1, 2, 4):
            same(run(chunk=2 * count, devices=count), one)
        near(run(devices=4), one)  # twelve loops at once


def compared(tune, to=1e-9):
    """Assert that a tuner takes the same steps on one device and on four."""
    one, other = tune(None), tune(4)
    assert one.history is not None and one.history.accepted.all()
    assert (one.history.gradient_norm > 0).all()
    near(other.values, one.values, to)
    for name in ("loss", "gradient_norm", "numbers", "validation_numbers"):
        near(getattr(other.history, name), getattr(one.history, name), to)


def weights(mode):
    """Loss and gradient with a loop that is not finite, beside a design loss."""
    import jax

    import jaxmpc as jm

    x, mpc = states(38)[:30], problem()
    assert np.isnan(x).any()

    def tune(devices):
        with jax.enable_x64(True):
            return jm.tune_weights(
                lambda v: replace(mpc, Q=v["Q"]), {"Q": jm.Parameter(Q, "diagonal")}, mpc.system, x,
                jm.ClosedLoopLoss(np.diag([50, 0.1]), R / 10), 3, mode=mode, updates=2,
                solver=jm.ADMM(10, newton_steps=0, differentiate="unrolled"), devices=devices,
                design_loss=lambda mpc: 0.1 * mpc.Q[0, 0],
            )  # fmt: skip

    compared(tune)


def check_weights_by_forward_mode():
    weights("forward")


def check_weights_by_reverse_mode():
    weights("reverse")


def check_weights_by_gauss_newton_steps():
    weights("gauss-newton")


def check_feasible_set():
    import jaxmpc as jm

    compared(
        lambda devices: jm.tuning.tune_feasible_set(
            lambda v: replace(problem(), inputs=jm.Box([-v["u"]], [v["u"]])),
            {"u": jm.Parameter(1.0, "positive")}, states(30), updates=2, newton_steps=20,
            design_loss=lambda mpc: 0.01 * mpc.inputs.upper[0], devices=devices,
        )
    )  # fmt: skip


def check_penalties():
    """Logarithms of residuals: their rounding is larger."""
    import jaxmpc as jm

    x = states(38)[:18]
    compared(
        lambda devices: jm.tuning.tune_solver(
            problem(), x, 12, stages=2, updates=2, devices=devices
        ),
        1e-6,
    )


def check_programs():
    """A device leaves its loop by itself; no program holds a collective; all devices work."""
    import jax
    import jax.numpy as jnp

    from jaxmpc.batches import over_devices
    from jaxmpc.feasible.candidate_search import compiled_admm, compiled_check, compiled_newton
    from jaxmpc.mpc.many import _plans

    def count_to(end, x):
        step = lambda v: (v[0] + 1, v[1] + 1)
        return jax.lax.while_loop(lambda v: jnp.any(v[0] < end), step, (x, jnp.zeros_like(x)))[1]

    devices = tuple(jax.devices())
    program = over_devices(count_to, devices, (False, True))
    args = np.float32(8), np.arange(8, dtype=np.float32)
    taken = program.run(*args)
    assert taken.sharding.device_set == set(devices)
    same(np.asarray(taken), np.repeat([8.0, 6.0, 4.0, 2.0], 2).astype(np.float32))
    map_of(states(), 20, iterations=2, chunk=64, devices=4)
    stages = compiled_admm(2, np.dtype(np.float32), devices), compiled_newton(64, devices)
    used = (program, *stages, compiled_check(devices), _plans(devices))
    made = [found for compiled in used for each in compiled.programs.values() for found in each]
    assert len(made) >= 12 and stages[1].programs  # one a device
    for text in (found.as_text() for found in made):
        for word in ("all-reduce", "all-gather", "all-to-all", "collective-permute"):
            assert word not in text


def check_refusals():
    """One line, before anything compiles."""
    import jax

    import jaxmpc as jm

    first, mpc, x = jax.devices()[0], problem(), np.zeros((3, 2))
    wrong = (
        (0, "devices: 0. Give a whole number of at least 1"),
        (-1, "devices: -1. Give a whole number of at least 1"),
        (5, "devices: 5 where this process has 4. Give fewer"),
        (1.0, "devices: 1.0. Give a whole number"),
        (True, "devices: True. Give a whole number"),
        ("cpu", "devices: 'cpu'. Give a whole number"),
        (first, f"devices: {first!r}. Give a whole number"),
        ([], "devices: an empty sequence"),
        ([0, 1], "devices: holds 0. Give a number, or some of jax.devices()"),
        ([first, first], "devices: the same one twice"),
    )
    make = lambda v: mpc
    parameters = {"Q": jm.Parameter(Q, "diagonal")}
    calls = (
        lambda d: jm.map_feasible_set(mpc, x, devices=d),
        lambda d: jm.solve_many(mpc, x, devices=d),
        lambda d: jm.simulate_many(jm.Controller(mpc), mpc.system, x, 2, devices=d),
        lambda d: jm.tune_weights(make, parameters, mpc.system, x, devices=d),
        lambda d: jm.tuning.tune_feasible_set(make, parameters, x, devices=d),
        lambda d: jm.tuning.tune_solver(mpc, np.zeros((20, 2)), devices=d),
    )
    for k, call in enumerate(calls):
        for given, text in wrong if k == 0 else wrong[:1]:
            with pytest.raises(ValueError) as caught:
                call(given)
            assert str(caught.value).startswith(text) and "\n" not in str(caught.value)


CHECKS = {name: found for name, found in globals().items() if name.startswith("check_")}
QUICK = (
    "check_data_of_other_devices",
    "check_map",
    "check_map_of_policies",
    "check_programs",
    "check_refusals",
)
LONG = ("check_weights_by_gauss_newton_steps",)  # whose candidates are those of samples too


def one_of_two(process, port, folder):
    """Half of the states, by one of two processes with two devices each."""
    import jax

    jax.distributed.initialize(f"localhost:{port}", num_processes=2, process_id=process)
    import jaxmpc as jm

    assert len(jax.devices()) == 4 and len(jax.local_devices()) == 2
    try:
        jm.map_feasible_set(problem(), np.zeros((3, 2)), devices=jax.devices())
    except ValueError as error:
        assert "is of another process. Give some of jax.local_devices()" in str(error)
    else:
        raise AssertionError("devices of another process were taken")
    np.savez(folder / f"half{process}.npz", **results(states()[process::2], 2))


def results(x, devices):
    """Labels and plans, each device with SHAPE states at once."""
    import jaxmpc as jm

    chunk = SHAPE * (devices or 1)
    plans = jm.solve_many(
        problem(), x, jm.ADMM(30, newton_steps=5), dtype="float64", chunk=chunk, devices=devices
    )
    return map_of(x, chunk=chunk, devices=devices) | {"inputs": plans.inputs, "solve": plans.status}


def start(devices, *arguments):
    """Start this file as a program on so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {FLAG}={devices}"
    return subprocess.Popen(
        [sys.executable, __file__, *map(str, arguments)], text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip


def passed(names):
    """Assert that these checks pass, in a process of their own."""
    out, err = start(4, "checks", *names).communicate()
    try:
        outcomes = json.loads(out.splitlines()[-1])
    except (IndexError, ValueError):
        pytest.fail(err)
    failures = [error for error in outcomes.values() if error]
    assert list(outcomes) == list(names) and not failures, "\n".join(failures)


@pytest.mark.slow
def test_on_four_devices():
    passed(QUICK)


@pytest.mark.slow
def test_more_on_four_devices():
    passed([name for name in CHECKS if name not in QUICK + LONG])


@pytest.mark.slow
def test_long_ones_on_four_devices():
    passed(LONG)


@pytest.mark.slow
def test_two_processes(tmp_path):
    """Each with its half of the states: the bits of one process."""
    with socket.socket() as found:
        found.bind(("localhost", 0))
        port = found.getsockname()[1]
    both = [start(2, k, port, tmp_path) for k in range(2)]
    for process in both:
        _, err = process.communicate()
        assert process.returncode == 0, err
    for k in range(2):
        want = results(states()[k::2], None)
        with np.load(tmp_path / f"half{k}.npz") as half:
            same({name: half[name] for name in half.files}, want)


def main(arguments):
    if arguments[0] != "checks":
        return one_of_two(int(arguments[0]), int(arguments[1]), Path(arguments[2]))
    import time
    import traceback

    found = dict.fromkeys(arguments[1:])
    for name in arguments[1:]:
        begun = time.perf_counter()
        try:
            CHECKS[name]()
        except Exception:
            found[name] = traceback.format_exc()
        print(f"{name}: {time.perf_counter() - begun:.1f} s", file=sys.stderr)
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
