"""simulate_many: closed loops from many initial states, in chunks that fit into memory."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax import Array
from tqdm.std import tqdm

from jaxmpc.checks import fail, require_real
from jaxmpc.closed_loop.memory import device_bytes, program_bytes
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.simulate import checked_arguments, simulate
from jaxmpc.compiled import Compiled, first_rows, joined, padded
from jaxmpc.devices import Devices, chosen_devices, count, divisible, over_devices, placement
from jaxmpc.qp.precision import arrays


def simulate_many(
    controller: Any, plant: Any, x0s: Any, steps: int, *, reference: Any = None,
    input_reference: Any = None, variations: Mapping[str, Any] | None = None,
    chunk: int | None = None, progress: bool = False, devices: Any = None,
) -> Run:  # fmt: skip
    """Simulate closed loops from many initial states x0s (B, n); return NumPy arrays (B, ...).

    controller, plant, steps, reference, input_reference: as in `simulate`.
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
    if np.ndim(x0s) != 2 or not len(x0s):
        size = getattr(controller, "state_size", "n")
        fail("x0s", f"shape {np.shape(x0s)}", f"Give (B, {size}), B ≥ 1")
    x0s, variations = np.asarray(x0s), dict(variations or {})
    require_variations(plant, variations, len(x0s))
    if chunk is not None and chunk < 1:
        fail("chunk", f"{chunk}", "Give a count of at least 1")
    devices = chosen_devices(devices)
    checked_arguments(controller, plant, x0s[0], steps, reference, input_reference, None, None)
    shared = arrays((
        controller, as_argument(plant),
        *(None if v is None else np.asarray(v) for v in (reference, input_reference)),
    ))  # fmt: skip
    shared = jax.device_put(shared, placement(devices))
    rows = lambda start, size: jax.tree.map(
        lambda v: padded(np.asarray(v)[start : start + size], size), (x0s, variations)
    )
    part = lambda start, size: jax.device_put(rows(start, size), placement(devices, True))
    loops = _compiled_loops(int(steps), devices)
    size = divisible(min(chunk or len(x0s), len(x0s)), devices)
    while chunk is None and size > count(devices):
        if program_bytes(loops.program(*shared, *part(0, size))) <= 0.8 * device_bytes():
            break
        size = divisible(-(-size // 2), devices)
    runs = []
    with tqdm(total=len(x0s), unit=" loops", disable=not progress) as bar:
        for start in range(0, len(x0s), size):
            here = min(size, len(x0s) - start)
            runs.append(first_rows(loops(*shared, *part(start, size)), here))
            bar.update(here)
    return joined(runs)


def require_variations(plant: Any, variations: Mapping[str, Any], count: int) -> None:
    """Raise ValueError unless `count` plants can differ by these parameters."""
    for key, value in variations.items():
        if np.shape(value)[:1] != (count,):
            fail(f"variations[{key!r}]", f"shape {np.shape(value)}", f"Put {count} in front")
    if variations and not hasattr(plant, "vary"):
        fail("variations", f"given for a {type(plant).__name__}", "Give a Robot or LinearPlant")
    if variations:  # the plant checks names and shapes
        plant.vary(**{key: np.asarray(value)[0] for key, value in variations.items()})


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class ConstantPlant:
    """A plant that is no pytree: a constant of the compiled program, compared by identity."""

    plant: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConstantPlant) and self.plant is other.plant

    def __hash__(self) -> int:
        return id(self.plant)


def as_argument(plant: Any) -> Any:
    """Return the plant as an argument of `simulate_batch`: itself where it is a pytree."""
    return ConstantPlant(plant) if jax.tree_util.all_leaves([plant]) else plant


def simulate_batch(
    controller: Any, plant: Any, reference: Any, input_reference: Any, x0s: Array,
    variations: dict[str, Array], steps: int, checkpoint: bool = False,
) -> Run:  # fmt: skip
    """Simulate from x0s (B, n), loop i with entry i of the variations in its plant. Works inside
    jit, vmap and grad.

    plant: from `as_argument`. The rest is as in `simulate` and `simulate_many`.
    """
    plant = plant.plant if isinstance(plant, ConstantPlant) else plant

    def loop(x0: Array, varied: dict[str, Array]) -> Run:
        return simulate(
            controller, plant.vary(**varied) if varied else plant, x0, steps, reference=reference,
            input_reference=input_reference, checkpoint=checkpoint,
        )  # fmt: skip

    return jax.vmap(loop)(x0s, variations)


@functools.cache
def _compiled_loops(steps: int, devices: Devices) -> Compiled:
    loops = functools.partial(simulate_batch, steps=steps)
    return over_devices(loops, devices, (False, False, False, False, True, True))
