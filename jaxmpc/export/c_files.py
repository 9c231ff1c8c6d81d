"""Tables and files of C code."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.checks import fail, positive, require_kind
from jaxmpc.files import open_folder, require_new, versions
from jaxmpc.mpc.plan import rate_ends
from jaxmpc.mpc.problem import MPC, at_stage
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box

TEMPLATES = Path(__file__).parent
REAL = {"float64": "double", "float32": "float"}
# Headers of C99, which files of the same name would hide.
HEADERS = (
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg "
    "stdbool stddef stdint stdio stdlib string tgmath time wchar wctype"
).split()

# What to give in place of a controller, to what writes programs of a problem.
GIVE_PROBLEM = (
    "Give a jm.MPC: controller.mpc, for an offset-free controller "
    "jm.closed_loop.augmented(mpc, observer)"
)


@record
class CFiles:
    """The files of a controller to be written: NAME.h, .c, _sizes.h, _tables.h and _example.c.

    real: the C type of all numbers. tolerance: that of the code.
    """

    name: str
    paths: tuple[Path, ...]
    real: str
    tolerance: float

    @classmethod
    def open(
        cls,
        folder: str | Path,
        name: str,
        dtype: str,
        tolerance: float | None,
        usual: Mapping[str, float],
        overwrite: bool,
    ) -> "CFiles":
        """Check the arguments and make the folder. usual: the tolerance of each dtype, for None.

        Raises ValueError for names that C does not take, types that are not offered, a tolerance
        that is not positive, and files that exist, unless overwrite.
        """
        require_kind("folder", folder, str, os.PathLike, cure="Give the path of a folder")
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
            fail("name", f"{name!r}", "Give letters, digits and _, a letter first")
        if name in HEADERS:
            fail("name", f"{name!r}", f"{name}.h is a header of C: give another name")
        if dtype not in REAL:
            fail("dtype", f"{dtype!r}", 'Give "float64" or "float32"')
        tolerance = usual[dtype] if tolerance is None else tolerance
        positive("tolerance", tolerance)
        kinds = (".h", ".c", "_sizes.h", "_tables.h", "_example.c")
        paths = prepared_paths(Path(folder), [f"{name}{kind}" for kind in kinds], overwrite)
        return cls(name, tuple(paths), REAL[dtype], tolerance)

    def write(
        self,
        templates: tuple[str, str, str],
        sizes: Mapping[str, Any],
        tables: Mapping[str, np.ndarray],
        states: int,
        macros: Mapping[str, str] | None = None,
    ) -> list[Path]:
        """Write header and code of these templates, sizes, tables and example; return the paths.

        NAME, VERSION and X0 (zeros for so many states) in them are replaced.
        """
        header, code, example = (
            (TEMPLATES / source).read_text(encoding="utf-8") for source in templates
        )
        texts = (
            header,
            code,
            sizes_header(sizes, self.real),
            tables_header(tables, macros or {}, self.real),
            example,
        )
        zeros = " ".join(["0"] * states)
        own = {"NAME": self.name, "VERSION": versions()["jaxmpc"], "X0": zeros}
        for path, text in zip(self.paths, texts, strict=True):
            # In one pass: the name may hold such a word.
            filled = re.sub("|".join(own), lambda found: own[found[0]], text)
            path.write_text(filled, encoding="utf-8")
        return list(self.paths)


def prepared_paths(folder: Path, names: list[str], overwrite: bool) -> list[Path]:
    """Return the paths of the files in the folder, which is made; raise ValueError where one exists
    and may not be overwritten."""
    paths = [folder / name for name in names]
    require_new(paths, overwrite)
    open_folder(folder)
    return paths


def input_limits(mpc: MPC) -> dict[str, np.ndarray]:
    """Return the tables of the limits (m,) into which the code clips inputs, ±inf for none, and
    their changes, where these are limited."""
    free = np.full(mpc.system.m, np.inf)
    inputs = at_stage(mpc.inputs, 0)
    ends = (inputs.lower, inputs.upper) if isinstance(inputs, Box) else (-free, free)
    tables: dict[str, Any] = dict(zip(("input_lower", "input_upper"), ends, strict=True))
    if mpc.rate_limited:
        tables |= zip(("rate_lower", "rate_upper"), rate_ends(mpc), strict=True)
    return {name: np.broadcast_to(v, free.shape) for name, v in tables.items()}


def sizes_header(macros: Mapping[str, Any], real: str) -> str:
    """Return the header with sizes as macros NAME_KEY and the type of numbers."""
    lines = ["/* NAME: sizes and types; written by jaxmpc VERSION. */"]
    lines += [f"#define NAME_{key} {value}" for key, value in macros.items()]
    return "\n".join([*lines, f"typedef {real} NAME_real;", ""])


def tables_header(tables: Mapping[str, np.ndarray], macros: Mapping[str, str], real: str) -> str:
    """Return the header with constant arrays, column by column, and macros for `real`."""
    lines = ["/* NAME: tables, column by column; written by jaxmpc VERSION. */"]
    lines += [f"#define {key} {value}" for key, value in macros.items()]
    for key, table in tables.items():
        whole = table.dtype.kind == "i"
        columns = table if table.ndim < 2 else np.swapaxes(table, -1, -2)
        values = [str(v) if whole else literal(v, real) for v in columns.ravel()] or ["0"]
        shape = " x ".join(map(str, table.shape))
        lines.append(
            f"static const {'int' if whole else 'real'} {key}[{len(values)}] = {{ /* {shape} */"
        )
        lines += [f"  {', '.join(values[i : i + 6])}," for i in range(0, len(values), 6)]
        lines.append("};")
    return "\n".join([*lines, ""])


def literal(value: Any, real: str) -> str:
    """Return a number in C: the shortest text that is read as the same number."""
    value = np.float32(value) if real == "float" else np.float64(value)
    if np.isinf(value):
        return f"(real){'-' if value < 0 else ''}INFINITY"
    text = str(value)
    text += "" if any(s in text for s in ".en") else ".0"
    return f"{text}f" if real == "float" else text
