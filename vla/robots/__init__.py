"""Robot models, shared by the simulator and the robot: links, limits, inverse kinematics."""
