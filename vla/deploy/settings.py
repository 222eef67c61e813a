"""Settings of the nodes. No module of ROS is imported here until a goal is made."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from vla.deploy.joint_limiter import JointLimits
from vla.deploy.ros import RosNetwork
from vla.deploy.safety import Safety
from vla.io.errors import UserError
from vla.io.types import NonNegative, Positive, Seed

if TYPE_CHECKING:
    from vla.policy import Policy
    from vla.spec import Environment

COMPRESSED = "/compressed"  # end of the topics of sensor_msgs/CompressedImage, as of image_transport
NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)  # of a topic
FOLLOW = "follow_joint_trajectory"  # the command that is an action


@dataclass(frozen=True)
class Topics:
    """Names of the topics, before remapping. Raises a UserError if a name is not valid in ROS."""

    images: dict[str, str]  # camera → topic of sensor_msgs/Image, or, ending in /compressed, CompressedImage
    joint_states: str  # sensor_msgs/JointState
    instruction: str  # std_msgs/String
    commands: str  # or action server
    gripper: str | None  # Float64MultiArray of finger positions, for commands without fingers; or action server
    finger_states: str | None  # sensor_msgs/JointState of the fingers, if these come on another topic than the arm

    def __post_init__(self) -> None:
        topics = {**asdict(self), **{f"images.{camera}": topic for camera, topic in self.images.items()}}
        for key, topic in topics.items():
            if isinstance(topic, str) and not NAME.fullmatch(topic):
                raise UserError(f"topics.{key} is {topic!r}, expected letters, digits and _ between slashes")


class Goal(NamedTuple):
    """A goal of an action."""

    kind: Any  # class of the action
    server: str
    message: Any
    complaint: Callable[[Any, bool], str]  # as in `GoalSender`


@dataclass(frozen=True)
class GripperCommand:
    """A gripper that takes GripperCommand of control_msgs."""

    open: float  # position of the joint [m] or [rad]
    closed: float
    effort: Positive  # largest [N] or [Nm]

    def goals(self, server: str) -> tuple[Goal, Goal]:
        """Return the goals that close and open it; raise a UserError if the messages are not installed."""
        kind = action_class("control_msgs", "GripperCommand")
        close_goal, open_goal = kind.Goal(), kind.Goal()
        for goal, position in ((close_goal, self.closed), (open_goal, self.open)):  # YAML may hold whole numbers
            goal.command.position, goal.command.max_effort = float(position), float(self.effort)

        def complaint(result: Any, replaced: bool) -> str:
            # A stalled gripper has grasped something, which is no error.
            return "" if result.stalled else "it does not reach its position"

        return Goal(kind, server, close_goal, complaint), Goal(kind, server, open_goal, complaint)


@dataclass(frozen=True)
class FrankaGripper:
    """Franka's own gripper, which takes Grasp and Move of franka_msgs."""

    open: Positive  # distance of the fingers [m]
    closed: NonNegative
    epsilon: tuple[NonNegative, NonNegative]  # tolerance of a grasp below and above `closed` [m]
    speed: Positive  # [m/s]
    force: Positive  # [N]

    def goals(self, server: str) -> tuple[Goal, Goal]:
        """Return the goals that close and open it; raise a UserError if the messages are not installed."""
        grasp, move = (action_class("franka_msgs", name) for name in ("Grasp", "Move"))
        speed, force = float(self.speed), float(self.force)  # YAML may hold whole numbers
        open_goal = move.Goal(width=float(self.open), speed=speed)
        close_goal = grasp.Goal(width=float(self.closed), speed=speed, force=force)
        close_goal.epsilon.inner, close_goal.epsilon.outer = map(float, self.epsilon)
        return (
            # A missed grasp has an empty error text, so only errors of the driver count.
            Goal(grasp, f"{server}/grasp", close_goal, lambda result, _: result.error),
            Goal(move, f"{server}/move", open_goal, lambda result, _: result.error or "it does not reach its width"),
        )


def action_class(package: str, name: str) -> Any:
    """Return the class of an action; raise a UserError if its package is not installed."""
    try:
        return getattr(import_module(f"{package}.action"), name)
    except (ImportError, AttributeError) as error:
        command = f"apt install ros-jazzy-{package.replace('_', '-')}"
        source = "build franka_ros2" if package == "franka_msgs" else command
        raise UserError(
            f"{package}/action/{name} is not installed: {source}, and source its setup.bash before the start ({error})"
        ) from error


@dataclass(kw_only=True)
class NodeSettings:
    """Settings of both nodes.

    Attributes:
        robot: the joints of the arm and their limits.
        topics: names of the topics.
        network: where to communicate.
        policy, environment: factories of the checkpoint's policy and of its task's environment.
        output: folder of the ROS logs.
    """

    robot: JointLimits
    topics: Topics
    network: RosNetwork
    policy: Callable[[], Policy]
    environment: Callable[[], Environment]
    output: Path


@dataclass(kw_only=True)
class PolicySettings(NodeSettings):
    """Settings of the policy node.

    Attributes:
        command: JointState with positions, JointTrajectory that ends at rest, Float64MultiArray of positions, or goals
            of the action FollowJointTrajectory.
        gripper: action of the gripper; None: it takes positions on a topic.
        command_hz: commands per second.
        dry_run: publish the commands below ~/dry_run, where nothing obeys them.
        safety: time-outs and limits.
        autostart: configure and activate at start; otherwise leave that to a lifecycle manager.
    """

    command: Literal["joint_state", "trajectory", "forward", "follow_joint_trajectory"]
    gripper: GripperCommand | FrankaGripper | None
    command_hz: Positive
    dry_run: bool
    safety: Safety
    autostart: bool


@dataclass(kw_only=True)
class SimulatorSettings(NodeSettings):
    """Settings of the simulator node.

    Attributes:
        joints_hz: rate of joint states and of the execution of commands.
        camera_hz: rate of images.
        command_timeout: the arm holds after so long without a command [s].
        seed: seed of the first episode.
    """

    joints_hz: Positive
    camera_hz: Positive
    command_timeout: Positive
    seed: Seed
