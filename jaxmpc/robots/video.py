"""Videos of robots, by MuJoCo's renderer and without a window."""

import copy
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.checks import fail, require_finite, whole
from jaxmpc.robots.robot import Robot


def render(
    robot: Robot, states: Any, *, every: int = 1, width: int = 320, height: int = 240,
    camera: str | None = "view",
) -> np.ndarray:  # fmt: skip
    """Return the frames (F, h, w, 3), uint8 RGB, of every `every`-th state.

    states: (T+1, nq + nv) of one robot, or (B, T+1, nq + nv) of several, drawn as tiles, row by
    row, in a nearly square arrangement. width, height: pixels of a tile. camera: the name of one of
    the model's; None, or "view" where the model has none of that name, for MuJoCo's free camera.

    Without a display MuJoCo renders through EGL, on a GPU or not: the environment variable
    MUJOCO_GL=egl must be set before mujoco is imported, hence before the first `load_robot`.
    Raises ValueError for wrong shapes and cameras, RuntimeError where nothing can be rendered.
    """
    import mujoco

    if not isinstance(robot, Robot):
        fail("robot", f"is a {type(robot).__name__}", "Only a Robot has a shape to draw")
    states = np.asarray(states, float)
    if states.ndim not in (2, 3) or states.shape[-1] != robot.state_size or not states.size:
        fail("states", f"shape {states.shape}", f"Give ([robots,] samples, {robot.state_size})")
    require_finite("states", states)
    for name, value in (("every", every), ("width", width), ("height", height)):
        whole(name, value, 1)
    model = copy.deepcopy(robot.mujoco)
    buffer = model.vis.global_
    buffer.offwidth, buffer.offheight = max(buffer.offwidth, width), max(buffer.offheight, height)
    # MuJoCo's default of 4096 takes most of the time where the CPU draws.
    model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, 1024)
    if camera is not None and mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera) < 0:
        if camera != "view":
            fail("camera", f"the model has none named {camera!r}", "Give one of its, or None")
        camera = None
    configurations = states[..., :: int(every), : model.nq].reshape(
        -1, len(range(0, states.shape[-2], int(every))), model.nq
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns of what follows as an error
            renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # of MuJoCo, OpenGL or EGL, whichever is missing
        raise RuntimeError(
            f"no video: MuJoCo finds no renderer ({' '.join(str(error).split())[:120]}). Without "
            "a display set MUJOCO_GL=egl before Python starts; on Debian or Ubuntu install "
            "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"
        ) from None
    count, frames, _ = configurations.shape
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    film = np.full((frames, rows * height, columns * width, 3), 255, np.uint8)
    data = mujoco.MjData(model)
    with renderer:
        for i, motion in enumerate(configurations):
            top, left = height * (i // columns), width * (i % columns)
            for frame, q in zip(film, motion, strict=True):
                data.qpos[:] = q
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, -1 if camera is None else camera)
                frame[top : top + height, left : left + width] = renderer.render()
    for row in range(1, rows):
        film[:, row * height - 1 : row * height + 1] = 255
    for column in range(1, columns):
        film[:, :, column * width - 1 : column * width + 1] = 255
    return film


def save_video(path: str | Path, frames: Any, fps: float) -> None:
    """Write frames (F, h, w, 3), uint8, as path.gif, or as path.mp4 if imageio has ffmpeg.

    fps: frames a second; GIF rounds the time of a frame to 10 ms and joins frames that are equal.
    Raises ValueError for other endings and frames, and where .mp4 cannot be written.
    """
    path, frames = Path(path), np.asarray(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not frames.size:
        problem = f"shape {frames.shape}, {frames.dtype}"
        fail("frames", problem, "Give (frames, height, width, 3), uint8")
    if not 0 < fps < np.inf:
        fail("fps", f"{fps}", "Give a positive number")
    kind = path.suffix.lower()
    if kind == ".gif":
        from PIL import Image

        # One palette for all frames: with one each, colours flicker.
        sheet = Image.fromarray(frames[:: max(1, len(frames) // 8)].reshape(-1, *frames.shape[2:]))
        palette = sheet.quantize(256)
        first, *rest = (
            Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
            for frame in frames
        )
        milliseconds = max(10, 10 * round(100 / fps))
        first.save(path, save_all=True, append_images=rest, duration=milliseconds, loop=0)
    elif kind == ".mp4":
        try:
            import imageio.v3 as imageio
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            fail(
                str(path), "MP4 needs imageio with ffmpeg", "Install imageio[ffmpeg], or give .gif"
            )
        imageio.imwrite(path, frames, fps=fps)
    else:
        fail(str(path), f"the ending {kind!r} is no video", "Give .gif or .mp4")
