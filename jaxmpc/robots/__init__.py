"""Plants: robots in MuJoCo MJX, and linear systems in their place.

load_robot            a robot by name, or from an MJCF or URDF file -> Robot
                      with a RobotReport
linear_enclosure      a linear model, and a set that holds what it leaves out -> LinearEnclosure
gait                  a motion on feet that stand in turn, with linear models along it -> Gait
RobotModel            what a controller predicts of a robot, for jaxmpc.mpc.NonlinearMPC
tasks                 positions, orientations, distances and energy, for jaxmpc.mpc.Task
LinearPlant           a linear system with limits, in the place of a robot
render, save_video    images of a motion, and a video of them
Film                  the same for a notebook, which plays it
"""

from jaxmpc.names import suggest_names
from jaxmpc.robots import tasks
from jaxmpc.robots.description import RobotReport
from jaxmpc.robots.film import Film, render, save_video
from jaxmpc.robots.gaits import Gait, gait
from jaxmpc.robots.linear_enclosures import LinearEnclosure, linear_enclosure
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.load import load_robot
from jaxmpc.robots.robot import Robot, RobotModel

__all__ = [
    "Film",
    "Gait",
    "LinearEnclosure",
    "LinearPlant",
    "Robot",
    "RobotModel",
    "RobotReport",
    "gait",
    "linear_enclosure",
    "load_robot",
    "render",
    "save_video",
    "tasks",
]

suggest_names(__name__)
