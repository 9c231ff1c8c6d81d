"""Models that nobody here wrote, as their files are: 62, ten more that came later, and 50 further.

They are those of dm_control's suite, of Gymnasium and Gymnasium-Robotics (MJCF), and of
example-robot-data (URDF); `pip install "jaxmpc[models]"` brings them. The further ones are others
of example-robot-data, and of robosuite, airo-models, armar, dexmate-urdf and cookie-description
(`pip install --no-deps --target FOLDER`, and FOLDER in PYTHONPATH). For each one:

loads      seconds, or why it is refused
rest       the set-point: home, how far away the nearest configuration that inputs hold, or none
solved     share of plans that are SOLVED, fallback of those that violate soft rows, in percent
kept       share of samples whose state limits are kept to 1 % of their half-width
worst      the most that a state limit was exceeded, in half-widths
C          the largest difference of the plant from MuJoCo's C engine after 25 periods of random
           inputs about the set-point, in units of the state, relative above 1
slopes     how far A and B of the linear model about the set-point (exact=True) are from differences
           of a period of the C engine, beyond both one-sided ones, relative to the largest of each
           column; with an asterisk where stops or contacts act there, which linear models leave out
drift      how far the C engine moves from the set-point in 25 periods under its input, likewise
promise    share of plans SOLVED without fallback after which the next state keeps its limits
ignored    what the predictor does not know, what was left out of the plant

Each model has a process of its own, ended after `seconds`, so that none spoils the others.

python experiments/robots/foreign.py --models suite/cartpole urdf/panda
"""

import dataclasses
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module, util
from pathlib import Path
from typing import Any

import numpy as np
import tyro

SUITE = {
    "acrobot": (), "ball_in_cup": (), "cartpole": (), "cheetah": (), "dog": (), "finger": (),
    "fish": (), "hopper": (), "humanoid": (), "humanoid_CMU": (), "lqr": (4, 2, None),
    "manipulator": (False, False), "pendulum": (), "point_mass": (), "quadruped": (None,),
    "reacher": (), "stacker": (2,), "swimmer": (6,), "walker": (),
}  # fmt: skip
GYMNASIUM = (
    "ant", "half_cheetah", "hopper", "humanoid", "humanoidstandup", "inverted_double_pendulum",
    "inverted_pendulum", "point", "pusher", "pusher_v5", "reacher", "swimmer", "walker2d",
    "walker2d_v5",
)  # fmt: skip
ROBOTICS = (
    "adroit_hand/adroit_door", "adroit_hand/adroit_hammer", "adroit_hand/adroit_pen",
    "adroit_hand/adroit_relocate", "fetch/pick_and_place", "fetch/push", "fetch/reach",
    "fetch/slide", "hand/manipulate_block", "hand/manipulate_block_touch_sensors",
    "hand/manipulate_egg", "hand/manipulate_egg_touch_sensors", "hand/manipulate_pen",
    "hand/manipulate_pen_touch_sensors", "hand/reach",
    "kitchen_franka/kitchen_assets/kitchen_env_model", "point/point",
)  # fmt: skip
MEND = {"mend_inertias": True}
FREE = {"floating_base": True}
# name: (path, arguments of load_robot)
URDF: dict[str, tuple[str, dict[str, bool]]] = {
    "panda": ("panda_description/urdf/panda", {}),
    "ur5": ("ur_description/urdf/ur5_robot", {}),
    "kinova": ("kinova_description/robots/kinova", {}),
    "xarm7": ("xarm_description/urdf/xarm7", {}),
    "z1": ("z1_description/urdf/z1", {}),
    "double_pendulum": ("double_pendulum_description/urdf/double_pendulum", {}),
    "solo12": ("solo_description/robots/solo12", {}),
    "go2": ("go2_description/urdf/go2", {}),
    "anymal_b": ("anymal_b_simple_description/robots/anymal", MEND),
    "talos": ("talos_data/robots/talos_reduced", {}),
    "icub": ("icub_description/robots/icub_reduced", MEND),
    "baxter": ("baxter_description/urdf/baxter", {}),
}
MORE: dict[str, tuple[str, dict[str, bool]]] = {
    "ur10": ("ur_description/urdf/ur10_robot", {}),
    "so101": ("so_arm_description/urdf/so101", {}),
    "a1": ("a1_description/urdf/a1", {}),
    "hyq": ("hyq_description/robots/hyq_no_sensors", MEND),
    "tiago": ("tiago_description/robots/tiago_no_hand", MEND),
    "allegro": ("allegro_hand_description/urdf/allegro_right_hand", MEND),
    "go1": ("go1_description/urdf/go1", MEND),
    "bolt": ("bolt_description/robots/bolt", {}),
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0", {}),
    "go2_free": ("go2_description/urdf/go2", FREE),
}


# Further models: package, folder in it, name: arguments of load_robot.
ERD = ("example-robot-data", "")
FURTHER: dict[tuple[str, str], dict[str, dict[str, bool]]] = {
    ERD: {
        "ur_description/urdf/ur3_robot": {},
        "ur_description/urdf/ur3_gripper": {},
        "ur_description/urdf/ur5_gripper": {},
        "ur_description/urdf/ur5_joint_limited_robot": {},
        "ur_description/urdf/ur10_joint_limited_robot": {},
        "so_arm_description/urdf/so100": {},
        "double_pendulum_description/urdf/double_pendulum_simple": {},
        "double_pendulum_description/urdf/double_pendulum_continuous": {},
        "asr_twodof_description/urdf/TwoDofs": {},
        "finger_edu_description/robots/finger_edu": MEND,
        "solo_description/robots/solo": {},
        "quadruped_description/urdf/quadruped": {},
        "laikago_description/urdf/laikago": MEND,
        "anymal_c_simple_description/urdf/anymal": MEND,
        "anymal_b_simple_description/robots/anymal-kinova": MEND,
        "b1_description/urdf/b1": MEND,
        "b1_description/urdf/b1-z1": MEND,
        "allegro_hand_description/urdf/allegro_left_hand": MEND,
        "borinot_description/urdf/borinot_flying_arm_2": {},
        "hextilt_description/urdf/hextilt_flying_arm_5": {},
        "talos_data/robots/talos_left_arm": {},
        "talos_data/robots/talos_full_v2": MEND,
        "talos_data/robots/talos_reduced_corrected": {},
        "tiago_description/robots/tiago": MEND,
        "tiago_description/robots/tiago_dual": MEND,
        "tiago_pro_description/robots/tiago_pro": MEND,
        "romeo_description/urdf/romeo_small": MEND,
        "simple_humanoid_description/urdf/simple_humanoid": {},
        "g1_description/urdf/g1_29dof_with_hand_rev_1_0": {},
        "alexander_description/urdf/alexander_v1.lowerBodyOnly": {},
        "alex_description/urdf/alex_nub_hands": MEND,
        "centauro_description/urdf/centauro": MEND,
        "pr2_description/urdf/pr2": MEND,
        "icub_description/robots/icub": MEND,
    },
    ("robosuite", "models/assets/robots"): {
        f"{name}/robot": {"contacts": False}
        for name in ("panda", "iiwa", "kinova3", "jaco", "sawyer", "ur5e", "xarm7", "baxter",
                     "gr1", "spot", "spot_arm", "tiago")
    },
    ("airo_models", ""): {
        "arms/ur3e/ur3e": {},
        "arms/ur5e/ur5e": {},
        "grippers/robotiq_2f_85/urdf/robotiq_2f_85": {},
        "grippers/schunk_egk40/urdf/schunk_egk40": MEND,
    },
    ("armar", "description/urdf"): {"armar6": MEND, "armar4": MEND},
    ("dexmate_urdf", "robots"): {
        "humanoid/vega_1/vega_1": MEND,
        "humanoid/vega_1u/vega_1u": MEND,
        "humanoid/vega_1/vega_1_gripper": MEND,
        "hands/f5d6_hand/f5d6_left": MEND,
        "hands/dexs_gripper/dexs_gripper": MEND,
        "hands/dexd_gripper/dexd_gripper": MEND,
    },
    ("cookie_description", "urdf"): {"cookie": MEND},
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Settings:
    """models: those whose names begin so, none for all. robots: starts, in a tenth of the joint
    ranges about the set-point. horizon, steps: in samples. linearize: see `RobotController`.
    seconds: for one model. out: folder of foreign.json, which keeps models that were run before.
    steps=0: load the models and find their set-points only, seconds each.
    one: run this model here and print its result as JSON."""

    models: tuple[str, ...] = ()
    robots: int = 16
    steps: int = 100
    horizon: int = 10
    linearize: str = "set-point"
    seconds: int = 300
    seed: int = 0
    out: Path = Path("out")
    one: str = ""


def catalogue() -> dict[str, Callable[[], tuple[Any, dict[str, bool]]]]:
    """Return, by name, functions that give the model (a path or a mujoco.MjModel) and arguments of
    load_robot. They raise ImportError where a package is missing."""
    found: dict[str, Callable] = {}
    for name, arguments in SUITE.items():
        found[f"suite/{name}"] = lambda n=name, a=arguments: (suite_model(n, a), {})
    for name in GYMNASIUM:
        path = f"envs/mujoco/assets/{name}.xml"
        found[f"gym/{name}"] = lambda p=path: (folder("gymnasium") / p, {})
    for name in ROBOTICS:
        path = f"envs/assets/{name}.xml"
        found[f"gr/{name}"] = lambda p=path: (folder("gymnasium_robotics") / p, {})
    for name, (path, options) in (URDF | MORE).items():
        found[f"urdf/{name}"] = lambda p=path, o=options: (robot_data() / f"{p}.urdf", o)
    for (package, inner), models in FURTHER.items():
        for path, options in models.items():
            short = path.split("/")[0 if package == "robosuite" else -1]
            found[f"further/{package}/{short}"] = partial(further, package, inner, path, options)
    return found


def further(
    package: str, inner: str, path: str, options: dict[str, bool]
) -> tuple[Path, dict[str, bool]]:
    """Return the file of a further model and arguments of load_robot."""
    root = robot_data() if package == ERD[0] else folder(package) / inner
    kind = "xml" if package == "robosuite" else "urdf"
    return root / f"{path}.{kind}", options


def folder(package: str) -> Path:
    """Return the folder of an installed package, without importing it."""
    spec = util.find_spec(package)
    if spec is None or spec.origin is None:
        raise ImportError(f"{package} is not installed")
    return Path(spec.origin).parent


def robot_data() -> Path:
    """Return the folder of the robots of example-robot-data."""
    for place in sys.path:
        path = Path(place) / "cmeel.prefix" / "share" / "example-robot-data" / "robots"
        if path.is_dir():
            return path
    raise ImportError("example-robot-data is not installed")


def suite_model(name: str, arguments: tuple) -> Any:
    """Return a model of dm_control's suite, built as its tasks build it."""
    import mujoco

    folder("dm_control")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        domain = import_module(f"dm_control.suite.{name}")
        common = import_module("dm_control.suite.common")
    if name == "lqr":
        arguments = (*arguments[:2], np.random.RandomState(0))
    build = getattr(domain, "get_model_and_assets", None) or domain.make_model
    made = build(*arguments)
    text, assets = made if isinstance(made, tuple) else (made, common.ASSETS)
    text = text.decode() if isinstance(text, bytes) else text
    return mujoco.MjModel.from_xml_string(text, dict(assets))


def tried(name: str, s: Settings) -> dict[str, Any]:
    """Load, hold and control one model; return what was found."""
    import jax

    import jaxmpc as jm

    jax.config.update("jax_enable_x64", True)
    row: dict[str, Any] = {"name": name}
    model, options = catalogue()[name]()
    since = time.perf_counter()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            robot = jm.load_robot(model, **options)
        except ValueError as error:
            return row | {"refused": " ".join(str(error).split())}
        row |= {"load": time.perf_counter() - since, "n": robot.n, "m": robot.m}
        report = robot.report()
        row["ignored"] = [*report.predictor_ignores, *(f"left out: {v}" for v in report.left_out)]
        x, u = robot.set_point()
        mpc = jm.robot_mpc(robot, horizon=s.horizon) if s.steps else None
        row["warnings"] = [str(w.message) for w in said if w.category is UserWarning]
    text = " ".join(row["warnings"])
    none, near = "no input holds home", "the nearest configuration"
    row["rest"] = "none" if none in text else "near" if near in text else "home"
    row |= beside_c(robot, x, u, s.seed) | slopes_beside_c(robot, x, u)
    if mpc is None:
        return row
    controller = jm.RobotController(robot, mpc, linearize=s.linearize)
    x0s = starts(robot, mpc, x, s)
    since = time.perf_counter()
    reference = np.asarray(robot.coordinates(x))
    run = jm.simulate_many(
        controller, robot, x0s, s.steps, reference=reference, input_reference=u
    )  # fmt: skip
    row["run"] = time.perf_counter() - since
    xi = np.asarray(jax.vmap(jax.vmap(robot.coordinates))(run.states))
    width = robot.state_limits.half_widths()
    low, high = (np.asarray(v) for v in (robot.state_limits.lower, robot.state_limits.upper))
    excess = (np.maximum(np.maximum(low - xi, xi - high), 0) / width).max(axis=-1)
    low, high = (np.asarray(v) for v in (robot.input_limits.lower, robot.input_limits.upper))
    promised = (np.asarray(run.status) == jm.Status.SOLVED) & ~np.asarray(run.fallback)
    return row | {
        "promise": 100 * float(np.mean(excess[:, 1:][promised] <= 0.01)),
        "finite": bool(np.all(np.isfinite(run.states))),
        "solved": 100 * float(np.mean(run.status == jm.Status.SOLVED)),
        "fallback": 100 * float(np.mean(run.fallback)),
        "kept": 100 * float(np.mean(excess <= 0.01)), "worst": float(np.max(excess)),
        "inputs": bool(np.all((low <= run.inputs) & (run.inputs <= high))),
    }  # fmt: skip


def beside_c(robot: Any, x: np.ndarray, u: np.ndarray, seed: int) -> dict[str, float]:
    """Return how far plant and C engine are apart after 25 periods of random inputs about u, and
    how far the C engine drifts under u."""
    import jax
    import mujoco

    model, rng = robot.mujoco, np.random.default_rng(seed)
    low, high = (np.asarray(v) for v in (robot.input_limits.lower, robot.input_limits.upper))
    # A tenth of the range, less where that changes a speed by more than 0.1 in a period.
    effect = np.abs(robot.linearize(x, u).B).max(axis=0)
    width = np.where(np.isfinite(high - low), (high - low) / 2, np.inf)
    amplitude = np.minimum(0.1 * width, 0.1 / np.maximum(effect, 1e-9))
    inputs = np.clip(u + amplitude * rng.uniform(-1, 1, (25, robot.m)), low, high)
    ends = []
    for row in (inputs, np.tile(u, (25, 1))):
        data = mujoco.MjData(model)
        data.qpos, data.qvel = x[: model.nq], x[model.nq : model.nq + model.nv]
        data.act = x[model.nq + model.nv :]
        for held in row:
            data.ctrl = held
            mujoco.mj_step(model, data, robot.substeps)
        ends.append(np.concatenate([data.qpos, data.qvel, data.act]))
    move = jax.jit(lambda x, rows: jax.lax.scan(lambda x, u: (robot.step(x, u), None), x, rows)[0])
    plant = np.asarray(move(x, inputs))
    apart = lambda a, b: float(np.max(np.abs(a - b) / np.maximum(1, np.abs(b))))
    return {"C": apart(plant, ends[0]), "drift": apart(ends[1], x)}


def slopes_beside_c(robot: Any, x: np.ndarray, u: np.ndarray) -> dict[str, Any]:
    """Return how far A and B are from differences of a period of the C engine, beyond both
    one-sided ones, relative to the largest of each column; and whether constraints act there."""
    import jax
    import mujoco

    model, h = robot.mujoco, 1e-6
    to_state, to_coordinates = jax.jit(robot.state), jax.jit(robot.coordinates)
    data = mujoco.MjData(model)

    def after(xi: np.ndarray, u: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(model, data)
        parts = np.split(np.asarray(to_state(xi)), [model.nq, model.nq + model.nv])
        data.qpos, data.qvel, data.act = parts
        data.ctrl = u
        mujoco.mj_step(model, data, robot.substeps)
        return np.asarray(to_coordinates(np.concatenate([data.qpos, data.qvel, data.act])))

    system = robot.linearize(x, u, exact=True)
    slopes = np.hstack([np.asarray(system.A), np.asarray(system.B)])
    point = np.append(np.asarray(to_coordinates(x)), u)
    here, worst = after(*np.split(point, [robot.n])), 0.0
    acting = data.nefc > 0
    for i, slope in enumerate(slopes.T):
        moved = point + h * np.eye(len(point))[i], point - h * np.eye(len(point))[i]
        up, down = (after(*np.split(one, [robot.n])) for one in moved)
        sides = np.sort([(up - here) / h, (here - down) / h], axis=0)
        beyond = np.maximum(sides[0] - slope, slope - sides[1]).max()
        worst = max(worst, beyond / (np.abs(sides).max() + 1e-9))
    return {"slopes": worst, "acting": bool(acting)}


def starts(robot: Any, mpc: Any, x: np.ndarray, s: Settings) -> np.ndarray:
    """Return states (robots, nq + nv + na) about x: hinge and slide joints moved by at most a tenth
    of the half-width of their range, inside the limits of the problem."""
    model, rng = robot.mujoco, np.random.default_rng(s.seed)
    found, width = np.tile(x, (s.robots, 1)), robot.state_limits.half_widths()
    for kind, at, dof in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind in (2, 3):
            moved = x[at] + 0.1 * min(width[dof], 1.0) * rng.uniform(-1, 1, s.robots)
            found[:, at] = np.clip(moved, mpc.states.lower[dof], mpc.states.upper[dof])
    return found


def run(s: Settings) -> None:
    """Try the models, save the results, and print the table."""
    if s.one:
        print(json.dumps(tried(s.one, s)))
        return
    names = [name for name in catalogue() if not s.models or name.startswith(s.models)]
    s.out.mkdir(parents=True, exist_ok=True)
    path = s.out / "foreign.json"
    rows = json.loads(path.read_text()) if path.exists() else {}
    for name in names:
        sizes = [f"--{key}={getattr(s, key)}" for key in
                 ("robots", "steps", "horizon", "linearize", "seed")]  # fmt: skip
        since = time.perf_counter()
        try:
            done = subprocess.run(
                [sys.executable, __file__, f"--one={name}", *sizes], capture_output=True,
                text=True, timeout=s.seconds, check=False,
            )  # fmt: skip
            failed = (done.stderr.strip().splitlines() or ["no output"])[-1]
            lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
            rows[name] = json.loads(lines[-1]) if lines else {"name": name, "failed": failed}
        except subprocess.TimeoutExpired:
            rows[name] = {"name": name, "failed": f"not done after {s.seconds} s"}
        rows[name]["seconds"] = time.perf_counter() - since
        path.write_text(json.dumps(rows, indent=1))
        print(line(rows[name]), flush=True)
    shown = [rows[name] for name in catalogue() if name in rows]
    print("\n" + TITLE)
    for row in shown:
        print(line(row))
    loaded, ran = (sum(key in row for row in shown) for key in ("load", "solved"))
    print(f"{len(shown)} models: {loaded} load, {ran} ran")


TITLE = (
    f"{'':40}{'n':>4}{'m':>4}{'load s':>8}{'C':>9}{'slopes':>10}{'drift':>9}{'run s':>7}  rest"
    f"{'solved':>8}{'fallback':>9}{'promise':>8}{'kept':>7}{'worst':>8}  ignored"
)


def line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    name = row["name"]
    for key in ("refused", "failed"):
        if key in row:
            return f"{name:40}{key}: {row[key]}"
    start = f"{name:40}{row['n']:>4}{row['m']:>4}{row['load']:>8.1f}"
    slopes = f"{row['slopes']:.0e}{'*' if row['acting'] else ' '}"
    start += f"{row['C']:>9.0e}{slopes:>10}{row['drift']:>9.0e}"
    ignored = "; ".join(row["ignored"])
    if "solved" not in row:
        return f"{start}{'':7}  {row['rest']:4}{'':40}  {ignored}"
    finite = "" if row["finite"] and row["inputs"] else "NOT FINITE OR BEYOND INPUTS "
    return (
        f"{start}{row['run']:>7.0f}  {row['rest']:4}{row['solved']:>8.1f}{row['fallback']:>9.1f}"
        f"{row['promise']:>8.1f}{row['kept']:>7.1f}{row['worst']:>8.2g}  {finite}{ignored}"
    )


if __name__ == "__main__":
    run(tyro.cli(Settings))
