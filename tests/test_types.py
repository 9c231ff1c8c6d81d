"""What type checkers say of the public surface, and of the pages on layers and derivatives."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = ("how-to/learning.md", "how-to/tuning.md", "coming-from/mpc-pytorch.md")
# Optax has no py.typed, so that mypy knows none of its types; pyright reads its source.
SETTINGS = "[mypy]\nstrict = true\n[mypy-optax.*]\nignore_missing_imports = true\n"

PROGRAM = """import jaxmpc as jm

limits = jm.Box([-2.0], [2.0])
mpc = jm.MPC(jm.LinearSystem([[1.0]], [[1.0]]), [[1.0]], [[1.0]], 3, inputs=limits)
plan = jm.solve(mpc, [0.5])
reveal_type(plan)
"""


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["", 'jm.solve(mpc, "abc")', 'jm.Box("a", 1.0)'])
def test_strict_mypy_outside_the_checkout(tmp_path, wrong):
    (tmp_path / "program.py").write_text(PROGRAM + wrong)
    check = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "program.py"]
    done = subprocess.run(check, capture_output=True, text=True, cwd=tmp_path)
    assert 'Revealed type is "jaxmpc.mpc.plan.Plan"' in done.stdout
    assert done.returncode == bool(wrong)
    assert done.stdout.count("error:") == bool(wrong)


@pytest.fixture
def scripts(tmp_path):
    """The snippets of each page as a script of a user, in a folder of their own."""
    names = [f"{page.split('/')[1][:-3].replace('-', '_')}.py" for page in PAGES]
    for page, name in zip(PAGES, names, strict=True):
        found = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), flags=re.DOTALL)
        (tmp_path / name).write_text("\n\n".join(found))
    return tmp_path, names


@pytest.mark.slow
def test_strict_mypy_on_pages(scripts):
    folder, names = scripts
    (folder / "mypy.ini").write_text(SETTINGS)
    with (folder / names[0]).open("a") as script:
        script.write("\nreveal_type(layer(theta, x[0]).plan)\n")  # Any, were the types not found
    check = [sys.executable, "-m", "mypy", "--follow-imports=silent", *names]
    done = subprocess.run(check, capture_output=True, text=True, cwd=folder)
    revealed = 'Revealed type is "jaxmpc.mpc.plan.Plan"'
    assert done.returncode == 0 and revealed in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
def test_pyright_on_pages(scripts):
    pytest.importorskip("pyright", reason="`pip install pyright[nodejs]` brings it")
    folder, names = scripts
    check = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--outputjson"]
    done = subprocess.run([*check, *names], capture_output=True, text=True, cwd=folder)
    report = json.loads(done.stdout)
    assert report["summary"]["filesAnalyzed"] == len(names)
    assert not report["generalDiagnostics"], report["generalDiagnostics"]
