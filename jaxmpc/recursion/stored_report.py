"""A report on recursive feasibility as files: arrays with their proofs, and a summary."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.files import remove_files, sha256, versions, write_arrays, write_results
from jaxmpc.recursion.horizons import SmallestHorizon
from jaxmpc.recursion.report import RecursionReport

FILES = ("summary.json", "recursion.npz", "recursion.png")


def save_report(
    folder: Path, report: RecursionReport, config: dict[str, Any], least: SmallestHorizon | None
) -> None:
    """Write recursion.npz and summary.json, which `jaxmpc verify` proves again, and remove a
    picture of an earlier report.

    config: JSON data that the problem is made of, with its name. least: the smallest horizon, where
    it was looked for.
    """
    loops, body, worst = report.loops, report.feasible_set, report.counterexample
    facets = {}
    if body is not None:
        facets = {"facet_normals": np.asarray(body.H), "facet_offsets": np.asarray(body.h)}
    remove_files(folder, *FILES)
    arrays = folder / "recursion.npz"
    problem = {"problem": FeasibilityProblem.of(report.mpc).plain()}
    found = {name: getattr(loops, name) for name in ("lost_at", "undecided_at")}
    found |= {"state": loops.x0s, "input": loops.inputs, "next_state": loops.next_states}
    write_arrays(arrays, problem, **facets, **loops.labels.arrays(), **found)
    summary = {
        "name": config["name"],
        "claims": {name: dataclasses.asdict(claim) for name, claim in report.claims.items()},
        "counterexample": None if worst is None else dataclasses.asdict(worst),
        "volume": report.volume,
        "lost_by_any": report.lost_by_any,
        "lost_by_law": report.lost_by_law,
        "counts": loops.counts(),
        "steps": loops.steps,
        "seconds": report.seconds,
        "config": config,
        "sha256": sha256(arrays),
        "versions": versions(),
    }
    if least is not None:
        summary["smallest_horizon"] = dataclasses.asdict(least)
    write_results(folder / "summary.json", summary)
