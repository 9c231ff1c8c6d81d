"""One picture of robots in motion, from a run of `jaxmpc simulate`.

    jaxmpc simulate --robot arm7 --count 4 --seconds 1 --output runs/a
    python experiments/robots/picture.py runs/a --time 0.2 --output docs/assets/arms.png

The robots are those with the lowest numbers whose states are finite. Without a display set
MUJOCO_GL=egl.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro
import xarray as xr
from PIL import Image

import jaxmpc as jm


@dataclass(frozen=True)
class Settings:
    folder: tyro.conf.Positional[Path]
    time: float = 0.2
    count: int = 4
    width: int = 320
    height: int = 240
    colours: int = 128  # of the PNG, which are enough to look at and take a third of the room
    output: Path = Path("robots.png")


def picture(settings: Settings) -> np.ndarray:
    """Return the frame (h, w, 3) at the sample nearest to the time."""
    summary = json.loads((settings.folder / "summary.json").read_text())
    robot = jm.load_robot(summary["config"]["robot"])
    data = xr.open_zarr(settings.folder / "runs.zarr")
    states, inputs = data["states"].values, data["inputs"].values
    shown = np.flatnonzero(np.isfinite(states).all(axis=(1, 2)))[: settings.count]
    with jax.enable_x64(True):
        target = np.asarray(robot.state(list(summary["target"].values())))[: robot.mujoco.nq]
    k = int(np.clip(round(settings.time / robot.dt), 0, inputs.shape[1] - 1))
    frames = jm.robots.render(
        robot, states[shown, : k + 2], inputs=inputs[shown, : k + 1], target=target,
        every=max(k, 1), width=settings.width, height=settings.height, numbers=shown.tolist(),
    )  # fmt: skip
    return frames[min(k, 1)]


def main(settings: Settings) -> None:
    image = Image.fromarray(picture(settings)).quantize(settings.colours)
    image.save(settings.output, optimize=True)
    print(
        f"{settings.output}: {image.width} x {image.height}, {settings.output.stat().st_size:,} B"
    )


if __name__ == "__main__":
    main(tyro.cli(Settings))
