"""C code under data that nobody would send: NaN, overflow, garbage in its memory.

`fuzz_mpc.c` and `fuzz_law.c` call the code some hundred thousand times and compute in long double
what its status claims. By hand, 10 million calls a law and type:

    python tests/export/test_c_bad_data.py 10000000
"""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
import problems
import pytest
from test_c_solver import CASES, Compiled, pendulum

import jaxmpc as jm
from jaxmpc.export import export_c, export_explicit_c

HERE = Path(__file__).parent
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
STRICT = (
    "-std=c99 -pedantic -Wall -Wextra -Wconversion -Wdouble-promotion -Wshadow -Werror -O2"
).split()
SANITIZED = "-g -fsanitize=address,undefined -fno-sanitize-recover=all".split()
ZERO = ("not finite", "beyond limits", "strange status", "not solved", "not inside")
pytestmark = pytest.mark.skipif(not COMPILERS, reason="there is no C compiler")


def exported(case, folder, dtype):
    """The code of a case of `test_c_solver.py`, or of the law, in the folder, as `law.c`."""
    if case == "explicit":
        export_explicit_c(LAW(), folder, dtype=dtype)
        return "fuzz_law.c"
    make, _ = CASES[case]
    steps = jm.ADMM(iterations=60, newton_steps=0)
    export_c(make(), folder, steps, name="law", dtype=dtype)
    return "fuzz_mpc.c"


def LAW():
    return jm.explicit.critical_regions(problems.joint_o_inf(4))


def fuzzed(source, folder, calls, *options, compiler=COMPILERS[0] if COMPILERS else ""):
    """Compile and run the fuzz; its counts by name."""
    program = folder / "fuzz"
    command = [compiler, "-std=c99", "-O2", "-I", folder, *options, HERE / source, "-lm"]
    subprocess.run([*command, "-o", program], check=True)
    done = subprocess.run([program, str(calls), "1"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = (line.rsplit(" ", 1) for line in done.stdout.splitlines() if "statuses" not in line)
    found = {name: int(count) for name, count in counts}
    return found, [int(v) for v in done.stdout.splitlines()[-1].split()[1:]]


@pytest.mark.long
@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "case",
    [c if c in ("all", "explicit") else pytest.param(c, marks=pytest.mark.slow)
     for c in (*CASES, "explicit")],
)  # fmt: skip
def test_whatever_comes_inputs_are_finite_and_the_status_is_true(case, dtype, tmp_path):
    source = exported(case, tmp_path, dtype)
    for compiler in COMPILERS:
        objects = [tmp_path / name for name in ("law.c", "law_example.c")]
        for file in objects:
            subprocess.run([compiler, *STRICT, "-c", file, "-o", tmp_path / "object.o"], check=True)
        found, statuses = fuzzed(source, tmp_path, 50_000, compiler=compiler)
        assert not any(found.get(name, 0) for name in ZERO), found
        assert case == "no rows" or all(statuses), statuses  # each status has been seen
        # States jump here at random; 60 steps suffice from one point and not from another. The last
        # plan helps more often than not, or, where the next sample has other dynamics, as often.
        gained = found.get("better", 0) - found.get("worse than cold", 0)
        assert gained >= -0.01 * found.get("compared", 1), found
    found, _ = fuzzed(source, tmp_path, 5_000, *SANITIZED)
    assert not any(found.get(name, 0) for name in ZERO), found


def test_one_bad_reading_is_forgotten_after_one_sample(tmp_path):
    """The sample after it is that of a controller that has seen none."""
    code = Compiled(CASES["ellipsoid"][0](), jm.ADMM(iterations=80, newton_steps=0), tmp_path)
    cold, status = code.step([0.2, 0.1])
    assert status == 1
    for bad in (np.nan, np.inf, 1e4, 1e15, 1e200, 1.7e308):
        for state in ([0.1, -0.1], [bad, 0.0]):
            assert np.isfinite(code.step(state)[0]).all()
        u, status = code.step([0.2, 0.1])
        assert status == 1
        np.testing.assert_allclose(u, cold, atol=1e-3)


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ["axisX0", "NAMEs", "VERSION2", "X0", "mpc"])
def test_names_that_hold_words_of_the_templates(name, tmp_path):
    export_c(CASES["all"][0](), tmp_path, jm.ADMM(iterations=4, newton_steps=0), name=name)
    command = [COMPILERS[0], *STRICT, f"{name}.c", f"{name}_example.c", "-lm", "-o", "example"]
    subprocess.run(command, cwd=tmp_path, check=True)


@pytest.mark.parametrize("case", ["all", "explicit"])
def test_the_example_says_which_line_it_cannot_read(case, tmp_path):
    exported(case, tmp_path, "float64")
    command = [COMPILERS[0], *STRICT, "law.c", "law_example.c", "-lm", "-o", "example"]
    subprocess.run(command, cwd=tmp_path, check=True)
    states = "0.1 0.05"
    for text, answers in ((states, 1), (f"{states}\n\n {states} \r", 2), (f"{states}\n0.3,0", 1),
                          ("0.3", 0), (f"{states} 7", 0), (f"{states}x", 0)):  # fmt: skip
        done = subprocess.run(
            [tmp_path / "example"], input=f"{text}\n", capture_output=True, text=True, check=False
        )
        good = answers > 1 or text == states
        assert len(done.stdout.splitlines()) == answers and done.returncode == (not good)
        assert good or re.match(r"line [12]: give 2 numbers with blanks", done.stderr)


def test_names_of_headers_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"name: 'math'.*math\.h is a header of C"):
        export_c(pendulum(), tmp_path, name="math")


@pytest.mark.parametrize("case", ["all", "explicit"])
def test_fast_math_does_not_compile(case, tmp_path):
    exported(case, tmp_path, "float64")
    for option in ("-ffast-math", "-ffinite-math-only"):
        done = subprocess.run(
            [COMPILERS[0], "-std=c99", option, "-c", "law.c"], cwd=tmp_path, capture_output=True,
            text=True,
        )  # fmt: skip
        assert done.returncode and "without -ffast-math" in done.stderr


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for law in (*CASES, "explicit"):
        for kind in ("float64", "float32"):
            with tempfile.TemporaryDirectory() as folder:
                fuzz = exported(law, Path(folder), kind)
                print(law, kind, *fuzzed(fuzz, Path(folder), int(sys.argv[1])), flush=True)
