"""What the robot is asked to do, one goal per file."""
