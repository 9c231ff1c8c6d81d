"""simulate_many: closed loops from many initial states, in chunks that fit into memory."""

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.batches import (
    Compiled,
    Devices,
    Part,
    chosen_devices,
    count,
    device_bytes,
    divisible,
    each_part,
    joined,
    over_devices,
    padded,
    placement,
    program_bytes,
    work_off,
)
from jaxmpc.checks import fail, require_real
from jaxmpc.closed_loop.interfaces import Feedback, Plant
from jaxmpc.closed_loop.noise import Noise
from jaxmpc.closed_loop.observer import KalmanFilter
from jaxmpc.closed_loop.run_record import Run
from jaxmpc.closed_loop.simulation import Conditions, checked_loop, simulate
from jaxmpc.mpc.aim import reference_shapes
from jaxmpc.mpc.stagewise.nonlinear import ConstantModel
from jaxmpc.pytrees import pytree
from jaxmpc.qp.precision import arrays


def simulate_many(
    controller: Feedback,
    plant: Plant,
    x0s: Reals,
    steps: int,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    references: Reals | None = None,
    input_references: Reals | None = None,
    previous_input: Reals | None = None,
    noise: Noise | None = None,
    observer: KalmanFilter | None = None,
    delay: int = 0,
    compensate: bool = True,
    variations: Mapping[str, Any] | None = None,
    chunk: int | None = None,
    progress: bool = False,
    devices: Any = None,
) -> Run:
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
    aims = (reference, input_reference)
    given = Conditions(*aims, None, previous_input, noise, observer, delay, bool(compensate))
    plant, _, shared = checked_loop(controller, plant, x0s[0], steps, given)
    several = {"reference": references, "input_reference": input_references}
    own = {name: np.asarray(value) for name, value in several.items() if value is not None}
    _require_own(own, given, controller, steps, len(x0s))
    numbers = None if noise is None else np.arange(len(x0s))
    each = Each(x0s, variations, own, numbers)
    whole = jax.device_put(arrays((controller, plant, shared)), placement(devices))
    loops = _compiled_loops(int(steps), devices)

    def run(part: Each) -> Run:
        return loops(*whole, jax.device_put(part, placement(devices, True)))

    size = divisible(min(chunk or len(x0s), len(x0s)), devices)
    while chunk is None and size > count(devices):
        first = jax.tree.map(lambda v, size=size: padded(np.asarray(v)[:size], size), each)
        program = loops.program(*whole, jax.device_put(first, placement(devices, True)))
        if program_bytes(program) <= 0.8 * device_bytes():
            break
        size = divisible(-(-size // 2), devices)
    runs = list[Run]()

    def keep(part: Part[Run]) -> None:
        runs.append(part.result)

    work_off(each_part(run, each, size), keep, len(x0s), unit="loops", progress=progress)
    return joined(runs)


@pytree
class Each:
    """What differs between B loops: initial states (B, n), variations of the plant, references of
    their own by name, and the numbers (B,) of the loops for their noise, None without noise."""

    x0s: Any
    variations: dict[str, Any]
    references: dict[str, Any]
    numbers: Any = None


def _require_own(
    own: Mapping[str, np.ndarray], shared: Conditions, controller: Feedback, steps: int, count: int
) -> None:
    """Raise ValueError unless the references of each loop have these shapes."""
    widths = getattr(controller, "reference_sizes", None)
    shapes = reference_shapes(controller.mpc, steps, widths)
    for name, value in own.items():
        if getattr(shared, name) is not None:
            fail(f"{name}s", f"given beside {name}", "Give one for all loops, or one for each")
        require_real(f"{name}s", value)
        choice = [(count, *shape) for shape in shapes[name]]
        if value.shape not in choice:
            listed = " or ".join(map(str, choice))
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


def simulate_each(
    controller: Feedback,
    plant: Plant,
    shared: Conditions,
    each: Each,
    *,
    steps: int,
    checkpoint: bool,
) -> Run:
    """Return the runs (B, ...) of loops under shared conditions and those of their own. Works
    inside jit, vmap and grad.

    plant: from `as_argument`; each loop has it with its own variations.
    """
    bare: Any = plant.given if isinstance(plant, ConstantModel) else plant

    def loop(one: Each) -> Run:
        given = replace(shared, **one.references)
        if shared.noise is not None:
            given = replace(given, noise=shared.noise.of_loop(one.numbers))
        varied = bare.vary(**one.variations) if one.variations else bare
        return simulate(controller, varied, one.x0s, steps, checkpoint=checkpoint, **vars(given))

    return jax.vmap(loop)(each)


@functools.cache
def _compiled_loops(steps: int, devices: Devices) -> Compiled:
    loops = functools.partial(simulate_each, steps=steps, checkpoint=False)
    return over_devices(loops, devices, (False, False, False, True))
