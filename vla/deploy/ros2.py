"""Deployments on ROS 2: the policy, and the simulator in place of a robot.

ROS is imported only in `run`.
"""

from __future__ import annotations

from typing import ClassVar

from vla.deploy.ros import require_ros, ros, spin
from vla.deploy.settings import FOLLOW, PolicySettings, SimulatorSettings, action_class
from vla.io.errors import UserError


class PolicyDeployment(PolicySettings):
    """The policy as a managed node."""

    def run(self) -> None:
        """Run until interrupted, then brake and hold; raise a UserError if policy, robot and messages do not fit."""
        if self.command == FOLLOW:
            action_class("control_msgs", "FollowJointTrajectory")
        if self.gripper is not None:
            self.gripper.goals("gripper")
        require_ros(self.network)  # before a large policy is loaded
        policy = self.policy()
        with ros(self.network, self.output) as stop_event:
            from vla.deploy.lifecycle_node import SUCCESS
            from vla.deploy.policy_node import PolicyNode

            agent = PolicyNode(policy, self)
            try:
                for step in (agent.trigger_configure, agent.trigger_activate) if self.autostart else ():
                    if step() != SUCCESS:
                        raise UserError("the agent cannot start, see its log above")
                spin(agent, stop_event)
            finally:
                agent.brake()
                agent.destroy_node()


class SimulatorDeployment(SimulatorSettings):
    """The simulated arm of a task as a node with the topics of a real one."""

    needs_policy: ClassVar[bool] = False
    needs_environment: ClassVar[bool] = True

    def run(self) -> None:
        """Play episodes until interrupted."""
        environment = self.environment()
        with ros(self.network, self.output) as stop_event:
            from vla.deploy.simulator_node import SimulatorNode

            node = SimulatorNode(environment, self)
            try:
                spin(node, stop_event)
            finally:
                node.destroy_node()
                environment.close()
