"""What JAX's modes and transformations make of a program: rules, and loops of batches.

Modes. A user may forbid implicit promotion of ranks or types, call from inside `jax.shard_map`,
whose default is to check over which mesh axes each value varies, or from under a mesh with explicit
axes, where every array has its sharding as a part of its type. None of these is a property of the
problem solved. `own_modes` sets them aside for the time a program is traced. What JAX traces later,
rules of batching and of derivatives, has the decorator too.

Batches. Under `jax.vmap` a plain `jax.lax.while_loop` runs until its slowest instance has finished,
and all others wait. `repeat_while` gathers, on the device, the instances that are still open into
groups of static size, advances a group at a time, and scatters the results back: the cost is that
of the mean number of steps, not of the largest. Nothing returns to the host in between.
`attempted_first` keeps most instances of a batch on a CPU out of such loops: what few steps solve
is solved from beginning to end in blocks whose data stay in the cache.

Derivatives. `implicit` gives the solution of a problem those of its optimality conditions.
"""

import functools
import importlib
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.sharding import (
    AbstractMesh,
    AxisType,
    NamedSharding,
    PartitionSpec,
    auto_axes,
    get_abstract_mesh,
)

from jaxmpc.arrays import all_finite
from jaxmpc.checks import concrete

T = TypeVar("T")
C = TypeVar("C")
S = TypeVar("S")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

# Maps tangents of the optimality conditions to tangents of (z, y) that undo them; linear.
Undo = Callable[[Any], tuple[Array, Array]]
Conditions = Callable[[Any, Any, Array, Array], tuple[Callable[[Any], Any], Undo]]
# Of a loop: see `repeat_while`.
Steps = Literal["short", "long", "recursion"]
# Instances in a block on a CPU, whose data stay within the cache. (On GPUs blocks gain nothing.)
BLOCK = 128
# Instances in a group on a CPU. (Of 2,000 states of springs8 nine take 12 to 71 steps on the dual,
# for which the others of their group wait.)
GROUP_CPU = 4
# The same of "long" loops of larger batches at first, as where all of their instances enter.
# (Margins of 20 rows in 6 variables, 1,000 at once: 82 µs each, 197 in groups of four alone.)
LONG_CPU = 64
# The same of recursions over a horizon, of any batch. (64 arms of 7 joints for 1 s: 1.23 s in
# groups of 32, 1.11 of 16, 1.17 of 8.)
RECURSION_CPU = 16
# Instances that an attempt left and that are solved as a whole at once there. (Plans of the joint
# from far off, 30 % of them infeasible: 63 µs a state with 16, 48 with 32.)
LEFT_CPU = 32
# Instances in a group elsewhere: a quarter of the batch; when fewer are open a sixteenth of that,
# and so on, but not below LEAST_GROUP, where a step costs little more than its launches. (H100,
# TurboMPC's problem, 4,096 at once: 2.6 µs a solve in one group, 1.6 in groups of 512, 1.2 of 1,024
# and 256.) Of recursions over a horizon the whole batch, a quarter, and an eighth of that. (4,096
# arms for 1 s: 1.31 s in groups of 4,096 and 256, 1.21 of 4,096, 1,024 and 128.)
GROUP_PART, SMALLER, LEAST_GROUP = 4, 16, 256
# Operations of a group's step there that take as long as its launches, where a step says how many
# it has an instance: of those with many, smaller groups are worth it, of FEWEST_WORKING at least.
LAUNCH_WORK, FEWEST_WORKING = 2**30, 32
# Instances on a GPU from which on the arithmetic, not the launches, takes the time.
LARGE_BATCH = 16_384
# Operations of a jaxpr that call a program once.
CALLS = {"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vmap_call", "remat"}
# Length of masks from which on their true places are looked up.
LONG_MASK = 65_536
# Most rows that a kernel takes: a program's registers hold no more.
MOST_KERNEL_ROWS = 512


def own_modes(function: F) -> F:
    """Return the function with JAX's usual promotions, with arguments and results that all vary
    over the same axes of a `shard_map`, and without explicit axes: sharded along a batch, as
    `jax.vmap` has it, or not at all."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            mesh = _explicit_mesh(args)
            if mesh is not None:
                return _without_explicit_axes(functools.partial(function, **kwargs), args, mesh)
            return varying(function(*varying(args, args), **kwargs), args)

    return run  # type: ignore[return-value]


def on_host(function: F) -> F:
    """Return a function of known data, which is not traced, such that it may be called while
    another one is traced too, as by `jax.jit`, and computes its result then and there."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        if not concrete((args, kwargs)):  # it says what it has to be told
            return function(*args, **kwargs)
        # (`jax.ensure_compile_time_eval` would fold constants in the kernels too that it compiles.)
        with jax.core.eval_context():
            return function(*args, **kwargs)

    return run  # type: ignore[return-value]


def _explicit_mesh(args: tuple) -> AbstractMesh | None:
    """Return the mesh with explicit axes, of the context or of an argument, None for none.

    (Arrays keep their sharding as a part of their type where no `jax.set_mesh` is in force.)"""
    arrays = [v for v in jax.tree.leaves(args) if isinstance(v, jax.Array)]
    meshes = [get_abstract_mesh(), *(jax.typeof(v).sharding.mesh for v in arrays)]
    return next((mesh for mesh in meshes if AxisType.Explicit in mesh.axis_types), None)


def _without_explicit_axes(function: Callable[..., Any], args: tuple, mesh: AbstractMesh) -> Any:
    leaves, tree = jax.tree.flatten(args)
    places = [i for i, v in enumerate(leaves) if isinstance(v, jax.Array)]  # not what is static

    def call(*arrays: Any) -> Any:
        given = dict(zip(places, arrays, strict=True))
        full = [given.get(i, v) for i, v in enumerate(leaves)]
        return function(*jax.tree.unflatten(tree, full))

    everywhere = NamedSharding(mesh, PartitionSpec())
    return auto_axes(call, out_sharding=everywhere)(*(leaves[i] for i in places))


def varying(tree: T, like: Any) -> T:
    """Return the tree, varying over those axes of a `shard_map` over which `like` does.

    What a loop carries must do so from the start; constants such as zeros do not.
    """
    axes = frozenset[str]().union(*map(_axes, jax.tree.leaves(like)))
    if not axes:
        return tree

    def cast(v: Any) -> Any:
        missing = tuple(axes - _axes(v)) if isinstance(v, jax.Array) else ()
        return jax.lax.pcast(v, missing, to="varying") if missing else v

    return jax.tree.map(cast, tree)


def _axes(v: Any) -> frozenset[str]:
    """Return the axes over which a value varies."""
    if not isinstance(v, jax.core.Tracer):
        return frozenset()
    kind = jax.typeof(v)
    return kind.mat.varying if hasattr(kind, "mat") else getattr(kind, "vma", frozenset())


def compiled_lightly(level: int, **options: Any) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Return the decorator `jax.jit(…, **options)` for programs that run one by one: on a CPU LLVM
    optimises them by `level` alone, 0 to 3, when they are called from plain Python.

    Optimising takes half the time of compiling. Level 0 doubles the time of a run: it is for what
    runs once a problem. Level 1 does not.
    """

    def decorate(function: Callable[..., R]) -> Callable[..., R]:
        whole = jax.jit(function, **options)
        light = jax.jit(
            function, compiler_options={"xla_backend_optimization_level": level}, **options
        )

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> R:
            # JAX refuses options of the compiler inside another program.
            alone = default_platform() == "cpu" and concrete(args)
            return light(*args, **kwargs) if alone else whole(*args, **kwargs)

        return call

    return decorate


def differentiated_apart(tree: T) -> T:
    """Return the tree; on a GPU XLA does not fuse its derivatives with what follows.

    The derivative with respect to what a batch shares is a sum over the batch. In one kernel with
    other results that took ten times as long as in its own (H100, XLA of JAX 0.11).
    """
    return _apart(tree) if default_platform() == "gpu" else tree


@jax.custom_jvp
def _apart(tree: T) -> T:
    return tree


@_apart.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    return *primals, lax.optimization_barrier(*tangents)


def called_jaxpr(eqn: Any) -> ClosedJaxpr | None:
    """Return the program that an operation of a jaxpr calls once, None where it calls none."""
    for name in ("jaxpr", "call_jaxpr", "call"):
        if name in eqn.params and eqn.primitive.name in CALLS:
            inner = eqn.params[name]
            return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
    return None


def with_derivative_of(slow: Callable[..., R], fast: Callable[..., R]) -> Callable[..., R]:
    """Return `fast`, which computes what `slow` does, with the derivative of `slow`; arguments that
    only `fast` has keep their defaults."""
    # (The rule below is given the defaults of what it is a rule of, too.)
    found = jax.custom_jvp(lambda *args: fast(*args))
    # The value is that of `fast` here too: under `vmap` within `jit` JAX takes the place of the
    # batch axis from the function as it stands, and `slow` might put it elsewhere.

    @found.defjvp
    @own_modes
    def _(primals: tuple, tangents: tuple) -> tuple[R, R]:
        return kept_whole(found)(*primals), jax.jvp(slow, primals, tangents)[1]

    return found


def tree_where(condition: Array, a: T, b: T) -> T:
    """Return `jnp.where(condition, a, b)` for each leaf of two trees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), a, b)


def default_device() -> jax.Device | str | None:
    """Return the value of `jax.default_device`, of which JAX's stubs do not know where it is read.
    Traces are remembered by it."""
    config: Any = jax.config
    return config.jax_default_device


def default_platform() -> str:
    """Return the platform on which programs run by default, "cpu" or "gpu": that of
    `jax.default_device`, else of JAX's default backend."""
    device = default_device()
    name = jax.default_backend() if device is None else getattr(device, "platform", device)
    return "gpu" if name in ("cuda", "rocm") else name


def on_gpu() -> bool:
    """Return whether programs run by default on a GPU for which there are kernels."""
    return default_platform() == "gpu" and has_compiler()


def has_kernels(rows: int) -> bool:
    """Return whether programs run on such a GPU and kernels take so many rows."""
    return on_gpu() and 0 < rows <= MOST_KERNEL_ROWS


@functools.cache
def has_jax_triton() -> bool:
    """Return whether jax-triton is installed, which compiles the kernels."""
    return _can_import("jax_triton") and _can_import("triton")


@functools.cache
def has_compiler() -> bool:
    """Return whether something compiles kernels: jax-triton, or the Triton backend of Pallas, which
    a later JAX may lack. Without both a warning says once what that costs."""
    if has_jax_triton() or _can_import("jax.experimental.pallas.triton"):
        return True
    what = "jax-triton is not installed, so no GPU kernel runs and plans take 8 to 10 times as long"
    cure = "pip install jax-triton, which the extras cuda12 and cuda13 of jaxmpc do"
    warnings.warn(f"jaxmpc: {what}. Install it: {cure}", stacklevel=2)
    return False


def _can_import(module: str) -> bool:
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True


def group_sizes(batch: int, steps: Steps = "short", work: int = 0) -> list[int]:
    """Return the sizes of the groups of a batch, from the largest; `steps` and `work` as in
    `repeat_while`.

    A batch of symbolic size (`jax.export`) is one group."""
    if not isinstance(batch, int):
        return [batch]
    if default_platform() == "cpu":
        if steps == "long" and batch > LONG_CPU:
            return [LONG_CPU, GROUP_CPU]
        return [min(batch, RECURSION_CPU if steps == "recursion" else GROUP_CPU)]
    least = min(max(LAUNCH_WORK // max(work, 1), FEWEST_WORKING), LEAST_GROUP)
    if batch <= GROUP_PART * least:
        return [batch]
    if steps == "recursion":
        return [batch, -(-batch // GROUP_PART), -(-batch // (8 * GROUP_PART))]
    sizes = [-(-batch // GROUP_PART)]
    while sizes[-1] > least:
        sizes.append(max(-(-sizes[-1] // SMALLER), least))
    return sizes


def batched_by(rule: Callable[..., R], function: Callable[..., R]) -> Callable[..., R]:
    """Return the function, whose `vmap` is rule(size, in_batched, *arguments): the results with a
    batch in front of each. in_batched: whether it is in front of each leaf of the arguments.

    Where it is in front of none, as in derivatives of which the tangents alone have a batch, there
    is no rule. (JAX is given leaves alone: it fails to differentiate forward through a rule with
    None among its arguments.)
    """

    def call(*arguments: Any) -> R:
        leaves, tree = jax.tree.flatten(arguments)
        given = lambda leaves: jax.tree.unflatten(tree, leaves)
        one = custom_vmap(lambda *leaves: function(*given(leaves)))

        @one.def_vmap
        @own_modes
        def _(size: int, in_batched: list[bool], *leaves: Any) -> tuple[R, Any]:
            batched = any(in_batched)
            args = given(leaves)
            out = rule(size, given(in_batched), *args) if batched else function(*args)
            return out, jax.tree.map(lambda _: batched, out)

        return one(*leaves)

    return call


def kept_whole(function: Callable[..., R]) -> Callable[..., R]:
    """Return a function that has rules of derivatives, as one which keeps them.

    Where a loop is linearised, as for reverse mode, JAX below 0.12 forgets the rules of what it
    computes before: derivatives of these derivatives would be those of the function as written. An
    operation of its own is not taken apart. (One with a rule of batching alone is not either, but
    a derivative of that is one operation too, which reverse mode cannot divide.) Its derivative is
    that of the function, whose rule has to call it in turn for its results.
    """

    def call(*arguments: Any) -> R:
        leaves, tree = jax.tree.flatten(arguments)
        if concrete(leaves):
            return function(*arguments)
        flat = lambda *leaves: function(*jax.tree.unflatten(tree, leaves))
        program, shapes = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        return jax.tree.unflatten(jax.tree.structure(shapes), _whole(program, leaves))

    return call


def kept_unvarying(function: Callable[..., R]) -> Callable[..., R]:
    """Return a function that fails inside `jax.shard_map` under its check, as one that does not.

    For functions of other libraries whose loops and branches give what varies over the axes of the
    mesh in one place, and what does not in another. It is traced apart from the mesh, as one
    operation, whose results vary as the arguments together do. It has no derivatives there.
    """

    def call(*arguments: Any) -> R:
        leaves, tree = jax.tree.flatten(arguments)
        if not any(map(_axes, leaves)):
            return function(*arguments)
        flat = lambda *leaves: function(*jax.tree.unflatten(tree, leaves))
        bare = [jax.ShapeDtypeStruct(jnp.shape(v), jnp.result_type(v)) for v in leaves]
        program, shapes = jax.make_jaxpr(flat, return_shape=True)(*bare)
        found = unvarying_p.bind(*map(jnp.asarray, leaves), program=program)
        return varying(jax.tree.unflatten(jax.tree.structure(shapes), found), arguments)

    return call


unvarying_p = Primitive("kept_unvarying")
unvarying_p.multiple_results = True


@unvarying_p.def_abstract_eval
def _(*arguments: Any, program: ClosedJaxpr) -> Any:
    return program.out_avals


def _batched_unvarying(arguments: Any, axes: Any, *, program: ClosedJaxpr) -> tuple[Any, Any]:
    run = jax.vmap(jaxpr_as_fun(program), in_axes=tuple(axes))
    bare = [jax.ShapeDtypeStruct(jnp.shape(v), jnp.result_type(v)) for v in arguments]
    out = unvarying_p.bind(*arguments, program=jax.make_jaxpr(run)(*bare))
    return out, [0] * len(out)


def _lowered_unvarying(ctx: Any, *arguments: Any, program: ClosedJaxpr) -> Any:
    bare = ctx.replace(avals_in=program.in_avals)
    return mlir.lower_fun(jaxpr_as_fun(program), multiple_results=True)(bare, *arguments)


batching.primitive_batchers[unvarying_p] = _batched_unvarying
mlir.register_lowering(unvarying_p, _lowered_unvarying)


whole_p = Primitive("kept_whole")
whole_p.multiple_results = True


def _whole(program: ClosedJaxpr, arguments: Any) -> list[Array]:
    # What the function closes over may be traced: arguments too.
    names = [*program.jaxpr.constvars, *program.jaxpr.invars]
    jaxpr = program.jaxpr.replace(
        constvars=[], invars=names, debug_info=program.jaxpr.debug_info.with_unknown_names()
    )
    return whole_p.bind(*program.consts, *arguments, program=ClosedJaxpr(jaxpr, ()))


@whole_p.def_impl
def _run_whole(*arguments: Array, program: ClosedJaxpr) -> list[Array]:
    return jaxpr_as_fun(program)(*arguments)


@whole_p.def_abstract_eval
def _(*arguments: Any, program: ClosedJaxpr) -> Any:
    return program.out_avals


def _moved_whole(primals: Any, tangents: Any, *, program: ClosedJaxpr) -> tuple[Any, Any]:
    """Return the results and their derivatives, by the function's own rule."""
    moving = [i for i, v in enumerate(tangents) if type(v) is not ad.Zero]

    def run(*moved: Array) -> list[Array]:
        given = list(primals)
        for i, v in zip(moving, moved, strict=True):
            given[i] = v
        return jaxpr_as_fun(program)(*given)

    pick = lambda values: tuple(values[i] for i in moving)
    found, change = jax.jvp(run, pick(primals), pick(tangents))
    still = lambda v: v.dtype == jax.dtypes.float0
    return found, [ad.Zero(jax.typeof(v)) if still(v) else v for v in change]


def _batched_whole(arguments: Any, axes: Any, *, program: ClosedJaxpr) -> tuple[Any, Any]:
    run = jax.vmap(jaxpr_as_fun(program), in_axes=tuple(axes))
    out = _whole(jax.make_jaxpr(run)(*arguments), arguments)
    return out, [0] * len(out)


ad.primitive_jvps[whole_p] = _moved_whole
batching.primitive_batchers[whole_p] = _batched_whole
mlir.register_lowering(whole_p, mlir.lower_fun(_run_whole, multiple_results=True))


def in_blocks(
    function: Callable[[C, S], R],
    constants: C,
    data: S,
    kernel: Callable[[C, S], R] | None = None,
    large: int | None = None,
) -> R:
    """Return function(constants, data), for a batch on a CPU in blocks, one after the other.

    kernel: the same of a batch, (constants, data with the batch in front), as a kernel for NVIDIA
    GPUs. large: size of blocks elsewhere than on a CPU, None for no blocks. `function` must close
    over no arrays. A batch of constants makes no blocks.
    """

    def rule(size: int, in_batched: tuple, constants: C, data: S) -> R:
        axes = jax.tree.map(lambda b: 0 if b else None, in_batched[0])
        data = broadcast(size, in_batched[1], data)
        together = jax.vmap(function, in_axes=(axes, 0))

        def blocks(block: int, constants: C, data: S) -> R:
            if size <= block:
                return together(constants, data)
            return map_blocks(partial(together, constants), data, block)

        small = not isinstance(size, int) or (size <= BLOCK and kernel is None)
        if any(jax.tree.leaves(in_batched[0])) or small:
            return together(constants, data)
        others = {} if kernel is None else {"cuda": kernel}
        cpu, default = partial(blocks, BLOCK), partial(blocks, large or size)
        return lax.platform_dependent(constants, data, cpu=cpu, default=default, **others)

    return batched_by(rule, function)(constants, data)


def attempted_first(
    attempt: Callable[..., tuple[R, Array]],
    whole: Callable[..., R],
    again: Callable[..., R],
    *arguments: Any,
) -> R:
    """Return whole(*arguments), differentiable; of a batch on a CPU what an attempt finds, where
    that will do.

    attempt(*arguments) returns such a result and whether it will do. It runs in blocks whose data
    stay in the cache; then `whole` runs in small groups of the instances that are left.
    again(result, *arguments): the same result, computed from itself, with its derivatives. The
    functions must close over no arrays, and the first two be programs of `jax.jit`, traced once.
    """

    def rule(size: int, in_batched: tuple, *arguments: Any) -> R:
        leaves, tree = jax.tree.flatten(arguments)
        batched = tuple(jax.tree.leaves(in_batched))

        def many(function: Callable[..., T]) -> Callable[..., T]:
            plain = lambda *leaves: function(*jax.tree.unflatten(tree, leaves))
            return jax.vmap(plain, in_axes=[0 if b else None for b in batched])

        if default_platform() != "cpu" or not isinstance(size, int) or 2 * size <= BLOCK:
            return many(whole)(*leaves)
        run = partial(_attempted, many(attempt), many(whole), batched)
        return _of_one_batch(run, batched)(*leaves)

    # (What has no batch must vary over the axes over which results of the rule do.)
    one = batched_by(rule, own_modes(whole))

    @jax.custom_jvp
    def found(*arguments: Any) -> R:
        return one(*arguments)

    @found.defjvp
    @own_modes
    def _(primals: tuple, tangents: tuple) -> tuple[R, R]:
        result = found(*primals)
        return result, jax.jvp(partial(again, result), primals, tangents)[1]

    return found(*arguments)


def _attempted(
    attempt: Callable[..., tuple[R, Array]],
    whole: Callable[..., R],
    batched: tuple[bool, ...],
    *leaves: Array,
) -> R:
    """Return `attempted_first` of a batch; the functions take all leaves, `batched` or not."""
    own = [v for v, b in zip(leaves, batched, strict=True) if b]

    def given(own: list[Array]) -> list[Array]:
        rest = iter(own)
        return [next(rest) if b else v for v, b in zip(leaves, batched, strict=True)]

    found, done = varying(map_blocks(lambda own: attempt(*given(own)), own), own)
    # Groups are filled up with copies of one that does not take long, or with different ones.
    size, short = len(done), true_places(done, 1)[0]
    others = jnp.where(short < size, short, np.arange(LEFT_CPU, dtype=np.int32))

    def solve_some(carry: tuple[R, Array]) -> tuple[R, Array]:
        where = true_places(carry[1], LEFT_CPU)
        group = taken(jnp.where(where < size, where, others), own)
        return put(where, carry, (whole(*given(group)), False))

    return lax.while_loop(lambda carry: jnp.any(carry[1]), solve_some, (found, ~done))[0]


def _of_one_batch(run: Callable[..., R], batched: tuple[bool, ...]) -> Callable[..., R]:
    """Return `run`, of whose arguments some are `batched`, which works a further batch off as one
    with the first."""

    def rule(size: int, outer: tuple[bool, ...], *leaves: Array) -> R:
        if any(o and not b for o, b in zip(outer, batched, strict=True)):
            # Each outer instance has constants that its inner batch shares: copies would not fit.
            axes = [0 if o else None for o in outer]
            return jax.vmap(run, in_axes=axes)(*leaves)
        every = list(zip(leaves, batched, outer, strict=True))
        inner = next(v.shape[1 if o else 0] for v, b, o in every if b)
        copies = lambda v, o: v if o else jnp.broadcast_to(v, (size, *v.shape))
        merged = lambda v: v.reshape(size * inner, *v.shape[2:])
        out = batch(*(merged(copies(v, o)) if b else v for v, b, o in every))
        return jax.tree.map(lambda v: v.reshape(size, inner, *v.shape[1:]), out)

    batch = batched_by(rule, own_modes(run))
    return batch


def map_blocks(many: Callable[[S], R], data: S, block: int = BLOCK) -> R:
    """Return many(data) of a batch, computed for blocks of so many instances one after the other.
    The last one is filled up with the last instance."""
    size = jax.tree.leaves(data)[0].shape[0]
    block = max(min(block, size), 1)
    missing = -size % block
    padded = lambda v: jnp.pad(v, ((0, missing), *[(0, 0)] * (v.ndim - 1)), mode="edge")
    grouped = jax.tree.map(lambda v: padded(v).reshape(-1, block, *v.shape[1:]), data)
    out = lax.map(many, grouped)
    return jax.tree.map(lambda v: v.reshape(len(v) * block, *v.shape[2:])[:size], out)


def repeat_while(
    is_open: Callable[[S], Array],
    step: Callable[[C, S], S],
    constants: C,
    state: S,
    steps: Steps = "short",
    work: int = 0,
) -> S:
    """Return `state` after state = step(constants, state) while is_open(state), a scalar.

    The functions must close over no arrays: what they read stands in `constants`. One instance is
    one `while_loop`. A batch, also one of nested `vmap`s, is worked off in groups (top of this
    file). steps: "long" where a step takes long or few instances are open at first; "recursion"
    where it is one over the stages of a horizon, which on a GPU takes as long for 4,096 instances
    as for 1,024. work: about how many operations a step of one instance has, where that is more
    than its launches take. Not differentiable.
    """
    advance = lambda constants, state: varying(step(constants, state), state)
    one = lambda constants, state: lax.while_loop(is_open, partial(advance, constants), state)

    def rule(size: int, in_batched: tuple, constants: C, state: S) -> S:
        leaves, tree = jax.tree.flatten(constants)
        batched = tuple(jax.tree.leaves(in_batched[0]))
        state = broadcast(size, in_batched[1], state)

        many = jax.vmap(
            lambda leaves, state: step(jax.tree.unflatten(tree, leaves), state),
            in_axes=(tuple(0 if b else None for b in batched), 0),
        )
        parts, structure = jax.tree.flatten(state)

        def run(*given: Array) -> S:
            constants, state = given[: len(leaves)], given[len(leaves) :]
            state = jax.tree.unflatten(structure, state)
            return _in_groups(jax.vmap(is_open), many, batched, constants, state, steps, work)

        both = *batched, *[True] * len(parts)
        return _of_one_batch(run, both)(*leaves, *parts)

    return batched_by(rule, one)(constants, varying(state, (constants, state)))


def _in_groups(
    open_ones: Callable[[S], Array],
    many: Callable[[tuple, S], S],
    batched: tuple[bool, ...],
    leaves: tuple,
    state: S,
    steps: Steps,
    work: int,
) -> S:
    """Return `repeat_while` of a batch. many: (leaves of the constants, states) → states after a
    step. batched: which leaves have the batch axis."""
    size = jax.tree.leaves(state)[0].shape[0]
    if not size:
        return state

    def advance_all(leaves: tuple, state: S) -> S:
        found, on = many(leaves, state), open_ones(state)
        choose = lambda new, old: jnp.where(on.reshape(-1, *[1] * (new.ndim - 1)), new, old)
        return jax.tree.map(choose, found, state)

    def while_more(least: Any, advance: Callable[[S], S], state: S, real: Any = True) -> S:
        more = lambda state: jnp.sum(open_ones(state) & real) > least
        # (Arrays without entries old versions of JAX take for constants.)
        return lax.while_loop(more, lambda state: varying(advance(state), state), state)

    def advance_group(count: int, least: int, state: S) -> S:
        """Return the states after steps of the first `count` open instances side by side: until no
        more than `least` are open, or, while others wait, a quarter of them has finished."""
        on = open_ones(state)
        where = true_places(on, count)
        part = tuple(taken(where, v) if b else v for v, b in zip(leaves, batched, strict=True))
        enough = jnp.where(jnp.sum(on) > count, count - max(count // 4, 1), least)
        # (Where fewer are open the group is filled up with copies of the last instance.)
        advance, real = partial(advance_all, part), where < len(on)
        return put(where, state, while_more(enough, advance, taken(where, state), real))

    counts = group_sizes(size, steps, work)
    for count, least in zip(counts, [*counts[1:], 0], strict=True):
        together = partial(advance_all, leaves)
        group = partial(advance_group, count, least)
        state = while_more(least, together if count == size else group, state)
    return state


def true_places(mask: Array, size: int) -> Array:
    """Return the first `size` places where mask (m,) is true as int32, filled up with m.

    (`jnp.nonzero` counts in int64 where 64-bit mode is on, which cannot be lowered where it is
    off.)"""
    m = mask.shape[0]
    rank = jnp.cumsum(mask, dtype=jnp.int32) - 1
    if m >= LONG_MASK:  # to look `size` of them up takes less than to put all m in their place
        wanted = jnp.arange(1, size + 1, dtype=jnp.int32)
        return jnp.searchsorted(rank + 1, wanted, method="scan_unrolled").astype(jnp.int32)
    place = jnp.where(mask, jnp.minimum(rank, size), size)
    return jnp.full(size, m, jnp.int32).at[place].set(np.arange(m, dtype=np.int32), mode="drop")


def taken(where: Array, tree: S) -> S:
    """Return the instances at these places of a batch; the last one at places beyond its end."""
    return jax.tree.map(lambda v: v.at[where].get(mode="clip"), tree)


def put(where: Array, tree: S, found: Any) -> S:
    """Return the batch with what was found at these places, but for those beyond its end."""
    at = lambda old, new: old.at[where].set(new, mode="drop")
    return jax.tree.map(at, tree, found)


def broadcast(size: int, batched: Any, tree: S) -> S:
    """Return the tree with `size` copies, in front, of each leaf that is not `batched`."""
    give = lambda v, b: v if b else jnp.broadcast_to(v, (size, *jnp.shape(v)))
    return jax.tree.map(give, tree, batched)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit(
    conditions_of: Conditions, data: Any, constants: Any, z: Array, y: Array
) -> tuple[Array, Array]:
    """Return the solution (z, y), given as constants, with its derivatives with respect to `data`.

    conditions_of(data, constants, z, y) gives the optimality conditions as a function of the data
    alone, with z, y and the active set fixed, and the function that maps a change of them to
    the change of (z, y) that undoes it.

    A solution that is not finite, as of a state that overflows, has the derivative zero: in the
    sums over a batch it would make those of all others NaN.
    """
    return z, y


@implicit.defjvp
@own_modes
def _implicit_jvp(conditions_of: Conditions, primals: tuple, tangents: tuple) -> tuple:
    data, constants, z, y = primals
    # As a result of this function, z and y carry the derivatives that higher orders need.
    z, y = kept_whole(partial(implicit, conditions_of))(data, constants, z, y)

    def moved(data: Any, constants: Any, z: Array, y: Array, change: Any) -> tuple[Array, Array]:
        sound = all_finite((z, y))
        z, y = (jnp.where(sound, v, 0.0) for v in (z, y))
        conditions, undo = conditions_of(data, constants, z, y)
        dz, dy = undo(jax.jvp(conditions, (data,), (change,))[1])
        return jnp.where(sound, dz, 0.0), jnp.where(sound, dy, 0.0)

    # Going backward, all but these arguments is computed then: kept, it would be several times as
    # much memory for each solve of a closed loop.
    dz, dy = jax.checkpoint(moved)(data, constants, z, y, tangents[0])
    # Without rows y is the same for a whole batch, and so must its change be: `vmap` of this rule
    # takes the axes of both from one of them.
    return (z, y), (dz, dy if y.size else jnp.zeros_like(y))
