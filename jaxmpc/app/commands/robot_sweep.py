"""`--robot` of the commands sweep and recursion: a robot's map, its picture and its table."""

import time
from pathlib import Path
from typing import Any

from jaxmpc.robot_maps.stored_sweep import sweep_robot


def map_robot_into(robot: str, output: Path, refine: bool = True, **options: Any) -> None:
    """Run `sweep_robot`, draw and print its map. Raises ValueError as it does, before anything
    compiles."""
    begun = time.perf_counter()
    rmap = sweep_robot(robot, output, gap=1e-6 if refine else None, progress=True, **options)
    files = ["summary.json", "robot_map.npz"]
    if rmap.x0s.shape[1] == 2:
        from jaxmpc.app.plots.robot_map import plot_robot_map
        from jaxmpc.app.plots.style import save

        save(plot_robot_map(rmap).figure, output / "robot_map.png")
        files.append("robot_map.png")
    print(rmap)
    if rmap.recursion is not None:
        print(f"linear model, in deviations from the set-point\n{rmap.recursion}")
    print(f"  {'total':<17} {time.perf_counter() - begun:.2f} s with set-up and files")
    print(f"  {'files':<17} {' '.join(str(output / name) for name in files)}")
