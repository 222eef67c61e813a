"""What can be put on ROS 2: the policy, and the simulator that stands in for the robot.

Nothing here imports ROS before it runs. Every deployment is given factories of the checkpoint's policy and of its
task's environment, and a folder to write to.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vla.deploy.governor import Robot
from vla.deploy.images import Crop
from vla.deploy.ros import Network, ros, spin
from vla.deploy.session import Safety
from vla.types import NonNegative, Positive, Seed

if TYPE_CHECKING:
    from vla.policy import Policy
    from vla.tasks.tabletop import Tabletop


NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)  # of a topic


@dataclass(frozen=True)
class Topics:
    """What the topics are called; remappings apply on top.

    Raises:
        ValueError: ROS has no such names.
    """

    images: dict[str, str]  # camera → topic of sensor_msgs/Image
    joint_states: str  # sensor_msgs/JointState
    instruction: str  # std_msgs/String
    commands: str
    gripper: str | None = None  # Float64MultiArray of finger positions, for the commands that have no room for them

    def __post_init__(self) -> None:
        named = {**asdict(self), **{f"images.{camera}": topic for camera, topic in self.images.items()}}
        for key, topic in named.items():
            if isinstance(topic, str) and not NAME.fullmatch(topic):
                raise ValueError(f"topics.{key} is {topic!r}: a topic is letters, digits and _ between slashes")


@dataclass(frozen=True)
class Timing:
    """How the simulated world keeps time."""

    joints_hz: Positive = 50.0  # of joint states, and of looking for commands
    camera_hz: Positive = 10.0
    camera_latency: NonNegative = 0.0  # from exposure to publication [s]
    command_timeout: Positive = 0.5  # without a command for so long, the arm stays where it is [s]
    clock: bool = False  # publish /clock, and stamp with it
    speed: Positive = 1.0  # of simulated against real time


@dataclass(kw_only=True)
class Ros2:
    """The policy as a managed node.

    Attributes:
        robot: the arm.
        network: who can hear and be heard.
        topics: names of the topics.
        safety: when to hold and when to give up.
        command: JointState with positions, JointTrajectory that ends at rest, or Float64MultiArray of positions.
        command_hz: commands per second.
        image_reliability: how images are subscribed; large ones over a bad network may want "reliable".
        image_crop: what is used of images whose aspect ratio is not that of training: the centre, or all, squeezed.
        autostart: configure and activate at once; otherwise somebody's lifecycle manager does.
        policy, environment, output: given by the job.
    """

    robot: Robot
    network: Network
    topics: Topics
    safety: Safety = field(default_factory=Safety)
    command: Literal["joint_state", "trajectory", "forward"] = "joint_state"
    command_hz: Positive = 50.0
    image_reliability: Literal["best_effort", "reliable"] = "best_effort"
    image_crop: Crop = "centre"
    autostart: bool = True
    policy: Callable[[], Policy]
    environment: Callable[[], Tabletop]
    output: Path

    def run(self) -> None:
        """Serve until interrupted, then brake and hold.

        Raises:
            ValueError: no policy, or one that does not fit the robot.
        """
        policy = self.policy()
        with ros(self.network, self.output) as stopped:
            from vla.deploy.agent import Agent
            from vla.deploy.managed import DONE

            agent = Agent(policy, self)
            try:
                for step in (agent.trigger_configure, agent.trigger_activate) if self.autostart else ():
                    if step() != DONE:
                        raise ValueError("the agent cannot start, its log above says why")
                spin(agent, stopped)
            finally:
                agent.come_to_rest()
                agent.destroy_node()


@dataclass(kw_only=True)
class Simulated:
    """The task's arm as a node, behind the topics of a real one.

    Attributes:
        robot: what the arm is called.
        network: who can hear and be heard.
        topics: names of the topics.
        timing: rates and latencies.
        seed: of the first episode.
        policy, environment, output: given by the job.
    """

    robot: Robot
    network: Network
    topics: Topics
    timing: Timing = field(default_factory=Timing)
    seed: Seed = 1_000_000
    policy: Callable[[], Policy]
    environment: Callable[[], Tabletop]
    output: Path

    def run(self) -> None:
        """Play episodes until interrupted."""
        environment = self.environment()
        with ros(self.network, self.output) as stopped:
            from vla.deploy.simulator import Simulator

            node = Simulator(environment, self.robot, self.topics, self.timing, self.seed)
            try:
                spin(node, stopped)
            finally:
                node.destroy_node()
                environment.close()
