"""Maps labelled by processes, by Dask and by Ray: the same bits, also where workers die or dawdle.

    pip install dask distributed ray
    python experiments/executors.py

labels the 65,536 states of the joint in 64 parts, without an executor and by two workers each of

* `concurrent.futures.ProcessPoolExecutor`, start method spawn;
* Dask: `Client.get_executor()` of a local cluster of processes;
* Ray, by the adapter below;

left alone, with one worker that sleeps for half a second before each part, and with one that is
killed after the tenth part. A pool of processes does not outlive one of them: there a stored sweep
goes on with a new pool. Kinds that are not installed are left out.
"""

import multiprocessing
import os
import signal
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, redirect_stdout
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import jaxmpc as jm
from jaxmpc import store
from jaxmpc.app.commands import sweep
from jaxmpc.app.config import load

CHUNK = 1024


class RayExecutor:
    """Ray with the interface of `concurrent.futures`."""

    def submit(self, function: Any, *arguments: Any) -> Any:
        import ray

        return ray.remote(function).remote(*arguments).future()


def noted(folder: str, function: Any, *arguments: Any) -> tuple[int, Any]:
    """Return the id of this process and what the function returns; the process that has made
    folder/slow sleeps first."""
    pid, slow = os.getpid(), Path(folder) / "slow"
    if slow.parent.exists():
        try:
            slow.touch(exist_ok=False)
            slow.write_text(str(pid))
        except FileExistsError:
            pass
        if slow.read_text() == str(pid):
            time.sleep(0.5)
    return pid, function(*arguments)


class Noting:
    """An executor that counts which process labels how many parts, and kills one of them.

    kill: after so many parts, None for never. slow: folder in which a process that is slow says so.
    """

    def __init__(self, executor: Any, kill: int | None = None, slow: str = "/nowhere"):
        self.executor, self.kill, self.slow = executor, kill, slow
        self.parts = Counter[int]()

    def submit(self, function: Any, *arguments: Any) -> Any:
        future = self.executor.submit(noted, self.slow, function, *arguments)

        def result() -> Any:
            pid, found = future.result()
            self.parts[pid] += 1
            if self.parts.total() == self.kill:
                os.kill(pid, signal.SIGKILL)
            return found

        return SimpleNamespace(result=result, cancel=future.cancel)


@contextmanager
def processes() -> Iterator[Any]:
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


@contextmanager
def dask() -> Iterator[Any]:
    import dask.config
    from distributed import Client, LocalCluster

    # Tasks are sent to workers at once, so that an idle worker has to steal.
    settings = {"distributed.scheduler.worker-saturation": float("inf")}
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client.get_executor()
        stolen = cluster.scheduler.get_events("stealing")
        print(f"  Dask: {len(stolen)} rounds of work stealing")


@contextmanager
def ray() -> Iterator[Any]:
    import ray as ray_

    ray_.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    try:
        yield RayExecutor()
    finally:
        ray_.shutdown()


KINDS = {"processes": (processes, ""), "Dask": (dask, "distributed"), "Ray": (ray, "ray")}


def the_same(found: Any, expected: Any) -> bool:
    """Return whether labels and proofs agree bit for bit."""
    names = ("label", "status", "start", "plan", "cut_normal", "cut_offset")
    return all(
        np.array_equal(
            getattr(found, name), getattr(expected, name), equal_nan=name not in names[:2]
        )
        for name in names
    )


def main() -> None:
    config = load(None, {})
    mpc = config.build_mpc()
    points = jm.grid([-1.59, -2.12], [1.59, 2.12], (256, 256))
    jm.map_feasible_set(mpc, points[:CHUNK], chunk=CHUNK)
    begun = time.perf_counter()
    expected = jm.map_feasible_set(mpc, points, chunk=CHUNK).labels
    print(f"without an executor: {time.perf_counter() - begun:.2f} s")
    for name, (kind, needs) in KINDS.items():
        if needs and not find_spec(needs):
            print(f"{name}: not installed")
            continue
        for what in ("first", "again", "one slow", "one killed"):
            with tempfile.TemporaryDirectory() as folder, kind() as executor:
                if what != "first":  # programs are compiled
                    jm.map_feasible_set(mpc, points[: 8 * CHUNK], chunk=CHUNK, executor=executor)
                kill = 10 if what == "one killed" else None
                noting = Noting(executor, kill, folder if what == "one slow" else "/nowhere")
                begun = time.perf_counter()
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    try:
                        found = jm.map_feasible_set(
                            mpc, points, chunk=CHUNK, executor=noting
                        ).labels
                        verdict = "the same bits" if the_same(found, expected) else "OTHER BITS"
                    except BrokenProcessPool as error:
                        verdict = f"ends in {type(error).__name__}"
                again = sum("submitted again" in str(w.message) for w in caught)
                print(
                    f"{name}, {what}: {verdict}, {time.perf_counter() - begun:.2f} s, parts by "
                    f"process {sorted(noting.parts.values())}, {again} submitted again", flush=True
                )  # fmt: skip
    stored(config)


def stored(config: Any) -> None:
    """Label a stored sweep by pools of processes, the first of which dies; compare the files."""
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()) as text:
        first, second = Path(folder) / "alone", Path(folder) / "pools"
        sweep.linear_sweep(config, first, chunk=CHUNK)
        lost = 0
        for kill in (20, None):
            before = lost
            with processes() as pool:
                try:
                    executor = Noting(pool, kill)
                    how = {"resume": bool(lost), "chunk": CHUNK}
                    sweep.linear_sweep(config, second, executor=executor, **how)
                except BrokenProcessPool:
                    there = store.read(second / "sweep.zarr")
                    lost = there.blocks - there.done
        alone, pools = (store.read(path / "sweep.zarr").arrays for path in (first, second))
        same = all(np.array_equal(alone[k], v, equal_nan=v.dtype.kind == "f") for k, v in
                   pools.items() if v.dtype.kind in "fiu")  # fmt: skip
        seen = f"{before} of 64 blocks were left when the first pool died; "
    print(f"stored sweep: {seen}{'the same arrays' if same else 'OTHER ARRAYS'}")
    assert text


if __name__ == "__main__":
    main()
