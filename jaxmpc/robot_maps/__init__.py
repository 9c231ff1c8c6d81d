"""Maps of a robot: what the linear model promises of a state, and what the robot then does.

map_robot      label each state twice, by proof and by the robot's closed loop -> RobotMap
RobotLoops     what those closed loops did
OUTCOMES       what can become of a state
"""

from jaxmpc.robot_maps.outcomes import RobotLoops
from jaxmpc.robot_maps.robot_map import OUTCOMES, RobotMap
from jaxmpc.robot_maps.setting import map_robot

__all__ = ["OUTCOMES", "RobotLoops", "RobotMap", "map_robot"]
