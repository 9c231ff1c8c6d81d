"""How much faster several devices are than one: labels and plans of the joint.

Two times of each, apart. "On the devices": the compiled programs alone, from states that lie on the
devices to results that stay there. "Results on the host": the call that users make, from NumPy
states to NumPy results; with it the bytes that were copied. `--states` of them, the same on one
device and on all. Programs are compiled before; the least of `--rounds` calls counts.

    python experiments/many_devices.py                       # 2^22 states on all GPUs of this host
    XLA_FLAGS=--xla_force_host_platform_device_count=2 python experiments/many_devices.py \
        --states 16384                                       # on CPUs that count as two
"""

import argparse
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Any

import jax
import numpy as np
from bench.families import joint

import jaxmpc as jm
from jaxmpc.batches import chosen_devices, default_chunk, gather_size, placement
from jaxmpc.feasible.candidate_search import compiled_admm, compiled_newton
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.many import _plans

BEGUN = perf_counter()


def say(*words: Any) -> None:
    """Print a line with the seconds since the start."""
    print(f"[{perf_counter() - BEGUN:6.1f} s]", *words, flush=True)


def least(call: Callable[[], Any], rounds: int) -> float:
    """Return the least seconds of `rounds` calls."""
    times = []
    for _ in range(rounds):
        begun = perf_counter()
        call()
        times.append(perf_counter() - begun)
    return min(times)


def split(x: np.ndarray, devices: tuple[jax.Device, ...]) -> tuple[list[jax.Array], int]:
    """Return the states on their devices, chunk by chunk, and the states of a device in a chunk."""
    each = min(default_chunk(), len(x) // len(devices))
    size = each * len(devices)
    count = len(x) // size
    place = placement(devices, True)
    return [jax.device_put(x[i * size : (i + 1) * size], place) for i in range(count)], each


def print_labels(x: np.ndarray, devices: tuple[jax.Device, ...], rounds: int) -> dict[str, float]:
    """Print the times of `map_feasible_set`, and return them."""
    mpc, found = joint(), {}
    with jax.enable_x64(True):
        problem = FeasibilityProblem.of(mpc, None, None)
        exact = problem.exact(np.abs(x).max(axis=0), np.median(np.abs(x[:4096]), axis=0))
        exact, rows = jax.device_put((exact, problem.rows), placement(devices))
        chunks, each = split(x, devices)
        ones = jax.device_put(np.ones(len(chunks[0]), bool), placement(devices, True))
        stage = compiled_admm(50, np.dtype(np.float32), devices)
        newton = compiled_newton(gather_size(each), devices)
        here = x[: len(ones)]  # on the host, as the calls below have them
        first, second = stage.run, newton.run
        first(exact, rows, here)
        spent: list[float] = []

        def call() -> None:
            begun = perf_counter()
            out = [
                second(exact, rows, part, ones, *first(exact, rows, part)).label for part in chunks
            ]
            spent.append(perf_counter() - begun)
            jax.block_until_ready(out)

        call()
        found["on the devices"] = least(call, rounds)
    say(f"   dispatched in {min(spent):.3f} s, {len(chunks)} chunks")
    begun = perf_counter()
    fmap = jm.map_feasible_set(mpc, x, devices=devices)
    fmap.labels.fetch()
    say(f"   first call {perf_counter() - begun:.1f} s, {fmap.counts()}")
    found["labels on the host"] = least(
        lambda: jm.map_feasible_set(mpc, x, devices=devices).label, rounds
    )
    found["labels and proofs on the host"] = least(
        lambda: jm.map_feasible_set(mpc, x, devices=devices).labels.fetch(), rounds
    )
    labels = fmap.labels
    proofs = (labels.start, labels.plan, labels.cut_normal, labels.cut_offset)
    size = sum(v.nbytes for v in (labels.label, labels.status, *proofs))
    report("labels", len(devices), len(x), found, size)
    found["check"] = float(np.sum(labels.label * (1 + np.arange(len(x)) % 1009)))
    return found


def print_plans(x: np.ndarray, devices: tuple[jax.Device, ...], rounds: int) -> dict[str, float]:
    """Print the times of `solve_many`, and return them."""
    mpc, found = joint(), {}
    with jax.enable_x64(True):
        controller = jm.Controller(in_float64(mpc), jm.ADMM(dtype="float32"))
        controller = jax.device_put(controller, placement(devices))
        chunks, _ = split(x, devices)
        program = _plans(devices).run

        def call() -> None:
            jax.block_until_ready([program(controller, part).status for part in chunks])

        call()
        found["on the devices"] = least(call, rounds)
    solve = lambda: jm.solve_many(mpc, x, devices=devices)
    begun = perf_counter()
    plans = solve()
    solved = np.mean(plans.status == jm.Status.SOLVED)
    say(f"   first call {perf_counter() - begun:.1f} s, {solved:.4%} solved")
    size = sum(v.nbytes for v in jax.tree.leaves(plans))
    where = plans.status == jm.Status.SOLVED
    found["check"] = float(np.sum(plans.cost[where]))
    del plans
    found["results on the host"] = least(solve, rounds)
    report("plans", len(devices), len(x), found, size)
    return found


def report(what: str, devices: int, states: int, found: dict[str, float], size: int) -> None:
    """Print the times of one measurement."""
    for name, seconds in found.items():
        if name != "check":
            say(f"{what}, {devices} devices, {name}: {seconds:.3f} s, "
                f"{seconds / states * 1e9:.1f} ns a state")  # fmt: skip
    say(f"{what}, {devices} devices: {size / 1e6:,.0f} MB to the host, {size / states:.0f} a state")


def print_copies(devices: tuple[jax.Device, ...], size: int) -> None:
    """Print how fast `size` bytes of each device get to the host, in turn and at once."""
    make = jax.jit(lambda k: k + jax.numpy.arange(size // 4, dtype=np.float32))
    for name, threads in (("one after the other", 1), ("at once", len(devices))):
        there = [make(jax.device_put(np.float32(k), d)) for k, d in enumerate(devices)]
        jax.block_until_ready(there)
        begun = perf_counter()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(np.asarray, there))
        rate = len(devices) * size / (perf_counter() - begun) / 1e9
        say(f"copies to the host, {len(devices)} devices {name}: {rate:.1f} GB/s")


def main() -> None:
    """Print the times on one device and on all, and their ratios."""
    summary, _, text = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        description=summary, epilog=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--states", type=int, default=2**22)
    parser.add_argument("--devices", type=int, help="how many at most (default: all)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", choices=("labels", "plans"))
    given = parser.parse_args()
    everything = chosen_devices(given.devices or len(jax.local_devices()))
    assert everything is not None
    say(f"jax {jax.__version__}, {len(everything)} of {everything[0].device_kind}, "
        f"{given.states} states")  # fmt: skip
    x = np.random.default_rng(0).uniform([-1.6, -2.1], [1.6, 2.1], (given.states, 2))
    print_copies(everything, 2**28 if everything[0].platform != "cpu" else 2**22)
    for name, measure in (("labels", print_labels), ("plans", print_plans)):
        if given.only not in (None, name):
            continue
        one = measure(x, everything[:1], given.rounds)
        if len(everything) == 1:
            say(f"{name}: one device only, nothing to compare")
            continue
        many = measure(x, everything, given.rounds)
        for key in one:
            if key == "check":
                same = np.isclose(one[key], many[key], rtol=1e-9, atol=0)
                say(f"{name}: results agree: {bool(same)} ({one[key]:.9g}, {many[key]:.9g})")
            else:
                say(f"{name}, {key}: {len(everything)} devices {one[key] / many[key]:.2f} "
                    "times as fast as one")  # fmt: skip


if __name__ == "__main__":
    main()
