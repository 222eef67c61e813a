"""Outputs of the policy node to an arm and its gripper: messages and action goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.duration import Duration
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vla.deploy.actions import GoalSender
from vla.deploy.control_loop import ControlLoop
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.deploy.motion import Command
from vla.deploy.settings import FOLLOW, PolicySettings, action_class

# Time of a plan in every trajectory [s]: the next tick replaces it, and computing all of a long plan outlasts a tick.
LOOK_AHEAD = 0.3
CLOSE_BELOW, OPEN_ABOVE = 0.4, 0.6  # commanded opening of a gripper at which its goal changes
REPLACEMENT_CODES = (0, -1)  # error codes of FollowJointTrajectory for a goal that another one has replaced


class ArmOutput:
    """Publishes every command for the arm; in a dry run below ~/dry_run, where nothing obeys.

    With FollowJointTrajectory a goal is sent whenever the plan changes, and commands are published for recordings only.
    """

    def __init__(self, node: GuardedLifecycleNode, loop: ControlLoop, settings: PolicySettings) -> None:
        self._node, self._loop = node, loop
        kinds = {"trajectory": (JointTrajectory, self._trajectory), "forward": (Float64MultiArray, self._positions)}
        kind, self._message = kinds.get(settings.command, (JointState, self._joint_state))
        topic, self.senders = settings.topics.commands, list[GoalSender]()
        if settings.command == FOLLOW and not settings.dry_run:
            action = action_class("control_msgs", "FollowJointTrajectory")
            self.senders, topic = [GoalSender(node, action, topic, _trajectory_complaint)], "~/commands"
        topic = "~/dry_run/commands" if settings.dry_run else topic
        self.publisher = node.add_publisher(kind, topic, while_active=True)

    def publish(self, command: Command, now: float) -> None:
        """Pass a command of the loop on."""
        for sender in self.senders:
            if (commands := self._loop.motion.commit(command, now)) is not None:
                sender.send(sender.kind.Goal(trajectory=trajectory(self._loop.limits, commands, self._loop.tick)))
        self.publisher.publish(self._message(command, now))

    def _joint_state(self, command: Command, now: float) -> JointState:
        """Positions of arm and fingers, as Isaac Sim expects them."""
        fingers = finger_positions(self._loop.limits, command)
        names = [*self._loop.limits.joints, *self._loop.limits.fingers[: len(fingers)]]
        message = JointState(name=names, position=[*command.position.tolist(), *fingers])
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message

    def _trajectory(self, command: Command, now: float) -> JointTrajectory:
        """A trajectory that the next one replaces."""
        return trajectory(
            self._loop.limits, self._loop.motion.trajectory_to_rest(command, now, LOOK_AHEAD), self._loop.tick
        )

    def _positions(self, command: Command, now: float) -> Float64MultiArray:
        return Float64MultiArray(data=command.position.tolist())


class GripperOutput:
    """Publishes the positions of the fingers; in a dry run, or beside the goals of an action, as a copy for recordings.

    An action gets one goal at a time, and a new one only when the commanded state changes: open above `OPEN_ABOVE`,
    closed below `CLOSE_BELOW`.
    """

    def __init__(self, node: GuardedLifecycleNode, loop: ControlLoop, settings: PolicySettings, topic: str) -> None:
        """Args: topic of the fingers, or the action server."""
        self._loop, gripper = loop, settings.gripper
        goals = gripper.goals(topic) if gripper is not None and not settings.dry_run else ()
        self._goals = [
            (GoalSender(node, goal.kind, goal.server, goal.complaint, self._advance), goal.message) for goal in goals
        ]  # to close, to open
        self.senders = [sender for sender, _ in self._goals]
        copy = "~/dry_run/gripper" if settings.dry_run else "~/gripper"
        topic = copy if settings.dry_run or goals else topic
        self._publisher = node.add_publisher(Float64MultiArray, topic, while_active=True)
        self.reset()

    def reset(self) -> None:
        """Forget the last goal, so that the next one is sent even if it is equal."""
        self._target_open: bool | None = None  # open?
        self._sent_open: bool | None = None

    def publish(self, command: Command) -> None:
        """Pass the opening of a command on, if it has one."""
        if fingers := finger_positions(self._loop.limits, command):
            self._publisher.publish(Float64MultiArray(data=fingers))
        if not self._loop.acting:
            self._target_open = None  # drops a goal that waits for the cancellation of the previous one
        elif command.opening is not None:
            if not CLOSE_BELOW <= command.opening <= OPEN_ABOVE:
                self._target_open = command.opening > OPEN_ABOVE
            self._advance()

    def _advance(self) -> None:
        """Send the requested goal once the previous one has ended: Franka's gripper accepts one at a time."""
        if not self._goals or self._target_open is None or self._target_open == self._sent_open:
            return
        busy_senders = [sender for sender in self.senders if sender.active]
        for sender in busy_senders:
            sender.cancel()
            self._sent_open = None
        if not busy_senders:
            sender, goal = self._goals[self._target_open]
            self._sent_open = self._target_open
            sender.send(goal)


def finger_positions(limits: JointLimits, command: Command) -> list[float]:
    """Return the target position of every finger joint; none if the command leaves the gripper as it is."""
    return [] if command.opening is None else limits.finger_positions(command.opening)


def trajectory(limits: JointLimits, commands: Sequence[Command], tick: float) -> JointTrajectory:
    """Return a trajectory that starts now, with one point per tick [s] and the last one at rest.

    The arm therefore stops if no other trajectory follows.
    """
    points = []
    for number, command in enumerate(commands, 1):
        velocities = command.velocity if number < len(commands) else 0 * command.velocity
        point = {"positions": command.position.tolist(), "velocities": velocities.tolist()}
        points.append(JointTrajectoryPoint(**point, time_from_start=Duration(seconds=number * tick).to_msg()))
    return JointTrajectory(joint_names=list(limits.joints), points=points)


def _trajectory_complaint(result: Any, replaced: bool) -> str:
    """Describe a result of FollowJointTrajectory; empty if its goal was replaced and that is all."""
    if replaced and result.error_code in REPLACEMENT_CODES:
        return ""
    return ", ".join(filter(None, (f"error code {result.error_code}", result.error_string)))
