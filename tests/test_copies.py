"""Results and robots can be copied and pickled, as multiprocessing and joblib do: what comes back
answers as the first does."""

import copy
import pickle

import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible import affine_policies, sample_feasible_set, sweep_into

WAYS = {"deepcopy": copy.deepcopy, "pickle": lambda v: pickle.loads(pickle.dumps(v))}
MPC = problems.lecture()
GRID = jm.grid([-1, -1], [1, 1], 5)


def robust_map():
    noise = jm.Box([-0.01, -0.01], [0.01, 0.01])
    mpc = jm.MPC(
        MPC.system, [1, 1], 1.0, 2, states=MPC.states, inputs=MPC.inputs,
        disturbance=noise, policy="affine",
    )  # fmt: skip
    affine_policies(mpc, GRID[12:13])
    return jm.map_feasible_set(mpc, GRID)


def of_map(found):
    return *found.labels.arrays().values(), found.refine().outer().volume()


def of_stored(found):
    return found.picture().label, found.refine().bounds.volume_bounds()


def of_robot(robot):
    return robot.step(robot.home + 0.1, np.ones(robot.m)), robot.linearize(robot.home, [0, 0]).A


MADE = {
    "refined map": (lambda path: jm.map_feasible_set(MPC, GRID).refine(), of_map),
    "robust map": (lambda path: robust_map(), lambda found: found.labels.arrays().values()),
    "samples": (lambda path: sample_feasible_set(MPC, 9), lambda found: found.arrays().values()),
    "stored map": (lambda path: sweep_into(path, MPC, [np.linspace(-1, 1, 4)] * 2), of_stored),
    "report": (
        lambda path: jm.recursive_feasibility(MPC, seconds=20, max_regions=0),
        lambda found: (found.loops.lost_at, found.loops.labels.plan, found.volume),
    ),
    "regions": (lambda path: jm.explicit.critical_regions(MPC), lambda found: (found.law(GRID),)),
    "robot": (
        lambda path: jm.load_robot("arm2"),
        lambda robot: (robot.home, robot.mujoco.body_mass),
    ),
    "simulated robot": (lambda path: jm.load_robot("arm2"), of_robot),
}


SLOW = [pytest.param(k, marks=pytest.mark.slow if "simulated" in k else ()) for k in MADE]


@pytest.mark.long
@pytest.mark.parametrize("name", SLOW)
def test_copies_answer_as_the_first(name, tmp_path):
    make, answers = MADE[name]
    found = make(tmp_path / "map.zarr")
    before = answers(found)  # with what it has compiled and keeps
    for way, again in WAYS.items():
        for one, other in zip(before, answers(again(found)), strict=True):
            np.testing.assert_array_equal(one, other, err_msg=way)


def test_fields_alone_are_copied():
    """A problem keeps programs, which make its pickle large, beside its fields."""
    found = jm.map_feasible_set(MPC, GRID).problem
    assert set(vars(found)) > {"mpc", "view"} == set(vars(copy.copy(found)))
    assert jax.tree.structure(copy.deepcopy(MPC)) == jax.tree.structure(MPC)
