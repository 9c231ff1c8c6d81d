"""Labels of points, each with its proof."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from jax import Array

from jaxmpc.batches import cores, joined, side_by_side
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import Verdict
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status

# The arrays of `Labels` that may still be on the device, and the label that each of them proves.
PROOFS = {"start": 1, "plan": 1, "cut_normal": -1, "cut_offset": -1}
# The status of labels −1, 0 and 1.
STATUS = np.array([Status.PRIMAL_INFEASIBLE, Status.ITERATION_LIMIT, Status.SOLVED], np.int8)

T = TypeVar("T")


class OnDemand(Generic[T]):
    """Something, mostly an array, that is fetched once, when it is first used."""

    def __init__(self, fetch: Callable[[], T]) -> None:
        self._fetch: Callable[[], T] | None = fetch
        self._value: T | None = None

    def get(self) -> T:
        """Return it, and fetch it the first time."""
        if self._fetch is not None:
            self._value, self._fetch = self._fetch(), None
        assert self._value is not None
        return self._value


@record
class Labels:
    """Labels of b points and their proofs: a `Verdict` of each point, and its status.

    label (b,) int8: 1 proved feasible, −1 proved infeasible, 0 undecided. status (b,) int8:
    `Status` (NOT_RUN, NON_FINITE, or SOLVED / PRIMAL_INFEASIBLE / ITERATION_LIMIT for the three
    labels). compile_seconds, run_seconds: time spent compiling and running.

    proofs: the arrays `start`, `plan`, `cut_normal`, `cut_offset`, which may still be on the
    device, or not be made yet: each is fetched when it is first used.
    """

    label: np.ndarray
    status: np.ndarray
    proofs: Mapping[str, OnDemand[np.ndarray]]
    compile_seconds: float = 0.0
    run_seconds: float = 0.0

    def __repr__(self) -> str:
        counts = ", ".join(f"{n:,} {name}" for name, n in self.counts().items() if n)
        return f"Labels of {len(self.label):,} points: {counts or 'none'}"

    @property
    def start(self) -> np.ndarray:
        """Return x_0 (b, n) of the points proved feasible, NaN elsewhere."""
        return self.proofs["start"].get()

    @property
    def plan(self) -> np.ndarray:
        """Return inputs (b, N, m) that prove points feasible, NaN elsewhere. Where equalities tie
        inputs to states the inputs that prove it are real numbers within rounding of these."""
        return self.proofs["plan"].get()

    @property
    def cut_normal(self) -> np.ndarray:
        """Return the normals a (b, d) of half-spaces a'x ≤ b, valid on the whole feasible set, that
        prove points infeasible, NaN elsewhere."""
        return self.proofs["cut_normal"].get()

    @property
    def cut_offset(self) -> np.ndarray:
        """Return the offsets (b,) of these half-spaces.

        ∞ means that −1 is proved at the point but that no such half-space is known: on sets that
        are unbounded in both directions, or very long, along a facet, the rounding of its normal
        outweighs the distance of the point.
        """
        return self.proofs["cut_offset"].get()

    def counts(self) -> dict[str, int]:
        """Return how many points are feasible, infeasible, undecided, not finite, not run."""
        return {
            "feasible": int(np.sum(self.label == 1)),
            "infeasible": int(np.sum(self.label == -1)),
            "undecided": int(np.sum(self.status == Status.ITERATION_LIMIT)),
            "not finite": int(np.sum(self.status == Status.NON_FINITE)),
            "not run": int(np.sum(self.status == Status.NOT_RUN)),
        }

    @classmethod
    def of(cls, label: np.ndarray, status: np.ndarray, **proofs: np.ndarray | Array) -> "Labels":
        """Return labels from their arrays, of NumPy or on a device; proofs: those of `PROOFS`."""

        def fetched(array: np.ndarray | Array) -> OnDemand[np.ndarray]:
            return OnDemand(lambda: np.asarray(array))

        return cls(
            np.asarray(label), np.asarray(status), {name: fetched(proofs[name]) for name in PROOFS}
        )

    @classmethod
    def proved(
        cls, label: np.ndarray | Array, verdict: Callable[[], Verdict], usable: np.ndarray
    ) -> "Labels":
        """Return labels (B,) of a batch, on the device, with the proofs in its verdict, which is
        asked for when one is used; waits for the device. usable (B,): which points are finite."""
        label = np.where(usable, np.asarray(label), np.int8(0))
        status = np.where(usable, STATUS[label + 1], np.int8(Status.NON_FINITE))

        def proof(name: str, of: int) -> OnDemand[np.ndarray]:  # NaN where it proves nothing
            def fetch() -> np.ndarray:
                return _put(np.asarray(getattr(verdict(), name)), label != of, np.nan)

            return OnDemand(fetch)

        return cls(label, status, {name: proof(name, of) for name, of in PROOFS.items()})

    @classmethod
    def empty(cls, count: int, problem: FeasibilityProblem) -> "Labels":
        """Return labels of `count` points that have not been run."""
        mpc, d = problem.mpc, problem.dimension
        return cls.of(
            np.zeros(count, np.int8),
            np.full(count, Status.NOT_RUN, np.int8),
            start=np.full((count, mpc.dimension), np.nan),
            plan=np.full((count, mpc.horizon, mpc.system.m), np.nan),
            cut_normal=np.full((count, d), np.nan),
            cut_offset=np.full(count, np.nan),
        )

    @classmethod
    def joined(cls, parts: Sequence["Labels"]) -> "Labels":
        """Return the labels of several batches of points, one after the other."""

        def several(name: str) -> OnDemand[np.ndarray]:
            def fetch() -> np.ndarray:
                return joined(side_by_side(lambda part: part.proofs[name].get(), parts, cores()))

            return OnDemand(fetch)

        return cls(
            np.concatenate([part.label for part in parts]),
            np.concatenate([part.status for part in parts]),
            {name: several(name) for name in PROOFS},
            sum(part.compile_seconds for part in parts),
            sum(part.run_seconds for part in parts),
        )

    def first(self, count: int) -> "Labels":
        """Return the labels of the first `count` points."""

        def head(proof: OnDemand[np.ndarray]) -> OnDemand[np.ndarray]:
            return OnDemand(lambda: proof.get()[:count])

        proofs = {name: head(proof) for name, proof in self.proofs.items()}
        return replace(self, label=self.label[:count], status=self.status[:count], proofs=proofs)

    def changed(
        self,
        where: np.ndarray,
        label: np.ndarray | int,
        status: np.ndarray | int,
        proofs: Mapping[str, OnDemand[np.ndarray]],
    ) -> "Labels":
        """Return these labels with others at indices `where` (k,), and with these rows of their
        proofs."""

        def merged(name: str, rows: OnDemand[np.ndarray]) -> OnDemand[np.ndarray]:
            return OnDemand(lambda: _put(self.proofs[name].get(), where, rows.get()))

        return replace(
            self,
            label=_put(self.label, where, label),
            status=_put(self.status, where, status),
            proofs={**self.proofs, **{name: merged(name, rows) for name, rows in proofs.items()}},
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Return label, status and all proofs by their names."""
        proofs = {name: proof.get() for name, proof in self.proofs.items()}
        return {"label": self.label, "status": self.status, **proofs}

    def fetch(self) -> None:
        """Copy all proofs from the device."""
        for proof in self.proofs.values():
            proof.get()


def _put(array: np.ndarray, where: np.ndarray, rows: np.ndarray | float) -> np.ndarray:
    """Return a copy of the array with `rows` at indices `where`."""
    copy = array.copy()
    copy[where] = rows
    return copy
