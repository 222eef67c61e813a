"""Deployments on ROS 2: the policy, and the simulator in place of a robot.

ROS is imported only in `run`. Every deployment takes factories of the checkpoint's policy and of its task's
environment, and an output folder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from vla.deploy.joint_limiter import Robot
from vla.deploy.ros import RosNetwork, ros, spin
from vla.deploy.settings import PolicySettings, Timing, Topics
from vla.io.errors import UserError
from vla.io.types import Seed

if TYPE_CHECKING:
    from vla.policy import Policy
    from vla.spec import Environment


@dataclass(kw_only=True)
class PolicyDeployment(PolicySettings):
    """The policy as a managed node.

    Attributes:
        network: where to communicate.
        autostart: configure and activate at start; otherwise leave that to a lifecycle manager.
        policy, environment: factories of the policy and of the task's environment.
        output: folder of the ROS logs.
    """

    network: RosNetwork
    autostart: bool
    policy: Callable[[], Policy]
    environment: Callable[[], Environment]
    output: Path

    def run(self) -> None:
        """Run until interrupted, then brake and hold.

        Raises:
            UserError: there is no policy, or it does not fit the robot, or messages are not installed.
        """
        self.require_messages(self.command)
        policy = self.policy()
        with ros(self.network, self.output) as stopped:
            from vla.deploy.lifecycle_node import SUCCESS
            from vla.deploy.policy_node import PolicyNode

            agent = PolicyNode(policy, self)
            try:
                for step in (agent.trigger_configure, agent.trigger_activate) if self.autostart else ():
                    if step() != SUCCESS:
                        raise UserError("the agent cannot start, see its log above")
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

    needs_policy: ClassVar[bool] = False
    needs_environment: ClassVar[bool] = True

    robot: Robot
    network: RosNetwork
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
