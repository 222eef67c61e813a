"""What the policy node tells an arm and its gripper: one class per kind of message or action.

All of them have the same few methods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import TwistStamped, Vector3
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vla.deploy.actions import GoalSender
from vla.deploy.control_loop import ControlLoop
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.lifecycle_node import GuardedLifecycleNode
from vla.deploy.motion import Command
from vla.deploy.ros import action_class
from vla.deploy.settings import FrankaGripper, GripperCommand, PolicySettings

# Time of a plan in every trajectory [s]. The next tick replaces it, and all of a long plan would take more than a tick.
AHEAD = 0.3
CLOSE_BELOW, OPEN_ABOVE = 0.4, 0.6  # commanded opening of a gripper at which its goal changes
CODES = {
    0: "SUCCESSFUL",
    -1: "INVALID_GOAL",
    -2: "INVALID_JOINTS",
    -3: "OLD_HEADER_TIMESTAMP",
    -4: "PATH_TOLERANCE_VIOLATED",
    -5: "GOAL_TOLERANCE_VIOLATED",
}  # of control_msgs/action/FollowJointTrajectory
REPLACED = (0, -1)  # codes of a goal that another one has replaced


class Output:
    """A receiver of commands; `senders` are those of its goals, if it is an action."""

    publisher: Any = None  # of what it is told, also to recordings
    senders: Sequence[GoalSender] = ()

    def publish(self, command: Command, now: float) -> None:
        """Pass a command of the loop on."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Begin anew; raise a UserError if an action server does not show up."""
        for sender in self.senders:
            sender.require_server()
            sender.reset()


class _ArmTopic(Output, ABC):
    """Commands on a topic, below ~/dry_run in a dry run, where nothing obeys them."""

    kind: ClassVar[Any]  # class of the messages

    def __init__(
        self, node: GuardedLifecycleNode, loop: ControlLoop, settings: PolicySettings, topic: str = ""
    ) -> None:
        """Args: the node; its control loop; its settings; the topic, by default that of the settings."""
        self._node, self._loop, self._settings = node, loop, settings
        topic = "~/dry_run/commands" if settings.dry_run else topic or settings.topics.commands
        self.publisher = node.add_publisher(self.kind, topic, while_active=True)

    def publish(self, command: Command, now: float) -> None:
        """Publish a command."""
        self.publisher.publish(self._message(command, now))

    @abstractmethod
    def _message(self, command: Command, now: float) -> Any:
        """Return the message of a command."""


class _JointStateTopic(_ArmTopic):
    """Positions of arm and fingers, as Isaac Sim expects them."""

    kind = JointState

    def _message(self, command: Command, now: float) -> JointState:
        message = joint_state(self._loop.limits, command)
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message


class _TrajectoryTopic(_ArmTopic):
    """Trajectories that end at rest, of which the next one replaces all points after the first."""

    kind = JointTrajectory

    def _message(self, command: Command, now: float) -> JointTrajectory:
        return trajectory(self._loop.limits, [command, *self._loop.motion.horizon(now, AHEAD)], self._loop.tick)


class _ForwardTopic(_ArmTopic):
    """Plain positions of the joints."""

    kind = Float64MultiArray

    def _message(self, command: Command, now: float) -> Float64MultiArray:
        return Float64MultiArray(data=command.position.tolist())


class _TwistTopic(_ArmTopic):
    """Velocities of the tool [m/s], [rad/s]; `twist_frame` or the base frame of the policy is theirs."""

    kind = TwistStamped

    def _message(self, command: Command, now: float) -> TwistStamped:
        message = TwistStamped()
        message.header.stamp = self._node.get_clock().now().to_msg()
        robot = self._loop.spec.require_robot("deployment")
        message.header.frame_id = self._settings.twist_frame or robot.frame
        linear, angular = self._loop.goals.tool_velocity(command).reshape(2, 3).tolist()
        message.twist.linear, message.twist.angular = (Vector3(x=x, y=y, z=z) for x, y, z in (linear, angular))
        return message


class _TrajectoryGoals(_JointStateTopic):
    """Goals of FollowJointTrajectory whenever the plan changes; what they say is also published, for recordings."""

    def __init__(self, node: GuardedLifecycleNode, loop: ControlLoop, settings: PolicySettings) -> None:
        super().__init__(node, loop, settings, "~/commands")
        kind = action_class("control_msgs", "FollowJointTrajectory")
        if not settings.dry_run:
            self.senders = [GoalSender(node, kind, settings.topics.commands, trajectory_complaint, node.fail)]

    def publish(self, command: Command, now: float) -> None:
        """Send a goal if the last one is no longer valid, and publish the command."""
        for sender in self.senders:
            if (ahead := self._loop.motion.commit(command, now)) is not None:
                sender.send(sender.kind.Goal(trajectory=trajectory(self._loop.limits, ahead, self._loop.tick)))
        super().publish(command, now)


class _FingerTopic(Output):
    """Positions of the fingers, for commands without them; in a dry run, or beside an action, a copy for recordings."""

    def __init__(self, node: GuardedLifecycleNode, loop: ControlLoop, settings: PolicySettings, topic: str) -> None:
        own = topic if settings.gripper is None else "~/gripper"
        self._limits = loop.limits
        topic = "~/dry_run/gripper" if settings.dry_run else own
        self._publisher = node.add_publisher(Float64MultiArray, topic, while_active=True)

    def publish(self, command: Command, now: float) -> None:
        """Publish the positions, if the command has an opening."""
        if fingers := finger_positions(self._limits, command):
            self._publisher.publish(Float64MultiArray(data=fingers))


class _GripperGoals(Output):
    """Opens and closes a gripper: one goal at a time, and another one only when the commanded state changes."""

    def __init__(
        self, node: GuardedLifecycleNode, loop: ControlLoop, gripper: GripperCommand | FrankaGripper, server: str
    ) -> None:
        self._loop = loop
        self._goals = [  # closed, open
            (GoalSender(node, goal.kind, goal.server, goal.complaint, node.fail, self._advance), goal.message)
            for goal in gripper.goals(server)
        ]
        self.senders = [sender for sender, _ in self._goals]
        self._wanted: bool | None = None  # open?
        self._sent: bool | None = None

    def prepare(self) -> None:
        """Begin anew: the next opening is sent even if it repeats the last."""
        super().prepare()
        self._wanted = self._sent = None

    def publish(self, command: Command, now: float) -> None:
        """Open above `OPEN_ABOVE`, close below `CLOSE_BELOW`; `opening` is 0 closed … 1 open."""
        if not self._loop.acting:
            self._wanted = None  # drops a goal that waits for the cancellation of the previous one
        elif command.opening is not None:
            if command.opening > OPEN_ABOVE:
                self._wanted = True
            elif command.opening < CLOSE_BELOW:
                self._wanted = False
            self._advance()

    def _advance(self) -> None:
        """Send the requested goal once the previous one has ended: Franka's gripper accepts one at a time."""
        if self._wanted is None or self._wanted == self._sent:
            return
        busy = [sender for sender in self.senders if sender.active]
        for sender in busy:
            sender.cancel()
            self._sent = None
        if not busy:
            sender, goal = self._goals[self._wanted]
            self._sent = self._wanted
            sender.send(goal)


COMMANDS: dict[str, type[_ArmTopic]] = {
    "joint_state": _JointStateTopic,
    "trajectory": _TrajectoryTopic,
    "forward": _ForwardTopic,
    "twist": _TwistTopic,
    "follow_joint_trajectory": _TrajectoryGoals,
}


def outputs(node: GuardedLifecycleNode, loop: ControlLoop, settings: PolicySettings) -> list[Output]:
    """Return what obeys the commands of a loop: the arm first, then the gripper."""
    found: list[Output] = [COMMANDS[settings.command](node, loop, settings)]
    if (topic := settings.topics.gripper) is not None:
        found.append(_FingerTopic(node, loop, settings, topic))
        if settings.gripper is not None and not settings.dry_run:
            found.append(_GripperGoals(node, loop, settings.gripper, topic))
    return found


def joint_state(limits: JointLimits, command: Command) -> JointState:
    """Return the target positions of arm and fingers; without an opening in the command, of the arm alone."""
    fingers = finger_positions(limits, command)
    names = [*limits.joints, *limits.fingers[: len(fingers)]]
    return JointState(name=names, position=[*command.position.tolist(), *fingers])


def finger_positions(limits: JointLimits, command: Command) -> list[float]:
    """Return the target position of every finger joint [m]; none if the command leaves the gripper as it is."""
    return [] if command.opening is None else [command.opening * limits.finger_travel] * len(limits.fingers)


def trajectory(limits: JointLimits, commands: Sequence[Command], tick: float) -> JointTrajectory:
    """Return a trajectory that starts now, with one point per tick [s] and the last one at rest.

    The arm therefore stops if no other trajectory follows.
    """
    points = []
    for number, command in enumerate(commands, 1):
        seconds, rest = divmod(number * tick, 1.0)
        velocities = command.velocity if number < len(commands) else 0 * command.velocity
        due = Duration(sec=int(seconds), nanosec=int(rest * 1e9))
        point = {"positions": command.position.tolist(), "velocities": velocities.tolist()}
        points.append(JointTrajectoryPoint(**point, time_from_start=due))
    return JointTrajectory(joint_names=list(limits.joints), points=points)


def trajectory_complaint(result: Any, replaced: bool) -> str:
    """Describe a result of FollowJointTrajectory; empty if its goal was replaced and that is all."""
    code = result.error_code
    if replaced and code in REPLACED:
        return ""
    return ", ".join(filter(None, (CODES.get(code, f"error code {code}"), result.error_string)))
