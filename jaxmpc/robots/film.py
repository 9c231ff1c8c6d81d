"""Videos of robots in motion, by MuJoCo's renderer and without a window, with captions."""

import base64
import copy
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, positive, require_finite, require_kind, require_shape, whole
from jaxmpc.pytrees import record
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.mujoco_access import mujoco, number_of
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.limits import row_violations, rows_kept

# The target has the colour of set-points in the plots; red is for limits alone.
INK, PAPER, RED, TARGET = (40, 40, 40), (255, 255, 255), (200, 20, 20), (0, 158, 115)
OPACITY = 0.45  # of the target
# Hundredths of a second that a GIF can show a frame.
LONGEST = 2**16 - 1
# By how much the shapes of the target are thicker: it is seen around a robot that has arrived.
THICKER = 1.15
# Colours of capsules in place of shapes, of what a model without a skybox leaves black, and of the
# floor under a model that has none; light, for MuJoCo's own colour of shapes is a middle grey.
LINK = np.array([0.75, 0.75, 0.8, 1], np.float32)
BACKGROUND = np.array([0.87, 0.9, 0.93, 1], np.float32)
FLOOR = np.array([0.72, 0.74, 0.76, 1], np.float32)


def render(
    robot: Robot,
    states: Reals,
    *,
    inputs: Reals | None = None,
    target: Reals | None = None,
    every: int = 1,
    width: int = 320,
    height: int = 240,
    camera: str | None = "view",
    labels: bool = True,
    numbers: Sequence[int] | None = None,
) -> np.ndarray:
    """Return the frames (F, h, w, 3), uint8 RGB, of every `every`-th state.

    states: (T+1, nq + nv) of one robot, or (B, T+1, nq + nv) of several, drawn as tiles, row by
    row, in a nearly square arrangement. inputs: (T, m) or (B, T, m), for their limits alone.
    target: a configuration (nq,), or one for each state (T+1, nq), of a green, see-through robot in
    each tile; None for none. every: states from one frame to the next. width, height: pixels of a
    tile. camera: the name of one of the model's; None, or "view" where the model has none of that
    name, for a camera that sees all that moves, at all times. What a model without a skybox leaves
    black is light grey, and a model without a plane gets a floor below all that moves; bodies
    without shapes are capsules from joint to joint.

    labels: write the robot's name and the time in s above, a legend below, and numbers on the
    tiles. numbers: those of the robots, None: from 0.

    A tile has a red frame, with the name of the limit, where the
    robot is beyond one (by more than 1e-6) at a sample from the one shown to the last before the
    next frame; of several it is the one exceeded most as a fraction of half its range.

    Without a display MuJoCo renders through EGL, on a GPU or not: the environment variable
    MUJOCO_GL=egl must be set before mujoco is imported, hence before the first `load_robot`.
    Raises ValueError for wrong shapes and cameras, RuntimeError where nothing can be rendered.
    """
    motions, inputs, ghosts = _checked(robot, states, inputs, target, every)
    for name, value in (("width", width), ("height", height)):
        whole(name, value, 1)
    count = len(motions)
    if numbers is not None and len(numbers) != count:
        fail("numbers", f"{len(numbers)} of {count} robots", "Give one for each")
    model = _drawn(robot.mujoco if robot.shapes is None else robot.shapes, width, height)
    view: Any = camera
    if camera is not None and number_of(model, "camera", camera) < 0:
        if camera != "view":
            fail("camera", f"the model has none named {camera!r}", "Give one of its, or None")
        view = None
    drawn = motions[:, ::every, : model.nq]
    poses = drawn.reshape(-1, model.nq)
    poses = poses if ghosts is None else np.concatenate([poses, ghosts])
    ends = _ends(model, poses)
    if view is None:
        view = _camera(model, ends, width / height)
    planes = _visible(model) & (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    floor = None if np.any(planes) else ends
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    tiles = [(height * (i // columns), width * (i % columns)) for i in range(count)]
    film = np.full((drawn.shape[1], rows * height, columns * width, 3), 255, np.uint8)
    with _renderer(model, width, height) as renderer:
        for (top, left), motion in zip(tiles, drawn, strict=True):
            tile = film[:, top : top + height, left : left + width]
            _draw(tile, renderer, model, view, motion, ghosts, floor)
    for row in range(1, rows):
        film[:, row * height - 1 : row * height + 1] = 255
    for column in range(1, columns):
        film[:, :, column * width - 1 : column * width + 1] = 255
    if not labels:
        return film
    return captioned(
        film,
        tiles,
        (height, width),
        name=robot.name,
        numbers=range(count) if numbers is None else numbers,
        times=robot.dt * every * np.arange(len(film)),
        exceeded=exceeded_limits(robot, motions, inputs, every),
        has_target=ghosts is not None,
    )


def _checked(
    robot: Robot, states: Reals, inputs: Reals | None, target: Any, every: int
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Return states (B, T+1, nq + nv), inputs (B, T, m) and the target's qpos at each frame
    (F, nq), None where there are none; raise ValueError for wrong arguments of `render`."""
    require_kind("robot", robot, Robot, cure="Only a Robot has a shape to draw")
    states = host_array("states", states)
    if states.ndim not in (2, 3) or states.shape[-1] != robot.state_size or not states.size:
        fail("states", f"shape {states.shape}", f"Give ([robots,] samples, {robot.state_size})")
    require_finite("states", states)
    whole("every", every, 1)
    samples, nq = states.shape[-2], robot.mujoco.nq
    if inputs is not None:
        inputs = host_array("inputs", inputs)
        shape = (*states.shape[:-2], samples - 1, robot.m)
        require_shape("inputs", inputs, shape, "Give those between the states")
        inputs = inputs.reshape(-1, *shape[-2:])
    if target is not None:
        target = host_array("target", target)
        shape = (samples, nq) if target.ndim == 2 else (nq,)
        require_shape("target", target, shape, "Give one qpos, or one for each state")
        require_finite("target", target)
        target = np.broadcast_to(target, (samples, nq))[::every]
    return states.reshape(-1, *states.shape[-2:]), inputs, target


def _drawn(model: "mujoco.MjModel", width: int, height: int) -> "mujoco.MjModel":
    """Return a copy of a model with room for pictures of this size, light enough, seen in
    perspective, and with the hidden shapes of bodies that have no others, such as those for
    collisions beside a mesh that is missing."""
    model = copy.deepcopy(model)
    buffer, light = model.vis.global_, model.vis.headlight
    buffer.offwidth, buffer.offheight = max(buffer.offwidth, width), max(buffer.offheight, height)
    # MuJoCo's default of 4096 takes most of the time where the CPU draws.
    model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, 1024)
    if not model.nlight:
        light.ambient[:] = np.maximum(light.ambient, 0.6)
        light.diffuse[:] = np.maximum(light.diffuse, 0.6)
    if buffer.orthographic:  # then fovy is a length
        buffer.orthographic, buffer.fovy = 0, 45
    seen = np.bincount(model.geom_bodyid[_visible(model)], minlength=model.nbody) > 0
    shown = ~seen[model.geom_bodyid] & (model.body_weldid[model.geom_bodyid] != 0)
    model.geom_group[shown], model.geom_matid[shown], model.geom_rgba[shown, 3] = 0, -1, 1.0
    return model


def _visible(model: "mujoco.MjModel") -> np.ndarray:
    """Return which shapes MuJoCo draws unless told otherwise: of groups 0 to 2, not transparent."""
    alpha, material = model.geom_rgba[:, 3], model.geom_matid
    if model.nmat:
        alpha = np.where(material >= 0, model.mat_rgba[material, 3], alpha)
    return (model.geom_group < 3) & (alpha > 0)


def _renderer(model: "mujoco.MjModel", width: int, height: int) -> "mujoco.Renderer":
    """Return MuJoCo's renderer; raise RuntimeError where there is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns of what follows as an error
            return mujoco.Renderer(model, height, width)
    except Exception as error:  # of MuJoCo, OpenGL or EGL, whichever is missing
        said = shorten(str(error), 400, placeholder=" …") or type(error).__name__
        raise RuntimeError(
            "no video: MuJoCo finds no renderer. Without a display set MUJOCO_GL=egl before Python "
            "starts (export MUJOCO_GL=egl); on Debian or Ubuntu install libegl1 libegl-mesa0 "
            f"libgl1-mesa-dri libgl1. MuJoCo says: {said}"
        ) from None


def _draw(
    frames: np.ndarray,
    renderer: "mujoco.Renderer",
    model: "mujoco.MjModel",
    view: Any,
    motion: np.ndarray,
    target: np.ndarray | None,
    floor: np.ndarray | None,
) -> None:
    """Draw one robot at its qpos (F, nq) into frames (F, h, w, 3), the target beside it, and a
    floor below the box with these corners (2, 3)."""
    data, ghost = mujoco.MjData(model), mujoco.MjData(model)
    sky = np.any(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    for k, (frame, q) in enumerate(zip(frames, motion, strict=True)):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, view)
        _add_links(renderer.scene, model, data)
        if target is not None:
            ghost.qpos[:] = target[k]
            mujoco.mj_forward(model, ghost)
            _add_ghost(renderer.scene, model, ghost)
        if not sky:
            _add_backdrop(renderer.scene)
        if floor is not None and len(floor):
            _add_floor(renderer.scene, *floor)
        frame[:] = renderer.render()


def _add_backdrop(scene: "mujoco.MjvScene") -> None:
    """Add a grey wall far behind a scene whose model has no skybox, which would be black there."""
    eye = (scene.camera[0].pos + scene.camera[1].pos) / 2
    ahead, up = scene.camera[0].forward, scene.camera[0].up
    far = 0.9 * scene.camera[0].frustum_far
    wall = scene.geoms[scene.ngeom]
    frame = np.stack([np.cross(up, -ahead), up, -ahead], axis=1)
    size, place = far * np.array([3, 3, 1e-3]), eye + far * ahead
    mujoco.mjv_initGeom(wall, mujoco.mjtGeom.mjGEOM_BOX, size, place, frame.ravel(), BACKGROUND)
    wall.emission, wall.specular, wall.category = 1, 0, mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1


def _add_floor(scene: "mujoco.MjvScene", lower: np.ndarray, upper: np.ndarray) -> None:
    """Add a plate a little below a box with these corners, twice as wide as the box is long."""
    side = float(np.max(upper - lower))
    middle = (lower + upper) / 2
    place = np.array([middle[0], middle[1], lower[2] - 0.02 * side])
    plate, size = scene.geoms[scene.ngeom], side * np.array([1.0, 1.0, 0.01])
    mujoco.mjv_initGeom(plate, mujoco.mjtGeom.mjGEOM_BOX, size, place, np.eye(3).ravel(), FLOOR)
    plate.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1


def _ends(model: "mujoco.MjModel", poses: np.ndarray) -> np.ndarray:
    """Return the corners (2, 3) of a box around what moves at all poses (k, nq), (0, 3) where
    nothing does."""
    data = mujoco.MjData(model)
    moving = (model.body_weldid[model.geom_bodyid] != 0) & (model.geom_rbound > 0)
    size, ends = model.geom_rbound[moving, None], []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        at = data.geom_xpos[moving]
        links = np.array([end for pair in _links(model, data) for end in pair]).reshape(-1, 3)
        points = np.concatenate([at - size, at + size, links])
        if len(points):
            ends += [points.min(axis=0), points.max(axis=0)]
    return np.array([np.min(ends, axis=0), np.max(ends, axis=0)]) if ends else np.zeros((0, 3))


def _camera(model: "mujoco.MjModel", ends: np.ndarray, aspect: float) -> "mujoco.MjvCamera":
    """Return MuJoCo's free camera, moved so that it sees the box with these corners, from `_ends`.

    aspect: width by height of a picture."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    if not len(ends):
        return camera
    lower, upper = ends
    half = np.deg2rad(model.vis.global_.fovy) / 2
    narrow = min(half, np.arctan(np.tan(half) * aspect))
    camera.lookat[:] = (lower + upper) / 2
    camera.distance = 0.5 * np.linalg.norm(upper - lower) / np.sin(narrow)
    return camera


def _links(model: "mujoco.MjModel", data: "mujoco.MjData") -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the ends of a line for each body without shapes of its own that moves: from its joint
    to the next ones, from that of a last body to its centre of mass and as far beyond."""
    found = []
    for body in range(1, model.nbody):
        if model.body_geomnum[body] or not model.body_weldid[body]:
            continue
        at = data.xpos[body]
        later = np.flatnonzero(model.body_parentid == body)
        ends = [data.xpos[child] for child in later if child != body]
        found += [(at, end) for end in ends or [2 * data.xipos[body] - at]]
    return found


def _add_links(scene: "mujoco.MjvScene", model: "mujoco.MjModel", data: "mujoco.MjData") -> None:
    """Add a capsule for each body without shapes."""
    links = _links(model, data)
    longest = max((float(np.linalg.norm(b - a)) for a, b in links), default=0.0)
    for a, b in links:
        if scene.ngeom == scene.maxgeom or not np.any(a != b):
            continue
        capsule, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(capsule, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), LINK)
        mujoco.mjv_connector(capsule, kind, 0.08 * longest, a, b)
        capsule.category = mujoco.mjtCatBit.mjCAT_DYNAMIC
        scene.ngeom += 1


def _add_ghost(scene: "mujoco.MjvScene", model: "mujoco.MjModel", data: "mujoco.MjData") -> None:
    """Add the moving bodies of a second robot to a scene, green and see-through.

    Each is 1 % further from the camera than it should be, along its line of sight: what coincides
    with the robot itself is then hidden behind it, rather than drawn in turns with it. Shapes other
    than meshes are thicker, and stay in sight around it.
    """
    first, moving = scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
    mujoco.mjv_addGeoms(model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), moving, scene)
    _add_links(scene, model, data)
    eye = (scene.camera[0].pos + scene.camera[1].pos) / 2
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:] = [*(v / 255 for v in TARGET), OPACITY]
        geom.matid, geom.reflectance = -1, 0.0
        geom.pos[:] += 0.01 * (geom.pos - eye)
        if geom.type != mujoco.mjtGeom.mjGEOM_MESH:
            geom.size[:] = THICKER * geom.size


@record
class Film:
    """A film of `render`'s frames, which notebooks play.

    frames: (F, h, w, 3), uint8. fps: frames a second.

    It is an image in the page (a GIF), so that a saved notebook needs no file beside it.
    Raises ValueError for other frames.
    """

    frames: np.ndarray
    fps: float

    def __post_init__(self) -> None:
        check_frames(self.frames, self.fps)

    def _repr_html_(self) -> str:
        """Return the film as HTML, which Jupyter shows."""
        data = io.BytesIO()
        write_gif(data, self.frames, self.fps)
        text = base64.b64encode(data.getvalue()).decode()
        return f'<img src="data:image/gif;base64,{text}" alt="{len(self.frames)} frames">'


def save_video(path: str | Path, frames: Any, fps: float) -> None:
    """Write frames (F, h, w, 3), uint8, of `render` as path.gif, or as path.mp4.

        frames = jm.robots.render(robot, run.states)
        jm.robots.save_video("arm.gif", frames, fps=1 / robot.dt)

    GIF needs nothing more; MP4 needs imageio with ffmpeg, `pip install "imageio[ffmpeg]"`, which no
    extra of jaxmpc brings along. fps: frames a second. A GIF begins its frames at
    whole hundredths of a second, leaves those out that would be seen for less than two of these,
    and joins frames that are equal.
    Raises ValueError for other endings and frames, and where .mp4 cannot be written.
    """
    cure = 'Give the path first: save_video("film.gif", frames, fps)'
    require_kind("path", path, str, Path, cure=cure)
    path, frames = Path(path), np.asarray(frames)
    check_frames(frames, fps)
    kind = path.suffix.lower()
    if kind == ".gif":
        write_gif(path, frames, fps)
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


def check_frames(frames: Any, fps: float) -> None:
    """Raise ValueError unless these are frames, and a number of them a second."""
    frames = np.asarray(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not frames.size:
        problem = f"shape {frames.shape}, {frames.dtype}"
        fail("frames", problem, "Give (frames, height, width, 3), uint8")
    positive("fps", fps)


def write_gif(file: Any, frames: np.ndarray, fps: float) -> None:
    """Write frames to a path or an open file, as a GIF that starts again at its end."""
    from PIL import Image

    # Times are whole hundredths of a second, and viewers take less than two of them for ten.
    starts = np.round(np.arange(len(frames) + 1) * 100 / fps).astype(int)
    kept = [0]
    for k in range(1, len(frames)):
        if starts[k] >= starts[kept[-1]] + 2:
            kept.append(k)
    if len(kept) > 1 and starts[-1] < starts[kept[-1]] + 2:
        kept.pop()
    hundredths = np.append(np.diff(starts[kept]), max(starts[-1] - starts[kept[-1]], 2))
    if hundredths.max() > LONGEST:
        fail("fps", f"{fps}", f"Give at least {100 / LONGEST:.2g}: GIFs have no longer frames")
    frames = frames[kept]
    # One palette for all frames: with one each, colours flicker.
    sheet = Image.fromarray(frames[:: max(1, len(frames) // 8)].reshape(-1, *frames.shape[2:]))
    palette = sheet.quantize(256)
    first, *rest = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    )
    times = (10 * hundredths).tolist()
    first.save(file, format="GIF", save_all=True, append_images=rest, duration=times, loop=0)


def captioned(
    film: np.ndarray,
    tiles: Sequence[tuple[int, int]],
    size: tuple[int, int],
    *,
    name: str,
    numbers: Sequence[int],
    times: np.ndarray,
    exceeded: np.ndarray,
    has_target: bool,
) -> np.ndarray:
    """Return the frames (F, h, w, 3) with a line above and a legend below.

    tiles: (top, left) of each of the B robots; size: (height, width) of a tile. Written are the
    robot's name, the numbers of the robots, the times (F,) in s, and the name of the limit that is
    exceeded (B, F), "" for none.
    """
    from PIL import Image, ImageDraw

    font = _font(round(np.clip(size[0] / 18, 12, 18)))
    line = font.size + 8
    target = [(TARGET, "see-through: target")] if has_target else []
    entries = [*target, (RED, "red frame: beyond a limit")]
    legend = _lines(entries, font, film.shape[2] - 8)
    room = ((0, 0), (line, line * len(legend)), (0, 0), (0, 0))
    film = np.pad(film, room, constant_values=255)
    edge = max(3, size[0] // 60)
    for k, frame in enumerate(film):
        picture = Image.fromarray(frame)
        draw = ImageDraw.Draw(picture)
        clock = f"{times[k]:.2f} s"
        draw.text((6, 3), name, INK, font)
        draw.text((film.shape[2] - 6 - font.getlength(clock), 3), clock, INK, font)
        for (top, left), number, limit in zip(tiles, numbers, exceeded[:, k], strict=True):
            top += line
            if limit:
                corners = (left, top, left + size[1] - 1, top + size[0] - 1)
                draw.rectangle(corners, outline=RED, width=edge)
                text = _fitting(f"beyond limit: {limit}", font, size[1] - 2 * edge - 8)
                _plate(draw, (left + edge, top + size[0] - edge - line), text, font, PAPER, RED)
            _plate(draw, (left + edge, top + edge), f"robot {number}", font, INK, PAPER)
        for i, entries in enumerate(legend):
            x, y = 6.0, film.shape[1] - line * (len(legend) - i) + 3
            for colour, text in entries:
                box = (x, y + 2, x + font.size - 2, y + font.size)
                draw.rectangle(box, colour if colour == TARGET else PAPER, colour, width=2)
                draw.text((x + font.size + 3, y), text, INK, font)
                x += _width((colour, text), font)
        frame[:] = np.asarray(picture)
    return film


def exceeded_limits(robot: Robot, states: np.ndarray, inputs: Any, every: int) -> np.ndarray:
    """Return which limit is exceeded, as a text (B, F), "" for none.

    It is the one that is exceeded most, as a fraction of half its range, at the samples from one
    frame to the next. states (B, T+1, nq + nv), inputs (B, T, m) or None.
    """
    xi = host_coordinates(robot, states)
    names = (*robot.state_names, *robot.input_names)
    units = (*robot.state_units, *robot.input_units)
    labels = [f"{n} [{unit}]" if unit else n for n, unit in zip(names, units, strict=True)]
    over = np.zeros((*xi.shape[:2], robot.n + robot.m))
    pairs = [(robot.state_limits, xi, slice(0, robot.n))]
    if inputs is not None:
        held = np.concatenate([inputs, inputs[:, -1:]], axis=1)
        pairs.append((robot.input_limits, held, slice(robot.n, None)))
    for limits, values, part in pairs:
        excess = row_violations(limits, values) / limits.half_widths()
        over[..., part] = np.where(rows_kept(limits, values), 0.0, excess)
    worst = np.maximum.reduceat(over, np.arange(0, over.shape[1], every), axis=1)
    index = np.where(worst.max(axis=2) > 0, 1 + worst.argmax(axis=2), 0)
    return np.array(["", *labels])[index]


def _lines(entries: list[Any], font: Any, width: float) -> list[list[Any]]:
    """Return the entries of the legend, divided into lines that fit."""
    lines: list[list[Any]] = [[]]
    for entry in entries:
        if lines[-1] and sum(_width(e, font) for e in [*lines[-1], entry]) > width:
            lines.append([])
        lines[-1].append(entry)
    return lines


def _width(entry: tuple[Any, str], font: Any) -> float:
    """Return the width of an entry of the legend, with the space that follows it."""
    return 2 * font.size + 4 + font.getlength(entry[1])


def _plate(draw: Any, place: tuple[int, int], words: str, font: Any, ink: Any, paper: Any) -> None:
    """Write words in a box whose upper left corner is `place`."""
    x, y = place
    draw.rectangle((x, y, x + font.getlength(words) + 8, y + font.size + 7), fill=paper)
    draw.text((x + 4, y + 3), words, ink, font)


def _fitting(words: str, font: Any, width: float) -> str:
    """Return the words, cut at the end to this width in pixels."""
    while len(words) > 1 and font.getlength(words) > width:
        words = words[:-2] + "…"
    return words


def _font(size: int) -> Any:
    """Return the font that matplotlib brings along: Pillow's own lacks most of Unicode."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size
    )
