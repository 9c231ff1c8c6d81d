"""Maps of robots: what the linear model predicts of a state, and what the robot then does.

map_robot      label each state twice, by proof and by the robot's closed loop -> RobotMap
               of RobotLoops
sweep_robot    the same for a grid of states of a robot's file, into a folder, to be resumed
OUTCOMES       what can become of a state
"""

from jaxmpc.names import suggest_names
from jaxmpc.robot_maps.mapping import map_robot
from jaxmpc.robot_maps.robot_map import OUTCOMES, RobotLoops, RobotMap
from jaxmpc.robot_maps.stored_sweep import sweep_robot

__all__ = [
    "OUTCOMES",
    "RobotLoops",
    "RobotMap",
    "map_robot",
    "sweep_robot",
]

suggest_names(__name__)
