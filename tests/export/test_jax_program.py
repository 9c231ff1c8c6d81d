"""Plans as a stored program of JAX, run without the library, beside `solve`."""

import subprocess
import sys

import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.export import export_jax

pytest.importorskip("flatbuffers")


@pytest.mark.slow
def test_a_batch_of_any_size_in_a_process_without_the_library(tmp_path):
    mpc = problems.joint_o_inf(6)
    export_jax(mpc, tmp_path / "joint.bin")
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 2))
    reference = np.tile([0.1, 0.0], (300, 1))
    np.savez(tmp_path / "given.npz", x=x, reference=reference)
    script = """if True:
        import sys, jax, numpy as np
        given = np.load("given.npz")
        program = jax.export.deserialize(open("joint.bin", "rb").read())
        with jax.enable_x64(True):
            for k in (1, 300):
                zero = np.zeros((k, 1))
                plan = program.call(given["x"][:k], given["reference"][:k], zero)
                np.savez(f"found{k}.npz", **{key: np.asarray(v) for key, v in plan.items()})
        assert "jaxmpc" not in sys.modules
    """
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path)
    with jax.enable_x64(True):
        wanted = jax.vmap(lambda x, r: jm.solve(mpc, x, r))(x, reference)
    for k in (1, 300):
        found = np.load(tmp_path / f"found{k}.npz")
        np.testing.assert_array_equal(found["status"], wanted.status[:k])
        solved = found["status"] == jm.Status.SOLVED
        assert k == 1 or 0.2 < solved.mean()
        np.testing.assert_allclose(
            found["inputs"][solved], np.asarray(wanted.inputs)[:k][solved], rtol=0, atol=1e-6
        )


def test_bad_input(tmp_path):
    (tmp_path / "there").write_text("")
    with pytest.raises(ValueError, match="there: exists"):
        export_jax(problems.joint_o_inf(6), tmp_path / "there")
    with pytest.raises(ValueError, match="dtype: 'half'"):
        export_jax(problems.joint_o_inf(6), tmp_path / "other", dtype="half")
