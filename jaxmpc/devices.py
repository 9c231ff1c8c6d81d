"""Several devices: a program for a batch becomes one in which each device works on its own part.

The batch axis is divided among the devices of a one-dimensional mesh, all other data are whole on
each of them. The programs hold no collectives: a device leaves its data-dependent loops when its
own part is done, and waits for no other. What the parts have in common, such as the mean of a loss,
is computed on the host (`tuning/batch_mean.py`).

Under `jax.distributed` a process can read no array that lies on devices of another. So each process
calls with states of its own and with devices of its own, and has the results of these; no call
waits for another process.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxmpc.checks import fail, shown, whole
from jaxmpc.compiled import Compiled
from jaxmpc.qp.modes import own_modes

# Devices to work on, None for JAX's default device alone.
Devices = tuple[jax.Device, ...] | None


def chosen_devices(devices: Any, name: str = "devices") -> Devices:
    """Return the devices that an argument `devices`, or another name, stands for.

    devices: None, the default device; a number, so many of `jax.local_devices()`; or a sequence of
    them. Raises ValueError for no device, for the same one twice, and for those of another process
    or of another platform than JAX's default backend.
    """
    if devices is None:
        return None
    there = jax.local_devices()
    if not isinstance(devices, Sequence | np.ndarray) or isinstance(devices, str):
        count = whole(name, devices, 1)
        if count > len(there):
            fail(name, f"{count} where this process has {len(there)}", "Give fewer")
        return tuple(there[:count])
    chosen = tuple(devices)
    if not chosen:
        fail(name, "an empty sequence", "Give at least one device, or None for the default")
    for device in chosen:
        if not isinstance(device, jax.Device):
            fail(name, f"holds {shown(device)}", "Give a number, or some of jax.devices()")
        if device.process_index != jax.process_index():
            fail(name, f"{device} is of another process", "Give some of jax.local_devices()")
        if device not in there:
            what = f"{device} is not of JAX's default backend, {there[0].platform}"
            fail(name, what, f"Set JAX_PLATFORMS={device.platform} for programs made for it")
    if len(set(chosen)) < len(chosen):
        fail(name, "the same one twice", "Give each once")
    return chosen


def require_partitioner(devices: Devices) -> None:
    """Raise ValueError where programs of labels cannot be compiled for these devices: on several
    GPUs XLA's Shardy partitioner crashes in the roll-out of `proofs.py` (JAX 0.11.2, H100)."""
    if devices is None or len(devices) < 2 or devices[0].platform != "gpu":
        return
    if getattr(jax.config, "jax_use_shardy_partitioner", False):
        what = "maps on several GPUs crash the partitioner that this process uses"
        fail("devices", what, "Set JAX_USE_SHARDY_PARTITIONER=false in the environment")


def count(devices: Devices) -> int:
    """Return the number of devices."""
    return 1 if devices is None else len(devices)


def divisible(size: int, devices: Devices) -> int:
    """Return the least number, not below `size`, that the devices can share equally."""
    return -(-size // count(devices)) * count(devices)


def placement(devices: Devices, batched: bool = False) -> NamedSharding | None:
    """Return where `jax.device_put` puts a batch, a part on each device, or whole data; None is
    the default device."""
    if devices is None:
        return None
    spec = PartitionSpec("batch") if batched else PartitionSpec()
    return NamedSharding(Mesh(np.array(devices), ("batch",)), spec)


def over_devices(function: Callable, devices: Devices, batched: Sequence[bool]) -> Compiled:
    """Return the function of a batch as a compiled program over the devices.

    batched: of each argument, a pytree, whether its leaves have the batch axis in front, as all
    leaves of the result must. The size of the batch is a multiple of the number of devices. Each
    device gets an equal part, in order, of arguments on the host directly from there. devices None:
    the program for the default device.
    """
    function = own_modes(function)
    if devices is None:
        return Compiled(jax.jit(function))
    places: Any = tuple(placement(devices, each) for each in batched)
    out: Any = placement(devices, True)
    # Each device runs the function as it stands: nothing in it has to be known as replicated.
    parts = jax.shard_map(
        function, mesh=out.mesh, in_specs=tuple(place.spec for place in places),
        out_specs=out.spec, check_vma=False,
    )  # fmt: skip
    return Compiled(jax.jit(parts, in_shardings=places, out_shardings=out), places)
