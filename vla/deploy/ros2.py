"""Deployments on ROS 2: the policy, and the simulator in place of a robot.

ROS is imported only in `run`. Every deployment takes factories of the checkpoint's policy and of its task's
environment, and an output folder.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vla.deploy.control_loop import Safety
from vla.deploy.images import Crop
from vla.deploy.joint_limiter import Robot
from vla.deploy.ros import Network, ros, spin
from vla.io.types import NonNegative, Positive, Seed

if TYPE_CHECKING:
    from vla.policy import Policy
    from vla.spec import Environment


NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)  # of a topic


@dataclass(frozen=True)
class Topics:
    """Names of the topics, before remapping.

    Raises:
        ValueError: a name is not valid in ROS.
    """

    images: dict[str, str]  # camera → topic of sensor_msgs/Image
    joint_states: str  # sensor_msgs/JointState
    instruction: str  # std_msgs/String
    commands: str
    gripper: str | None  # Float64MultiArray of finger positions, for commands without fingers

    def __post_init__(self) -> None:
        named = {**asdict(self), **{f"images.{camera}": topic for camera, topic in self.images.items()}}
        for key, topic in named.items():
            if isinstance(topic, str) and not NAME.fullmatch(topic):
                raise ValueError(f"topics.{key} is {topic!r}, expected letters, digits and _ between slashes")


@dataclass(frozen=True)
class Timing:
    """Rates and latencies of the simulator."""

    joints_hz: Positive  # rate of joint states and of command execution
    camera_hz: Positive
    camera_latency: NonNegative  # from exposure to publication [s]
    command_timeout: Positive  # the arm holds after so long without a command [s]
    clock: bool  # publish /clock, and use it for time stamps
    speed: Positive  # ratio of simulated to real time


@dataclass(kw_only=True)
class PolicyDeployment:
    """The policy as a managed node.

    Attributes:
        robot: the arm and its limits.
        network: where to communicate.
        topics: names of the topics.
        safety: time-outs and limits.
        command: JointState with positions, JointTrajectory that ends at rest, or Float64MultiArray of positions.
        command_hz: commands per second.
        image_reliability: QoS of the images; "reliable" helps with large images on a lossy network.
        image_crop: for images with another aspect ratio than in training: crop the centre, or distort the whole.
        autostart: configure and activate at start; otherwise leave that to a lifecycle manager.
        policy, environment: factories of the policy and of the task's environment.
        output: folder of the ROS logs.
    """

    robot: Robot
    network: Network
    topics: Topics
    safety: Safety
    command: Literal["joint_state", "trajectory", "forward"]
    command_hz: Positive
    image_reliability: Literal["best_effort", "reliable"]
    image_crop: Crop
    autostart: bool
    policy: Callable[[], Policy]
    environment: Callable[[], Environment]
    output: Path

    def run(self) -> None:
        """Run until interrupted, then brake and hold.

        Raises:
            ValueError: there is no policy, or it does not fit the robot.
        """
        policy = self.policy()
        with ros(self.network, self.output) as stopped:
            from vla.deploy.lifecycle_node import SUCCESS
            from vla.deploy.policy_node import PolicyNode

            agent = PolicyNode(policy, self)
            try:
                for step in (agent.trigger_configure, agent.trigger_activate) if self.autostart else ():
                    if step() != SUCCESS:
                        raise ValueError("the agent cannot start, see its log above")
                spin(agent, stopped)
            finally:
                agent.brake()
                agent.destroy_node()


@dataclass(kw_only=True)
class SimulatorDeployment:
    """The simulated arm of a task as a node with the topics of a real one.

    Attributes:
        robot: joint names of the arm.
        network: where to communicate.
        topics: names of the topics.
        timing: rates and latencies.
        seed: seed of the first episode.
        policy, environment: factories of the policy and of the task's environment.
        output: folder of the ROS logs.
    """

    robot: Robot
    network: Network
    topics: Topics
    timing: Timing
    seed: Seed
    policy: Callable[[], Policy]
    environment: Callable[[], Environment]
    output: Path

    def run(self) -> None:
        """Play episodes until interrupted."""
        environment = self.environment()
        with ros(self.network, self.output) as stopped:
            from vla.deploy.simulator_node import SimulatorNode

            node = SimulatorNode(environment, self.robot, self.topics, self.timing, self.seed)
            try:
                spin(node, stopped)
            finally:
                node.destroy_node()
                environment.close()
