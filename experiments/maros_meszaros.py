"""Small programs of the Maros-Meszaros collection: how many are solved at default settings?

    python experiments/maros_meszaros.py DIR

DIR holds the collection as .mat files with P, q, r, A, l, u (½z'Pz + q'z + r, l ≤ Az ≤ u; limits on
variables are rows of A), as the source archives of OSQP's benchmarks and of ProxSuite contain it;
it is not part of this project. Residuals are computed here, in float64 and absolute. "solved" at
1e-6: primal residual, dual residual and gap; "relative": each within 1e-9 of the terms in it.
"""

from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from qp_judge import residual_terms
from scipy.io import loadmat

import jaxmpc as jm


def read(path: Path) -> tuple[jm.QP, float] | None:
    """The program and its constant cost; None where it has more than 300 variables or 1,000
    rows."""
    data = loadmat(path, spmatrix=False)
    q, l, u = (np.asarray(data[name], float).ravel() for name in ("q", "l", "u"))
    if len(q) > 300 or len(l) > 1000:
        return None
    P, A = data["P"].toarray(), data["A"].toarray()
    if not np.allclose(P, P.T):  # the upper triangle alone
        P = P + np.triu(P, 1).T
    return jm.QP(P, q, A, l, u), float(data["r"].item())


def main(folder: Annotated[Path, tyro.conf.Positional]) -> None:
    """Solve and print one line a program, then the counts."""
    jax.config.update("jax_enable_x64", True)
    solved = relative = count = 0
    for path in sorted(folder.glob("*.mat")):
        found = read(path)
        if found is None:
            continue
        count, (qp, constant) = count + 1, found
        try:
            answer = jm.solve_qp(qp)
        except ValueError as error:
            print(f"{path.stem:10} refused: {error}", flush=True)
            continue
        bounds = {"l": np.where(qp.l <= -1e20, -np.inf, qp.l)}
        bounds["u"] = np.where(qp.u >= 1e20, np.inf, qp.u)
        terms = residual_terms(jm.QP(qp.P, qp.q, qp.A, **bounds), answer.z, answer.y)
        worst = [np.abs(value).max(initial=0.0) for value, _ in terms]
        solved += max(worst) <= 1e-6
        relative += all(np.all(np.abs(value) <= 1e-9 * size + 1e-6) for value, size in terms)
        print(f"{path.stem:10}{len(qp.q):4}{len(qp.l):5} {jm.Status(int(answer.status)).name:16}"
              f"residuals {worst[0]:.0e} {worst[1]:.0e} {worst[2]:.0e}  "
              f"cost {float(answer.cost) + constant:.8g}", flush=True)  # fmt: skip
        jax.clear_caches()  # each has a shape of its own
    print(f"{count} programs, {solved} solved to 1e-6, {relative} to 1e-6 + 1e-9 of the terms")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
