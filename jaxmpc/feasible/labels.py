"""Labels of points, each with its proof."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxmpc.batches import cores, joined, side_by_side
from jaxmpc.feasible.candidates import Verdict
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.qp.status import Status

# The arrays of `Labels` that may still be on the device.
PROOFS = ("starts", "plans", "cut_normals", "cut_offsets")
# The status of labels −1, 0 and 1.
STATUS = np.array([Status.PRIMAL_INFEASIBLE, Status.ITERATION_LIMIT, Status.SOLVED], np.int8)


class OnDemand:
    """Something, mostly an array, that is fetched once, when it is first used."""

    def __init__(self, fetch: Callable[[], Any]) -> None:
        self._fetch: Callable[[], Any] | None = fetch
        self._value: Any = None

    def get(self) -> Any:
        """Return it, and fetch it the first time."""
        if self._value is None:
            assert self._fetch is not None
            self._value, self._fetch = self._fetch(), None
        return self._value


@dataclass(frozen=True, eq=False)
class Labels:
    """Labels of b points and their proofs.

    label (b,) int8: 1 proved feasible, −1 proved infeasible, 0 undecided. status (b,) int8:
    `Status` (NOT_RUN, NON_FINITE, or SOLVED / PRIMAL_INFEASIBLE / ITERATION_LIMIT for the three
    labels). starts (b, n), plans (b, N, m): x_0 and inputs that prove 1, else NaN. Where equalities
    tie inputs to states the inputs that prove 1 are real numbers within rounding of these.
    cut_normals (b, d), cut_offsets (b,): the half-space a'x ≤ b, valid on the whole feasible set,
    that proves −1, else NaN. An offset of ∞ means that −1 is proved at the point but that no such
    half-space is known: on sets that are unbounded in both directions, or very long, along a facet,
    the rounding of its normal outweighs the distance of the point. compile_seconds, run_seconds:
    time spent compiling and running.

    The proofs may still be on the device, or not be made yet: each of the four arrays is fetched
    when first used.
    """

    label: np.ndarray
    status: np.ndarray
    proofs: dict[str, OnDemand]
    compile_seconds: float = 0.0
    run_seconds: float = 0.0

    @property
    def starts(self) -> np.ndarray:
        """Return x_0 (b, n) of the points proved feasible, NaN elsewhere."""
        return self.proofs["starts"].get()

    @property
    def plans(self) -> np.ndarray:
        """Return inputs (b, N, m) that prove points feasible, NaN elsewhere."""
        return self.proofs["plans"].get()

    @property
    def cut_normals(self) -> np.ndarray:
        """Return the normals (b, d) of the half-spaces that prove points infeasible, NaN
        elsewhere."""
        return self.proofs["cut_normals"].get()

    @property
    def cut_offsets(self) -> np.ndarray:
        """Return the offsets (b,) of these half-spaces."""
        return self.proofs["cut_offsets"].get()

    @classmethod
    def of(
        cls, *, label: Any, status: Any, starts: Any, plans: Any, cut_normals: Any,
        cut_offsets: Any, **seconds: float,
    ) -> "Labels":  # fmt: skip
        """Return labels from their arrays, of NumPy or on a device."""
        given = dict(starts=starts, plans=plans, cut_normals=cut_normals, cut_offsets=cut_offsets)
        fetch = lambda v: OnDemand(lambda: np.asarray(v))
        proofs = {name: fetch(v) for name, v in given.items()}
        return cls(np.asarray(label), np.asarray(status), proofs, **seconds)

    @classmethod
    def proved(cls, label: Any, verdict: Callable[[], Verdict], usable: np.ndarray) -> "Labels":
        """Return labels (B,) of a batch, on the device, with the proofs in its verdict, which is
        asked for when one is used; waits for the device. usable (B,): which points are finite."""
        label = np.where(usable, np.asarray(label), np.int8(0))
        status = np.where(usable, STATUS[label + 1], np.int8(Status.NON_FINITE))

        def proof(name: str, of: int) -> OnDemand:  # NaN where it proves nothing
            return OnDemand(lambda: _put(np.asarray(getattr(verdict(), name)), label != of, np.nan))

        proofs = {
            "starts": proof("start", 1),
            "plans": proof("inputs", 1),
            "cut_normals": proof("normal", -1),
            "cut_offsets": proof("offset", -1),
        }
        return cls(label, status, proofs)

    @classmethod
    def empty(cls, count: int, problem: FeasibilityProblem) -> "Labels":
        """Return labels of `count` points that have not been run."""
        mpc, d = problem.mpc, problem.dimension
        return cls.of(
            label=np.zeros(count, np.int8), status=np.full(count, Status.NOT_RUN, np.int8),
            starts=np.full((count, mpc.dimension), np.nan),
            plans=np.full((count, mpc.horizon, mpc.system.m), np.nan),
            cut_normals=np.full((count, d), np.nan), cut_offsets=np.full(count, np.nan),
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence["Labels"]) -> "Labels":
        """Return the labels of several batches of points, one after the other."""
        fetched = lambda name: side_by_side(lambda part: part.proofs[name].get(), parts, cores())
        several = lambda name: OnDemand(lambda: joined(fetched(name)))
        return cls(
            np.concatenate([part.label for part in parts]),
            np.concatenate([part.status for part in parts]),
            {name: several(name) for name in PROOFS},
            sum(part.compile_seconds for part in parts),
            sum(part.run_seconds for part in parts),
        )

    def first(self, count: int) -> "Labels":
        """Return the labels of the first `count` points."""
        head = lambda proof: OnDemand(lambda: proof.get()[:count])
        proofs = {name: head(proof) for name, proof in self.proofs.items()}
        return replace(self, label=self.label[:count], status=self.status[:count], proofs=proofs)

    def changed(
        self, where: np.ndarray, label: Any, status: Any, proofs: dict[str, OnDemand]
    ) -> "Labels":
        """Return these labels with others at indices `where` (k,), and with these rows of their
        proofs."""
        merged = lambda name, rows: OnDemand(
            lambda: _put(self.proofs[name].get(), where, rows.get())
        )
        return replace(
            self,
            label=_put(self.label, where, label),
            status=_put(self.status, where, status),
            proofs=self.proofs | {name: merged(name, rows) for name, rows in proofs.items()},
        )

    def fetch(self) -> None:
        """Copy all proofs from the device."""
        for proof in self.proofs.values():
            proof.get()


def _put(array: np.ndarray, where: np.ndarray, rows: Any) -> np.ndarray:
    """Return a copy of the array with `rows` at indices `where`."""
    copy = array.copy()
    copy[where] = rows
    return copy
