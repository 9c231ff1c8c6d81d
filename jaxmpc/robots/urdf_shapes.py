"""The shapes of a URDF, for pictures alone: plants are made without them."""

import copy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from jaxmpc.robots.mujoco_access import mujoco

# Meshes that MuJoCo reads.
_FORMATS = (".stl", ".obj", ".msh")


def drawable(root: ElementTree.Element, folder: Path) -> ElementTree.Element:
    """Return a copy of a URDF with the shapes that can be drawn: of each link the visual ones,
    where there are none those for collisions, without meshes that are missing or unreadable."""
    root = copy.deepcopy(root)
    for link in root.iter("link"):
        kept = False
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                if kept and kind == "collision" or not _found(element, folder):
                    link.remove(element)
            kept = kept or bool(link.findall(kind))
    for settings in root.findall("mujoco"):
        root.remove(settings)
    settings = ElementTree.SubElement(root, "mujoco")
    switches = {"discardvisual": "false", "strippath": "false", "balanceinertia": "true"}
    ElementTree.SubElement(settings, "compiler", switches)
    return root


def compiled_shapes(root: ElementTree.Element) -> "mujoco.MjModel | None":
    """Return the model of `drawable` shapes, compiled, None where there is nothing to draw; where
    MuJoCo cannot read them, without meshes."""
    for again in range(2):
        if again:
            for link in root.iter("link"):
                for element in [*link.findall("visual"), *link.findall("collision")]:
                    if element.find("geometry/mesh") is not None:
                        link.remove(element)
        try:
            model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
        except ValueError:
            continue
        return model if model.ngeom else None
    return None


def _found(shape: ElementTree.Element, folder: Path) -> bool:
    """Return whether a shape can be drawn; write the full path of its mesh into it."""
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return True
    path = _path(str(mesh.get("filename", "")), folder)
    if path is None or path.suffix.lower() not in _FORMATS:
        return False
    mesh.set("filename", str(path))
    return True


def _path(name: str, folder: Path) -> Path | None:
    """Return the file that a URDF in this folder names: beside it, or, of "package://…", below one
    of the folders above it, with the package's name or without; None where there is none."""
    plain = name.removeprefix("file://").removeprefix("package://")
    parts = Path(plain).parts
    ends = [parts, parts[1:]] if name.startswith("package://") else [parts]
    for above in (folder, *folder.parents):
        for end in ends:
            path = above.joinpath(*end)
            if end and path.is_file():
                return path.resolve()
        if not name.startswith("package://"):
            return None
    return None
