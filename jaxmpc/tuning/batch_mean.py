"""BatchMean: means over a batch, and their derivatives, computed on one device or on several."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxmpc.batches import Devices, count, divisible, first_rows, over_devices, padded


class BatchMean:
    """A compiled function of a batch, (…, weights (B,)) → (means, each), over devices.

    means: a pytree of weighted means over the batch, derivatives of means too. each: a pytree of
    what belongs to each instance, (B, ...). batched: of each argument before the weights, whether
    it has the batch axis. Each device takes the means of its part, with weights that may be zero
    and not all of them are; the host joins them, Σ_k W_k mean_k / Σ_k W_k with W_k the weights of
    part k. The results are NumPy arrays. devices None: one program, for the default device.
    """

    def __init__(self, function: Callable, devices: Devices, batched: Sequence[bool]) -> None:
        self.devices, self.batched = devices, (*batched, True)

        def part(*args: Any) -> Any:
            means, each = function(*args)
            return jax.tree.map(lambda v: v[None], means), each

        self.compiled = over_devices(part, devices, self.batched)

    def __call__(self, *args: Any) -> tuple[Any, Any]:
        args, size = self.divided(args), len(args[-1])
        parts, each = self.compiled(*args)
        weights = np.asarray(args[-1]).reshape(count(self.devices), -1).sum(axis=1)
        used = weights > 0
        shares = weights[used] / weights.sum()
        # The mean of one part is itself, whatever it is.
        mean = lambda v: v[0] if len(v) == 1 else np.tensordot(shares, v[used], 1)
        return jax.tree.map(mean, parts), first_rows(each, size)

    def program(self, *args: Any) -> Any:
        """Return the program for arguments of these shapes."""
        return self.compiled.program(*self.divided(args))

    def traced(self, *args: Any) -> Any:
        """Return the jaxpr of a device for arguments of these shapes; nothing compiles, and
        `program` needs not trace again."""
        return self.compiled.function.trace(*self.compiled.shares(self.divided(args))[0]).jaxpr

    def divided(self, args: tuple) -> tuple:
        """Return the arguments with a batch that the devices can share equally: the first instance
        fills it up, with weight zero."""
        if self.devices is None:
            return args
        size = len(args[-1])
        whole = divisible(size, self.devices)
        fill = lambda v: padded(np.asarray(v), whole)
        filled = (
            jax.tree.map(fill, v) if batched else v
            for v, batched in zip(args, self.batched, strict=True)
        )
        *rest, weights = filled
        return *rest, np.where(np.arange(whole) < size, weights, weights.dtype.type(0))
