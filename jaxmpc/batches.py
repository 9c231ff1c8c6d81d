"""Batches: programs compiled once for each shape, devices that share them, and parts of a batch.

Programs. `Compiled` compiles a function ahead, apart from running it, so that both can be timed.

Devices. Each has the program of one device, and a thread of its own that runs it on an equal part
of the batch; all other data are whole on each of them. No partitioner has a part in it, and no
collective: a device leaves its data-dependent loops when its own part is done, and waits for no
other. What the parts have in common, such as the mean of a loss, is computed on the host
(`tuning/batch_mean.py`). Under `jax.distributed` a process can
read no array that lies on devices of another. So each process calls with states of its own and with
devices of its own, and has the results of these; no call waits for another process.

Parts. A large batch goes through one program part by part (`each_part`, or another generator of
`Part`s), and `work_off` gives each result to a sink: a list, arrays, a store.
"""

import functools
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tqdm.std import tqdm

from jaxmpc.checks import fail, shown, whole
from jaxmpc.qp.jax_transformations import default_device, default_platform, own_modes

T = TypeVar("T")
R = TypeVar("R")


class Compiled:
    """A jitted function, compiled ahead once for each shape. `Compiled.seconds`: spent on that
    in this process so far. `Compiled.listeners`: called after each program.

    places: where `jax.device_put` puts each argument on several devices, `placement` whole or as a
    batch, of which each device gets a part; None for one device.
    """

    seconds = 0.0
    listeners: ClassVar[list[Callable[[], None]]] = []
    everyone: ClassVar["weakref.WeakSet[Compiled]"] = weakref.WeakSet()

    def __init__(self, function: Any, places: tuple[NamedSharding, ...] | None = None) -> None:
        self.function = function
        self.places = places
        self.programs: dict[Any, list[Any]] = {}
        self._compiles = threading.Lock()
        self.everyone.add(self)

    def __call__(self, *args: Any) -> Any:
        return to_host(self.run(*args))

    def run(self, *args: Any) -> Any:
        """Return the result, left on the device, or on the devices as a batch."""
        parts = self.parts(*args)
        return parts[0] if len(parts) == 1 else jax.tree.map(self._assembled, *parts)

    def parts(self, *args: Any) -> list[Any]:
        """Return what each device has of the result."""
        shares = self.shares(args)
        programs = self._programs(shares)
        # A program with a loop whose end depends on the data keeps its thread until the end.
        run = lambda i: programs[i](*shares[i])
        return side_by_side(run, range(len(shares)), len(shares))

    def shares(self, args: tuple) -> list[tuple]:
        """Return the arguments that each device gets: host arrays go to all of them at once."""
        if self.places is None:
            return [args]
        places, mesh = self.places, self.places[0].mesh
        devices: list[jax.Device] = list(mesh.devices.flat)

        def share(i: int) -> tuple:
            at = functools.partial(_share, device=devices[i], i=i, count=len(devices))
            return tuple(
                jax.tree.map(functools.partial(at, batched=bool(place.spec)), arg)
                for place, arg in zip(places, args, strict=True)
            )

        return side_by_side(share, range(len(devices)), len(devices))

    def program(self, *args: Any) -> Any:
        """Return the program for arguments of these shapes; of several devices, that of the
        first."""
        return self._programs(self.shares(args))[0]

    def _programs(self, shares: list[tuple]) -> list[Any]:
        """Return the program of each device."""
        leaves, tree = jax.tree.flatten(shares[0])
        key = tree, tuple(map(_kind, leaves)), default_device()
        with self._compiles:  # threads that need the same program wait for one of them
            if key not in self.programs:
                start = time.perf_counter()
                # Traced and lowered once; XLA compiles for each device.
                lowered = [self.function.lower(*share) for share in shares]
                compiled = side_by_side(lambda each: each.compile(), lowered, len(lowered))
                self.programs[key] = compiled
                Compiled.seconds += time.perf_counter() - start
                for listener in Compiled.listeners:
                    listener()
        return self.programs[key]

    def _assembled(self, *parts: jax.Array) -> jax.Array:
        """Return the batch that lies in these parts on the devices."""
        assert self.places is not None
        shape = sum(map(len, parts)), *parts[0].shape[1:]
        place = NamedSharding(self.places[0].mesh, PartitionSpec("batch"))
        return jax.make_array_from_single_device_arrays(shape, place, list(parts))


def _kind(leaf: Any) -> tuple:
    """Return what a program is compiled for: type and shape, and where the argument has to stay."""
    stays = isinstance(leaf, jax.Array) and leaf.committed
    return jax.typeof(leaf), leaf.sharding if stays else None


def _share(v: Any, *, device: jax.Device, i: int, count: int, batched: bool) -> jax.Array:
    """Return part i of `count` of an array, or all of it where it is not batched, on its device."""
    if isinstance(v, jax.Array) and len(v.sharding.device_set) > 1:
        own = v.addressable_data(i)  # in the order of the mesh; `addressable_shards` takes longer
        if own.devices() == {device}:
            return own
        return next(part.data for part in v.addressable_shards if part.device == device)
    assert not batched or len(v) % count == 0  # see `divisible`
    size = len(v) // count if batched else 0
    return jax.device_put(v[i * size : (i + 1) * size] if batched else v, device)


@dataclass
class Timing:
    """Work done by this process, in a run that may have been resumed, and the time it took (s)."""

    count: int = 0
    compile_seconds: float = 0.0
    run_seconds: float = 0.0

    @contextmanager
    def work(self, count: int) -> Iterator[None]:
        """Add what is done meanwhile, on `count` items."""
        begun, compiled = time.perf_counter(), Compiled.seconds
        yield
        compiling = Compiled.seconds - compiled
        self.count += count
        self.compile_seconds += compiling
        self.run_seconds += time.perf_counter() - begun - compiling


def clear_programs() -> None:
    """Free all programs of this process, those of JAX's own caches too. What is called again
    compiles again."""
    for each in list(Compiled.everyone):
        with each._compiles:
            each.programs.clear()
    jax.clear_caches()


def program_bytes(program: Any) -> float:
    """Return the bytes that a compiled program needs for temporaries and output, on each device."""
    found = program.memory_analysis()
    return 0.0 if found is None else found.temp_size_in_bytes + found.output_size_in_bytes


def device_bytes() -> float:
    """Return the bytes of memory of the present device; on a CPU, of the machine."""
    found = jax.local_devices()[0].memory_stats()
    if found and "bytes_limit" in found:
        return found["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


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
    several = isinstance(devices, Sequence | np.ndarray) and not isinstance(devices, str)
    if not several or np.ndim(devices) == 0:
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


def count(devices: Devices) -> int:
    """Return the number of devices."""
    return 1 if devices is None else len(devices)


def divisible(size: int, devices: Devices) -> int:
    """Return the least number, not below `size`, that the devices can share equally."""
    return -(-size // count(devices)) * count(devices)


def placement(devices: Devices, batched: bool = False) -> Any:
    """Return the NamedSharding by which `jax.device_put` puts a batch, a part on each device, or
    whole data; None is the default device."""
    if devices is None:
        return None
    spec = PartitionSpec("batch") if batched else PartitionSpec()
    return NamedSharding(Mesh(np.array(devices), ("batch",)), spec)


def over_devices(function: Callable, devices: Devices, batched: Sequence[bool]) -> Compiled:
    """Return the function of a batch as a compiled program for each of the devices.

    batched: of each argument, a pytree, whether its leaves have the batch axis in front, as all
    leaves of the result must. The size of the batch is a multiple of the number of devices. Each
    device gets an equal part, in order, of arguments on the host directly from there. devices None:
    the program for the default device.
    """
    program = jax.jit(own_modes(function))
    if devices is None:
        return Compiled(program)
    return Compiled(program, tuple(placement(devices, each) for each in batched))


# Points a compiled program takes at once on a CPU: a step's data stay within the cache.
CHUNK = 8192
# Rows from which on a progress bar counts in thousands.
MANY_ROWS = 100_000


def default_chunk(numbers: float = 4096, most: int = 128 * CHUNK) -> int:
    """Return how many points a compiled program takes at once on the present device. numbers: of
    float64, that it holds of each; all of them take a quarter of the memory of a GPU at most.
    most: points at once, elsewhere than on a CPU."""
    if default_platform() == "cpu":
        return CHUNK
    fitting = device_bytes() / 4 / (8 * numbers)
    return 2 ** int(np.log2(np.clip(fitting, CHUNK, most)))


def cores() -> int:
    """Return the number of cores that this process may use."""
    # Linux knows which.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def workers() -> int:
    """Return how many chunks to run side by side: one a core of a CPU, whose programs use little
    more than one, for most of their steps are too small to be divided; one on other devices."""
    return cores() if default_platform() == "cpu" else 1


def side_by_side(
    call: Callable[[Any], Any], items: Iterable[Any], count: int | None = None
) -> list[Any]:
    """Return [call(item) for item in items], `count` at once, by default as many as `workers`.

    `call` runs in threads of its own, which see of the caller's JAX contexts 64-bit mode alone.
    """
    items, count = list(items), workers() if count is None else count
    if min(count, len(items)) < 2:
        return [call(item) for item in items]
    mode = jnp.result_type(float) == jnp.float64

    def in_mode(item: Any) -> Any:
        with jax.enable_x64(mode):
            return call(item)

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(in_mode, items))


def gather_size(chunk: int) -> int:
    """Size of the batches in which undecided points of a chunk go on: one, so that few compile."""
    return max(chunk // 16, 64)


def program_size(count: int) -> int:
    """Return how many instances a program is compiled for that takes `count` ≥ 1: a power of two
    from 8 to 128, above that a multiple of an eighth of one. So calls with any numbers of states
    need few programs, which take seconds to compile."""
    power = 1 << max(count - 1, 7).bit_length()
    step = power // 16 if power > 128 else power
    return -(-count // step) * step


def padded(x: np.ndarray, size: int) -> np.ndarray:
    """The first row repeated up to `size` rows."""
    if len(x) == size:
        return x
    return np.concatenate([x, np.broadcast_to(x[:1], (size - len(x), *x.shape[1:]))])


def first_rows(tree: Any, count: int) -> Any:
    """The leaves without what `padded` added."""
    return jax.tree.map(lambda v: v[:count], tree)


def joined(parts: Sequence[Any], out: Any = None) -> Any:
    """Return the host arrays of pytrees one after the other, copied by several threads: a single
    one is slower than a fast device. out: arrays to write into, in place of new ones; what goes
    beyond their end is left out."""
    leaves = list(zip(*map(jax.tree.leaves, parts), strict=True))  # the parts of each
    if out is None:
        whole = [np.empty((sum(map(len, vs)), *vs[0].shape[1:]), vs[0].dtype) for vs in leaves]
    else:
        whole = jax.tree.leaves(out)
    copies = []
    for here, vs in zip(whole, leaves, strict=True):
        for end, v in zip(np.cumsum([len(v) for v in vs]), vs, strict=True):
            rows = max(COPIED // max(v[:1].nbytes, 1), 1)
            target = here[end - len(v) : end]
            copies += [(target[some], v[: len(target)][some]) for some in slices(len(v), rows)]
    large = sum(target.nbytes for target, _ in copies) > COPIED
    side_by_side(lambda pair: np.copyto(*pair), copies, min(cores(), COPIERS) if large else 1)
    return jax.tree.unflatten(jax.tree.structure(parts[0]), whole)


# Bytes that a thread copies at once, and the most threads, which take turns with all others.
COPIED, COPIERS = 2**26, 32
# Bytes of an array from which on it goes to the host through pinned memory.
PINNED = 2**20


def to_host(tree: T) -> T:
    """Return the tree with leaves of NumPy. Large arrays go through pinned memory where the device
    has it, which an array then keeps: 50 GB/s from an H100, beside 1 to 3 through pageable memory.
    """
    parts = host_parts(tree)
    return parts[0] if len(parts) == 1 else joined(parts)


def host_parts(tree: T) -> list[T]:
    """Return `to_host` of a batch that lies on several devices device by device, in order, so that
    it need not be copied to be joined; of one device, or of other leaves, the whole."""
    leaves, structure = jax.tree.flatten(tree)
    parts = [_shards(v) for v in leaves]
    count = max(map(len, parts), default=1)
    if any(len(part) != count for part in parts):
        parts, count = [[v] for v in leaves], 1
    return host_copies([jax.tree.unflatten(structure, [v[i] for v in parts]) for i in range(count)])


def host_copies(trees: list[T]) -> list[T]:
    """Return these trees with leaves of NumPy. All copies begin before the first is waited for."""
    begun = jax.tree.map(lambda v: _begin_copy(v) if isinstance(v, jax.Array) else v, trees)
    return jax.tree.map(np.asarray, begun)


def _begin_copy(v: jax.Array) -> jax.Array:
    if v.nbytes >= PINNED and _has_pinned(next(iter(v.sharding.device_set))):
        return jax.device_put(v, v.sharding.with_memory_kind("pinned_host"))
    v.copy_to_host_async()
    return v


@functools.cache
def _has_pinned(device: jax.Device) -> bool:
    """Return whether the device copies to pinned memory of the host; a CPU needs none."""
    kinds = {memory.kind for memory in device.addressable_memories()}
    return device.platform != "cpu" and "pinned_host" in kinds


def _shards(v: Any) -> list[Any]:
    """Return the parts of a batch on several devices, in order, each of one; else the whole."""
    several = isinstance(v, jax.Array) and len(v.sharding.device_set) > 1
    if not several or v.sharding.is_fully_replicated:
        return [v]
    shards = sorted(v.addressable_shards, key=lambda part: part.index[0].start or 0)
    return [part.data for part in shards]


class Part(NamedTuple, Generic[R]):
    """The results of a part of a batch: its place (a slice of the rows, or a block of a store), the
    number of its rows, and the seconds that compiling took."""

    place: Any
    size: int
    result: R
    compile_seconds: float = 0.0


def slices(total: int, size: int) -> list[slice]:
    """Return the slices of so many rows in parts of `size`, the last of which may be smaller."""
    return [slice(i, min(i + size, total)) for i in range(0, total, size)]


def each_part(program: Callable[[Any], R], rows: Any, size: int) -> Iterator[Part[R]]:
    """Yield program(part) of a pytree of host arrays (B, ...), `size` rows at once: the last part
    is filled up with its first row, and its results are without that."""
    for here in slices(len(jax.tree.leaves(rows)[0]), size):
        part = jax.tree.map(lambda v, here=here: padded(np.asarray(v)[here], size), rows)
        compiled, count = Compiled.seconds, here.stop - here.start
        result = first_rows(program(part), count)
        yield Part(here, count, result, Compiled.seconds - compiled)


def work_off(
    parts: Iterable[Part[R]],
    sink: Callable[[Part[R]], str | None],
    total: int,
    *,
    unit: str,
    progress: bool | None = False,
    deadline: float = np.inf,
) -> Timing:
    """Give each part to a sink as soon as it is there, until all are or the deadline has passed.

    The sink may return a note for the progress bar, which counts the `total` rows: shown where
    `progress` is True, or None and stderr is a terminal. deadline: of `time.monotonic`. Returns the
    rows that were done, the seconds that compiling took, and those of all the rest.
    """
    begun, timing = time.perf_counter(), Timing()
    hidden = None if progress is None else not progress
    with tqdm(total=total, unit=f" {unit}", unit_scale=total >= MANY_ROWS, disable=hidden) as bar:
        for part in parts:
            bar.set_postfix_str(sink(part) or "", refresh=False)
            bar.update(part.size)
            timing.count += part.size
            timing.compile_seconds += part.compile_seconds
            if time.monotonic() > deadline:
                break
    timing.run_seconds = time.perf_counter() - begun - timing.compile_seconds
    return timing
