"""Loops that each instance of a batch leaves when it is done.

Under `jax.vmap` a plain `jax.lax.while_loop` runs until its slowest instance has finished, and all
others wait. `repeat_while` gathers, on the device, the instances that are still open into groups of
static size, advances a group at a time, and scatters the results back: the cost is that of the mean
number of steps, not of the largest. Nothing returns to the host in between.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_batching import custom_vmap

from jaxmpc.qp.modes import own_modes, varying

# Of a loop: see `repeat_while`.
Steps = Literal["short", "long", "stages"]
# Instances in a block on a CPU, whose data stay within the cache. (On GPUs blocks gain nothing.)
BLOCK = 128
# Instances in a group on a CPU at most, and when fewer are open; small batches are one group.
PART_CPU, FEW_CPU, SMALL_CPU = 512, 64, 128
# The same of loops with long steps, or that few instances of a batch enter; then of those over
# stages, always so many. (64 arms of 7 joints for 1 s: 1.23 s in groups of 32, 1.11 of 16, 1.17
# of 8.)
LONG_PART_CPU, LONG_FEW_CPU, STAGES_CPU = 64, 8, 16
# Instances in a group elsewhere: a quarter of the batch; when fewer are open a sixteenth of that,
# and so on, but not below LEAST, where a step costs little more than its launches. (H100,
# TurboMPC's problem, 4,096 at once: 2.6 µs a solve in one group, 1.6 in groups of 512, 1.2 of 1,024
# and 256.)
PART, SMALLER, LEAST = 4, 16, 256
# Instances on a GPU from which on the arithmetic, not the launches, takes the time.
LARGE = 16_384
# Length of masks from which on their true places are looked up.
LONG = 65_536


def group_sizes(batch: int, steps: Steps = "short") -> list[int]:
    """Return the sizes of the groups of a batch, from the largest; `steps` as in `repeat_while`.

    A batch of symbolic size (`jax.export`) is one group."""
    if not isinstance(batch, int):
        return [batch]
    if jax.default_backend() == "cpu":
        if steps == "stages":
            return [min(batch, STAGES_CPU)]
        if steps == "long":
            return [batch] if batch <= LONG_PART_CPU else [LONG_PART_CPU, LONG_FEW_CPU]
        return [batch] if batch <= SMALL_CPU else [min(batch, PART_CPU), FEW_CPU]
    if batch <= PART * LEAST:
        return [batch]
    sizes = [batch if steps == "stages" else -(-batch // PART)]
    while sizes[-1] > LEAST:
        sizes.append(max(-(-sizes[-1] // SMALLER), LEAST))
    return sizes


def in_blocks(
    function: Callable,
    constants: Any,
    data: Any,
    *,
    kernel: Callable | None = None,
    large: int | None = None,
) -> Any:
    """Return function(constants, data), for a batch on a CPU in blocks, one after the other.

    kernel: the same of a batch, (constants, data with the batch in front), as a kernel for NVIDIA
    GPUs. large: size of blocks elsewhere than on a CPU, None for no blocks. `function` must close
    over no arrays. A batch of constants makes no blocks.
    """
    one = custom_vmap(lambda constants, data: function(constants, data))

    @one.def_vmap
    @own_modes
    def _(size: int, in_batched: Any, constants: Any, data: Any) -> Any:
        axes = jax.tree.map(lambda b: 0 if b else None, in_batched[0])
        data = _broadcast(size, in_batched[1], data)
        together = lambda constants, data: jax.vmap(function, in_axes=(axes, 0))(constants, data)

        def blocks(block: int, constants: Any, data: Any) -> Any:
            if size <= block:
                return together(constants, data)
            missing = -size % block
            padded = lambda v: jnp.pad(v, ((0, missing), *[(0, 0)] * (v.ndim - 1)), mode="edge")
            grouped = jax.tree.map(lambda v: padded(v).reshape(-1, block, *v.shape[1:]), data)
            out = lax.map(lambda block: together(constants, block), grouped)
            return jax.tree.map(lambda v: v.reshape(-1, *v.shape[2:])[:size], out)

        small = not isinstance(size, int) or (size <= BLOCK and kernel is None)
        if any(jax.tree.leaves(in_batched[0])) or small:
            out = together(constants, data)
        else:
            others = {} if kernel is None else {"cuda": kernel}
            cpu, default = partial(blocks, BLOCK), partial(blocks, large or size)
            out = lax.platform_dependent(constants, data, cpu=cpu, default=default, **others)
        return out, jax.tree.map(lambda _: True, out)

    return one(constants, data)


def repeat_while(
    is_open: Callable, step: Callable, constants: Any, state: Any, steps: Steps = "short"
) -> Any:
    """Return `state` after state = step(constants, state) while is_open(state), a scalar.

    The functions must close over no arrays: what they read stands in `constants`. One instance is
    one `while_loop`. A batch, also one of nested `vmap`s, is worked off in groups (top of this
    file). steps: "long" where a step takes long or few instances are open at first; "stages" where
    it is a recursion over stages, which on a GPU takes as long for 4,096 instances as for 1,024.
    Not differentiable.
    """
    one = lambda constants, state: lax.while_loop(is_open, lambda s: step(constants, s), state)
    single, state = custom_vmap(one), varying(state, (constants, state))

    @single.def_vmap
    @own_modes
    def _(size: int, in_batched: Any, constants: Any, state: Any) -> Any:
        leaves, tree = jax.tree.flatten(constants)
        batched = tuple(jax.tree.leaves(in_batched[0]))
        state = _broadcast(size, in_batched[1], state)
        out = _in_groups(is_open, step, tree, batched, steps)(tuple(leaves), state)
        return out, jax.tree.map(lambda _: True, out)

    return single(constants, state)


def _in_groups(
    is_open: Callable, step: Callable, tree: Any, batched: tuple[bool, ...], steps: Steps
) -> Callable:
    """Return the loop for a batch, (leaves of the constants, states) → states. batched: which
    leaves have the batch axis."""
    axes = tuple(0 if b else None for b in batched)

    def run(leaves: tuple, state: Any) -> Any:
        size = jax.tree.leaves(state)[0].shape[0]
        if not size:
            return state
        advance = lambda leaves, state: step(jax.tree.unflatten(tree, leaves), state)
        many = jax.vmap(advance, in_axes=(axes, 0))
        open_ones = lambda state: jax.vmap(is_open)(state)

        def group(count: int, state: Any) -> Any:
            if count == size:
                found = many(leaves, state)
                still = open_ones(state)
                keep = lambda new, old: jnp.where(
                    still.reshape(-1, *[1] * (new.ndim - 1)), new, old
                )
                return jax.tree.map(keep, found, state)
            where = true_places(open_ones(state), count)
            taken = lambda v: v.at[where].get(mode="clip")
            part = tuple(taken(v) if b else v for v, b in zip(leaves, batched, strict=True))
            found = many(part, jax.tree.map(taken, state))
            put = lambda old, new: old.at[where].set(new, mode="drop")
            return jax.tree.map(put, state, found)

        counts = group_sizes(size, steps)
        for count, least in zip(counts, [*counts[1:], 0], strict=True):
            more = partial(lambda least, state: jnp.sum(open_ones(state)) > least, least)
            state = lax.while_loop(more, partial(group, count), state)
        return state

    batch = custom_vmap(run)

    @batch.def_vmap
    @own_modes
    def _(size: int, in_batched: Any, leaves: tuple, state: Any) -> Any:
        outer = in_batched[0]
        state = _broadcast(size, in_batched[1], state)
        mixed = any(o and not b for o, b in zip(outer, batched, strict=True))
        if mixed:
            # Each outer instance has constants that its inner batch shares: copies would not fit.
            out = jax.vmap(run, in_axes=(tuple(0 if o else None for o in outer), 0))(leaves, state)
        else:
            inner = jax.tree.leaves(state)[0].shape[1]
            merged = lambda v: v.reshape(size * inner, *v.shape[2:])
            flat = tuple(
                merged(v if o else jnp.broadcast_to(v, (size, *v.shape))) if b else v
                for v, b, o in zip(leaves, batched, outer, strict=True)
            )
            out = batch(flat, jax.tree.map(merged, state))
            out = jax.tree.map(lambda v: v.reshape(size, inner, *v.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return batch


def true_places(mask: Array, size: int) -> Array:
    """Return the first `size` places where mask (m,) is true as int32, filled up with m.

    (`jnp.nonzero` counts in int64 where 64-bit mode is on, which cannot be lowered where it is
    off.)"""
    m = mask.shape[0]
    rank = jnp.cumsum(mask, dtype=jnp.int32) - 1
    if m >= LONG:  # to look `size` of them up takes less than to put all m in their place
        wanted = jnp.arange(1, size + 1, dtype=jnp.int32)
        return jnp.searchsorted(rank + 1, wanted, method="scan_unrolled").astype(jnp.int32)
    place = jnp.where(mask, jnp.minimum(rank, size), size)
    return jnp.full(size, m, jnp.int32).at[place].set(np.arange(m, dtype=np.int32), mode="drop")


def _broadcast(size: int, batched: Any, tree: Any) -> Any:
    """Return the tree with `size` copies, in front, of each leaf that is not `batched`."""
    give = lambda v, b: v if b else jnp.broadcast_to(v, (size, *jnp.shape(v)))
    return jax.tree.map(give, tree, batched)
