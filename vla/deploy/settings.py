"""Settings of the nodes: topics, rates and limits. No module of ROS is imported here."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from typing import ClassVar, Literal

from vla.deploy.control_loop import Safety
from vla.deploy.joint_limiter import Robot
from vla.deploy.ros import action_class
from vla.io.errors import UserError
from vla.io.types import NonNegative, Positive, Text

FOLLOW = "follow_joint_trajectory"  # the command that is an action
TRAJECTORY_ACTION = ("control_msgs", "FollowJointTrajectory")
COMPRESSED = "/compressed"  # end of the topics of sensor_msgs/CompressedImage, as of image_transport
NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)  # of a topic


@dataclass(frozen=True)
class Topics:
    """Names of the topics, before remapping.

    Raises:
        UserError: a name is not valid in ROS.
    """

    images: dict[str, str]  # camera → topic of sensor_msgs/Image, or of CompressedImage if it ends with /compressed
    joint_states: str  # sensor_msgs/JointState
    instruction: str  # std_msgs/String
    commands: str  # or action server
    gripper: str | None  # Float64MultiArray of finger positions, for commands without fingers; or action server
    finger_states: str | None  # sensor_msgs/JointState of the fingers, if these come on another topic than the arm

    def __post_init__(self) -> None:
        named = {**asdict(self), **{f"images.{camera}": topic for camera, topic in self.images.items()}}
        for key, topic in named.items():
            if isinstance(topic, str) and not NAME.fullmatch(topic):
                raise UserError(f"topics.{key} is {topic!r}, expected letters, digits and _ between slashes")


@dataclass(frozen=True)
class Timing:
    """Rates and latencies of the simulator."""

    joints_hz: Positive  # rate of joint states and of command execution
    camera_hz: Positive
    camera_latency: NonNegative  # from exposure to publication [s]
    command_timeout: Positive  # the arm holds after so long without a command [s]
    clock: bool  # publish /clock, and use it for time stamps
    speed: Positive  # ratio of simulated to real time


@dataclass(frozen=True)
class GripperCommand:
    """A gripper that takes GripperCommand of control_msgs."""

    open: float  # position of the joint [m] or [rad]
    closed: float
    effort: Positive  # largest [N] or [Nm]

    actions: ClassVar = (("control_msgs", "GripperCommand"),)  # packages and names


@dataclass(frozen=True)
class FrankaGripper:
    """Franka's own gripper, which takes Grasp and Move of franka_msgs."""

    open: Positive  # distance of the fingers [m]
    closed: NonNegative
    epsilon: tuple[NonNegative, NonNegative]  # a grasp holds something so far below or above `closed` [m]
    speed: Positive  # [m/s]
    force: Positive  # [N]

    actions: ClassVar = (("franka_msgs", "Grasp"), ("franka_msgs", "Move"))  # packages and names: to close, to open


@dataclass(kw_only=True)
class PolicySettings:
    """Settings of the policy node.

    Attributes:
        robot: the arm and its limits.
        topics: names of the topics.
        safety: time-outs and limits.
        command: JointState with positions, JointTrajectory that ends at rest, Float64MultiArray of positions,
            TwistStamped of the tool, for Cartesian actions, or goals of the action FollowJointTrajectory.
        twist_frame: base frame of a TwistStamped; None: as the policy names it.
        gripper: action of the gripper; None: it takes positions on a topic.
        command_hz: commands per second.
        image_reliability: QoS of the images; "reliable" helps with large images on a lossy network.
        dry_run: publish the commands below ~/dry_run, where nothing obeys them.
    """

    robot: Robot
    topics: Topics
    safety: Safety
    command: Literal["joint_state", "trajectory", "forward", "twist", "follow_joint_trajectory"]
    twist_frame: Text | None
    gripper: GripperCommand | FrankaGripper | None
    command_hz: Positive
    image_reliability: Literal["best_effort", "reliable"]
    dry_run: bool

    def require_messages(self, command: str) -> None:
        """Raise a UserError if messages that `command` or the gripper needs are not installed."""
        arm = [TRAJECTORY_ACTION] if command == FOLLOW else []
        for package, name in [*arm, *(self.gripper.actions if self.gripper is not None else [])]:
            action_class(package, name)
