"""Programs that are compiled ahead, once for each shape."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from jaxmpc.batches import Compiled


def test_threads_compile_a_program_once():
    lowered = []

    class Counted:
        def lower(self, *args):
            lowered.append(args)
            return jax.jit(lambda x: x + 1).lower(*args)

    program = Compiled(Counted())
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(program, [np.full(3, float(k)) for k in range(8)]))
    np.testing.assert_array_equal(found, np.arange(1.0, 9.0)[:, None] * np.ones(3))
    assert len(lowered) == 1 and program(np.zeros(2)).shape == (2,) and len(lowered) == 2
