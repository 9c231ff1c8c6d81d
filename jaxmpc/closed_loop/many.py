"""simulate_many: closed loops from many initial states, in chunks that fit into memory."""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax import Array
from tqdm.std import tqdm

from jaxmpc.arrays import Reals
from jaxmpc.batches import (
    Compiled,
    Devices,
    chosen_devices,
    count,
    device_bytes,
    divisible,
    first_rows,
    joined,
    over_devices,
    padded,
    placement,
    program_bytes,
)
from jaxmpc.checks import fail, require_real
from jaxmpc.closed_loop.noise import Noise
from jaxmpc.closed_loop.observer import KalmanFilter
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.simulation import (
    ConstantPlant,
    as_argument,
    checked_arguments,
    reference_sizes,
    simulate,
)
from jaxmpc.qp.precision import arrays


def simulate_many(
    controller: Any, plant: Any, x0s: Reals, steps: int, *, reference: Reals | None = None,
    input_reference: Reals | None = None, references: Reals | None = None,
    input_references: Reals | None = None, previous_input: Reals | None = None,
    noise: Noise | None = None, observer: KalmanFilter | None = None,
    delay: int = 0, compensate: bool = True, variations: Mapping[str, Any] | None = None,
    chunk: int | None = None, progress: bool = False, devices: Any = None,
) -> Run:  # fmt: skip
    """Simulate closed loops from many initial states x0s (B, n); return NumPy arrays (B, ...).

    controller, plant, steps, previous_input, observer, delay, compensate: as in `simulate`.
    reference, input_reference: as in `simulate`, the same for all loops.
    references, input_references: one for each loop, (B, n) and (B, m), or over time (B, T + N, n)
        and (B, T + N − 1, m); in place of those for all.
    noise: as in `simulate`, each loop with its own (see `Noise.seed`).
    variations: parameters of the plant that differ between the B loops, as `plant.vary` takes
        them, each with B in front: dict(body_mass=(B, nbody), payload=(B,)) randomises masses
        (domain randomisation). The controller keeps the nominal model.
    chunk: number of loops that the compiled program runs at once; None: all of them, halved until
        the program fits into the memory of the device.
    progress: show a progress bar.
    devices: a number of them, or a sequence of JAX devices, which share the loops of a chunk; None:
        the default device.

    Raises ValueError as `simulate` does.
    """
    require_real("x0s", x0s)
    x0s, variations = np.asarray(x0s), dict(variations or {})
    if x0s.ndim != 2 or not len(x0s):
        size = getattr(controller, "state_size", "n")
        fail("x0s", f"shape {x0s.shape}", f"Give (B, {size}), B ≥ 1")
    require_variations(plant, variations, len(x0s))
    if chunk is not None and chunk < 1:
        fail("chunk", f"{chunk}", "Give a count of at least 1")
    devices = chosen_devices(devices)
    shared = {
        "reference": reference, "input_reference": input_reference,
        "previous_input": previous_input, "noise": noise, "observer": observer,
    }  # fmt: skip
    shared = {name: value for name, value in shared.items() if value is not None}
    given = {"reference": references, "input_reference": input_references}
    own = {name: np.asarray(v) for name, v in given.items() if v is not None}
    checked = checked_arguments(controller, plant, x0s[0], steps, **shared, delay=delay)
    require_own(own, shared, controller, steps, len(x0s))
    if noise is not None:
        shared["noise"], own["index"] = checked[-2], np.arange(len(x0s))
    if observer is not None:
        shared["observer"] = checked[-1]
    host = ("reference", "input_reference", "previous_input")
    shared |= {name: np.asarray(shared[name]) for name in host if name in shared}
    whole = jax.device_put(arrays((controller, as_argument(plant), shared)), placement(devices))
    rows = lambda start, size: jax.tree.map(
        lambda v: padded(np.asarray(v)[start : start + size], size), (x0s, variations, own)
    )
    part = lambda start, size: jax.device_put(rows(start, size), placement(devices, True))
    loops = _compiled_loops(int(steps), int(delay), bool(compensate), devices)
    size = divisible(min(chunk or len(x0s), len(x0s)), devices)
    while chunk is None and size > count(devices):
        if program_bytes(loops.program(*whole, *part(0, size))) <= 0.8 * device_bytes():
            break
        size = divisible(-(-size // 2), devices)
    runs = []
    with tqdm(total=len(x0s), unit=" loops", disable=not progress) as bar:
        for start in range(0, len(x0s), size):
            here = min(size, len(x0s) - start)
            runs.append(first_rows(loops(*whole, *part(start, size)), here))
            bar.update(here)
    return joined(runs)


def require_own(
    own: Mapping[str, np.ndarray], shared: Mapping[str, Any], controller: Any, steps: int,
    count: int,
) -> None:  # fmt: skip
    """Raise ValueError unless the references of each loop have these shapes."""
    mpc = controller.mpc
    sizes = {
        "reference": (reference_sizes(controller), steps + mpc.horizon),
        "input_reference": ((mpc.system.m,), steps + mpc.horizon - 1),
    }
    for name, value in own.items():
        widths, length = sizes[name]
        if name in shared:
            fail(f"{name}s", f"given beside {name}", "Give one for all loops, or one for each")
        require_real(f"{name}s", value)
        shapes = [shape for k in widths for shape in ((count, k), (count, length, k))]
        if value.shape not in shapes:
            listed = " or ".join(map(str, shapes))
            cure = f"Give {listed}, one for each loop; {name} is for all of them"
            fail(f"{name}s", f"shape {value.shape}", cure)


def require_variations(plant: Any, variations: Mapping[str, Any], count: int) -> None:
    """Raise ValueError unless `count` plants can differ by these parameters."""
    for key, value in variations.items():
        if np.shape(value)[:1] != (count,):
            fail(f"variations[{key!r}]", f"shape {np.shape(value)}", f"Put {count} in front")
    if variations and not hasattr(plant, "vary"):
        fail("variations", f"given for a {type(plant).__name__}", "Give a Robot or LinearPlant")
    if variations:  # the plant checks names and shapes
        plant.vary(**{key: np.asarray(value)[0] for key, value in variations.items()})


def simulate_batch(
    controller: Any, plant: Any, reference: Any, input_reference: Any, x0s: Array,
    variations: dict[str, Array], steps: int, checkpoint: bool = False,
) -> Run:  # fmt: skip
    """Simulate from x0s (B, n), loop i with entry i of the variations in its plant. Works inside
    jit, vmap and grad.

    plant: from `as_argument`. The rest is as in `simulate` and `simulate_many`.
    """
    shared = {"reference": reference, "input_reference": input_reference}
    options = {"steps": steps, "checkpoint": checkpoint}
    return _loops(controller, plant, shared, x0s, variations, {}, **options)


def _loops(
    controller: Any, plant: Any, shared: dict[str, Any], x0s: Array, variations: dict[str, Array],
    own: dict[str, Array], **options: Any,
) -> Run:  # fmt: skip
    """Return the runs from x0s (B, n), with arguments of `simulate` that all loops share and others
    that each has of its own; "index" is the number of the loop for its noise."""
    plant = plant.plant if isinstance(plant, ConstantPlant) else plant

    def loop(x0: Array, varied: dict[str, Array], own: dict[str, Array]) -> Run:
        given = shared | own | options
        if "index" in own:
            given["noise"] = shared["noise"].of_loop(given.pop("index"))
        return simulate(controller, plant.vary(**varied) if varied else plant, x0, **given)

    return jax.vmap(loop)(x0s, variations, own)


@functools.cache
def _compiled_loops(steps: int, delay: int, compensate: bool, devices: Devices) -> Compiled:
    loops = functools.partial(_loops, steps=steps, delay=delay, compensate=compensate)
    return over_devices(loops, devices, (False,) * 3 + (True,) * 3)
