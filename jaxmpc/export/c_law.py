"""The explicit law as C99 code: tables of its regions and a binary search tree over their facets.

A node asks on which side of a half-space the state lies. The regions that reach into either side,
seen from their vertices, go on to its children; the facet that leaves the fewer regions in the
larger child is taken (Tøndel, Johansen, Bemporad 2003, "Evaluation of piecewise affine control via
binary search tree", Automatica 39(5)). A leaf holds the regions that no facet tells apart, one
mostly, and the code checks their facets: so its answer "inside" does not rest on the tree. Where
rounding may decide a node it goes on to both children: so "outside" does not rest on signs either.
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmpc.checks import fail, require_kind
from jaxmpc.explicit.regions import CriticalRegions
from jaxmpc.export.c_files import CFiles, input_limits, literal

# How far beyond a facet counts as inside, relative to the size of X_N.
TOLERANCE = {"float64": 1e-9, "float32": 1e-5}
# Decimals, relative to the extent of X_N, to which facets of two regions are the same.
DECIMALS = 9


class Facets(NamedTuple):
    """Half-spaces a'x ≤ b, each stored once: normal (planes, p), offset (planes,); of the facets of
    all regions, region after region, its plane, the side (1, or −1 for a'x ≥ b), and where each
    region begins (regions + 1,). b − a'x is the distance in units of the extent of X_N."""

    normal: np.ndarray
    offset: np.ndarray
    plane: np.ndarray
    side: np.ndarray
    begin: np.ndarray

    @classmethod
    def of(cls, regions: CriticalRegions, extent: np.ndarray) -> "Facets":
        """Return the facets of regions in X_N, whose extent is (p,)."""
        H, h, starts = regions.facets
        length = np.linalg.norm(H * extent, axis=1, keepdims=True)
        whole = np.column_stack([H, h]) / length
        rounded = np.round(whole * np.append(extent, 1.0), DECIMALS)
        # The first entry that is not zero is positive, so that both sides are one plane.
        lead = rounded[np.arange(len(rounded)), np.argmax(rounded[:, :-1] != 0, axis=1)]
        side = np.where(lead < 0, -1, 1)
        _, first, plane = np.unique(
            rounded * side[:, None] + 0.0, axis=0, return_index=True, return_inverse=True
        )
        planes = whole[first] * side[first, None]
        return cls(planes[:, :-1], planes[:, -1], plane.ravel(), side, np.append(starts, len(h)))


class SearchTree(NamedTuple):
    """Nodes in arrays: plane, −1 at a leaf; the next node inside and outside of it, at a leaf where
    its regions begin in `regions` and how many there are. depth: half-spaces on the longest way."""

    plane: np.ndarray
    inside: np.ndarray
    outside: np.ndarray
    regions: np.ndarray
    depth: int

    @classmethod
    def of(cls, facets: Facets, vertices: list[np.ndarray], margin: float) -> "SearchTree":
        """Return the tree over regions with these vertices (k, p). A region reaches into a side
        where a vertex lies more than `margin` inside it."""
        far = [points @ facets.normal.T - facets.offset for points in vertices]
        below = np.array([values.min(axis=0) < -margin for values in far])
        above = np.array([values.max(axis=0) > margin for values in far])
        plane: list[int] = []
        children: list[list[int]] = []
        leaves: list[int] = []
        depth = 0
        # Regions, parent, which child, depth.
        waiting: list[tuple[Any, int, int, int]] = [(np.arange(len(vertices)), -1, 0, 0)]
        while waiting:
            here, parent, child, deep = waiting.pop()
            node, depth = len(plane), max(depth, deep)
            if parent >= 0:
                children[parent][child] = node
            own: np.ndarray = np.unique(
                np.concatenate([facets.plane[facets.begin[i] : facets.begin[i + 1]] for i in here])
            )
            larger = np.maximum(below[here][:, own].sum(axis=0), above[here][:, own].sum(axis=0))
            best = int(np.argmin(larger))
            if len(here) == 1 or larger[best] == len(here):
                plane.append(-1)
                children.append([len(leaves), len(here)])
                leaves.extend(int(i) for i in here)
                continue
            plane.append(int(own[best]))
            children.append([0, 0])
            for k, reach in enumerate((below, above)):
                waiting.append((here[reach[here, own[best]]], node, k, deep + 1))
        inside, outside = np.array(children).T
        return cls(np.array(plane), inside, outside, np.array(leaves), depth)


def export_explicit_c(
    regions: CriticalRegions,
    folder: str | Path,
    *,
    name: str = "law",
    dtype: Literal["float64", "float32"] = "float64",
    tolerance: float | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write the explicit law of `jm.explicit.critical_regions` as C99 code, for the references that
    this was given.

    Nothing is allocated, and nothing is solved: a call takes as many products of p numbers as the
    tree is deep, and those of one region's facets. What it costs is memory, which grows as the
    number of regions. The status says whether the state has a plan at all.

    regions: of `critical_regions`, all of them. name: with which files and C functions begin.
    folder: where NAME.c, NAME.h, NAME_sizes.h, NAME_tables.h and NAME_example.c are written. dtype:
    type of all numbers there. tolerance: distance beyond a facet that counts as inside, relative to
    the extent of the feasible set in each coordinate, None: 1e-9, and 1e-5 in float32.

    Returns the paths. Raises ValueError where not all regions were found, for a name that C does
    not take, and for files that exist, unless overwrite.
    """
    cure = "Give what jm.explicit.critical_regions(mpc) returns"
    require_kind("regions", regions, CriticalRegions, cure=cure)
    files = CFiles.open(folder, name, dtype, tolerance, TOLERANCE, overwrite)
    if not regions.complete:
        cure = (
            "Raise max_regions or seconds where these ended the search; else shorten the horizon, "
            "or export a fixed number of steps (export_c, --law steps)"
        )
        fail("regions", f"are not all of the law ({regions.reason})", cure)
    if regions.window is not None or regions.tied:
        what = "unbounded" if regions.window is not None else "flat"
        cure = "Give critical_regions a bounded set within that has volume"
        fail("regions", f"are those of a feasible set that is {what}", cure)
    vertices = [region.vertices for region in regions.regions]
    corners = np.concatenate(vertices)
    facets = Facets.of(regions, np.ptp(corners, axis=0))
    tree = SearchTree.of(facets, vertices, 1e-9)
    mpc = regions.mpc
    # Differences from here are as exact as x is, wherever X_N lies, where sums about 0 are not.
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    centre = centre.astype(dtype).astype(np.float64)
    tables = {
        "centre": centre,
        "plane_normal": facets.normal.ravel(),
        "plane_offset": facets.offset - facets.normal @ centre,
        "node_plane": tree.plane,
        "node_inside": tree.inside,
        "node_outside": tree.outside,
        "leaf_region": tree.regions,
        "facet_begin": facets.begin,
        "facet_plane": facets.plane,
        "facet_side": facets.side,
        "law_gain": np.array([region.K.T.ravel() for region in regions.regions]).T,
        "law_offset": np.array([region.k + region.K @ centre for region in regions.regions]).T,
        **input_limits(mpc),
    }
    number = lambda value: literal(value, files.real).replace("(real)", "")
    sizes = {
        "PARAMETERS": mpc.dimension,
        "INPUTS": mpc.system.m,
        "REGIONS": len(regions),
        "NODES": len(tree.plane),
        "DEPTH": tree.depth,
        "MOST": int(tree.outside[tree.plane < 0].max()),  # regions of a leaf
        "RATES": int(mpc.rate_limited),
        "TOLERANCE": number(files.tolerance),
        "NEAR": number(max(files.tolerance, 10 * TOLERANCE[dtype])),
    }
    return files.write(("law.h", "law.c", "law_example.c"), sizes, tables, mpc.dimension)
