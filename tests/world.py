"""The surroundings of a policy node under test: cameras, an arm that follows its commands, and an operator."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from arm import FORWARD, ROBOT, SAFETY, SPEC
from builtin_interfaces.msg import Time
from defaults import defaults_of
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from PIL import Image as Picture
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image, JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from vla.deploy import messages
from vla.deploy.control_loop import ControlLoop
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.policy_node import PolicyNode
from vla.deploy.ros import RosNetwork
from vla.deploy.ros2 import PolicyDeployment
from vla.deploy.safety import Safety, State
from vla.deploy.settings import Topics
from vla.robots.panda import HOME
from vla.spec import Array, Observation

TOPICS = Topics({"front": "/front", "wrist": "/wrist"}, "/joint_states", "/words", "/commands", "/gripper", None)
KINDS = {"joint_state": JointState, "trajectory": JointTrajectory, "forward": Float64MultiArray}
TOPIC = {"follow_joint_trajectory": "/vla_agent/commands"}  # of the commands, where it is not /commands
OTHERS = {"follow_joint_trajectory": JointState}


class Forward:
    """A policy that moves forward and records its observations."""

    spec = SPEC
    execute = history = 1
    chunking: object = None

    def __init__(self) -> None:
        self.seen: list[Observation] = []
        self.fails, self.takes, self.chunk = False, 0.0, 1
        self.action: Callable[[], Array] = lambda: FORWARD

    def reset(self, instruction: str, seed: int) -> None:
        """Do nothing: the policy has no state."""

    def plan(self, observation: Observation) -> Array:
        """Return a step of one centimetre along x, or the action of a test."""
        self.seen.append(observation)
        time.sleep(self.takes)
        if self.fails:
            raise RuntimeError("no idea")
        return np.repeat(self.action(), self.chunk, 0)


class World:
    """Cameras, an arm that follows its commands, and an operator; the policy node runs in the same thread."""

    def __init__(
        self,
        domain: int,
        command: Any,
        arguments: list[str],
        compressed: bool = False,
        gripper: Any = None,
        dry_run: bool = False,
        robot: JointLimits = ROBOT,
        safety: Safety = SAFETY,
    ) -> None:
        RosNetwork("loopback", None, None).apply()
        self.contexts = [Context(), Context()]
        for context, given in zip(self.contexts, (arguments, None), strict=True):
            rclpy.init(args=given, context=context, domain_id=domain)
        self.policy = Forward()
        nothing: Any = None
        self.compressed = compressed
        topics = {camera: f"/{camera}{'/compressed' if compressed else ''}" for camera in SPEC.cameras}
        self.settings = PolicyDeployment(
            robot=robot,
            network=RosNetwork("loopback", None, None),
            topics=replace(TOPICS, images=topics),
            safety=safety,
            **defaults_of("deploy/ros2", command=command, gripper=gripper, dry_run=dry_run),
            policy=nothing,
            environment=nothing,
            output=Path(),
        )
        self.agent = PolicyNode(self.policy, self.settings, context=self.contexts[0])  # type: ignore[arg-type]
        self.node = rclpy.create_node("world", context=self.contexts[1])
        self.executors = [SingleThreadedExecutor(context=context) for context in self.contexts]
        for executor, node in zip(self.executors, (self.agent, self.node), strict=True):
            executor.add_node(node)
        kind = CompressedImage if compressed else Image
        self.images = {camera: self.node.create_publisher(kind, topic, 1) for camera, topic in topics.items()}
        self.states = self.node.create_publisher(JointState, "/joint_states", 1)
        self.words = self.node.create_publisher(String, "/words", 1)
        self.commands: list[Any] = []
        kind, topic = {**KINDS, **OTHERS}[command], TOPIC.get(command, "/commands")
        self.node.create_subscription(kind, topic, self.commands.append, 100)
        self.follow: Callable[[Array], Array] | None = None  # joints → joints: moves the arm in place of its commands
        self.statuses: list[DiagnosticStatus] = []
        self.node.create_subscription(DiagnosticStatus, "/vla_agent/status", self.statuses.append, 100)
        self.joints = HOME.copy()
        self.changed: Callable[[Image], None] = lambda image: None
        self.measured: Callable[[JointState], None] = lambda state: None
        self.clock = self.node.create_publisher(Clock, "/clock", 1)
        self.simulated: float | None = None  # simulated time [s], if any

    def spin(self, until: Callable[[], Any], seconds: float = 10.0) -> None:
        """Spin both nodes until a condition holds."""
        deadline = time.monotonic() + seconds
        while not until():
            assert time.monotonic() < deadline, f"state {self.agent.loop and self.agent.loop.state}"
            for executor in self.executors:
                executor.spin_once(timeout_sec=0.001)

    def _spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.spin(lambda: time.monotonic() >= end)

    def live(self, seconds: float, until: Callable[[], Any] = lambda: False) -> None:
        """Publish images at 10 Hz and joint states at 50 Hz, for some seconds or until a condition holds."""
        end, tick = time.monotonic() + seconds, 0
        while time.monotonic() < end and not until():
            if self.simulated is not None:
                self.simulated += 0.02
                self.clock.publish(Clock(clock=self._now()))
            if self.follow is not None:
                self.joints = self.follow(self.joints)
            elif self.commands:
                self.joints = positions(self.commands[-1])[0]
            measured = joint_state(self.joints)
            self.measured(measured)
            self.states.publish(measured)
            if tick % 5 == 0:
                for camera in SPEC.cameras:
                    image = messages.fill_image(Image(), np.zeros((8, 8, 3), np.uint8), camera)
                    image.header.stamp = self._now()
                    self.changed(image)
                    self.images[camera].publish(packed(image) if self.compressed else image)
            tick += 1
            self._spin_for(0.02)

    def _now(self) -> Time:
        if self.simulated is None:
            return self.node.get_clock().now().to_msg()
        seconds, rest = divmod(self.simulated, 1.0)
        return Time(sec=int(seconds), nanosec=int(rest * 1e9))

    def ask(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service of the agent."""
        client = self.node.create_client(kind, f"/vla_agent/{name}")
        self.spin(client.service_is_ready)
        answer = client.call_async(request)
        self.spin(answer.done)
        return answer.result()

    def trigger(self, name: str) -> Any:
        """Call a service of the agent that is asked for nothing else."""
        return self.ask(Trigger, name, Trigger.Request())

    def hand_over(self, to_person: bool) -> Any:
        """Ask the agent to leave the arm to a person, or to take it back."""
        return self.ask(SetBool, "hand_over", SetBool.Request(data=to_person))

    def say(self, instruction: str) -> None:
        self.words.publish(String(data=instruction))

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.ask(ChangeState, "change_state", request).success)

    def start(self, commanded: Callable[[], Any] | None = None) -> None:
        """Configure, activate, connect, and send the instruction once something is commanded."""
        assert self.change(Transition.TRANSITION_CONFIGURE) and self.change(Transition.TRANSITION_ACTIVATE)
        publishers = [*self.images.values(), self.states, self.words]
        self.spin(lambda: all(publisher.get_subscription_count() for publisher in publishers))
        self.live(2.0, until=commanded or (lambda: self.commands))
        self.say("put the red block on the pad")
        self.live(2.0, until=lambda: self.policy.seen[-1].instruction)
        self.live(0.1)

    def becomes(self, state: State) -> bool:
        """Return whether the agent reaches a state within some seconds."""
        self.live(5.0, until=lambda: self.state is state)
        return self.state is state

    @property
    def loop(self) -> ControlLoop:
        assert self.agent.loop is not None
        return self.agent.loop

    @property
    def state(self) -> State:
        return self.loop.state

    @property
    def told(self) -> dict[str, str]:
        """The values of the newest status."""
        return {pair.key: pair.value for pair in self.statuses[-1].values}

    def close(self) -> None:
        for executor, node in zip(self.executors, (self.agent, self.node), strict=True):
            executor.remove_node(node)
            executor.shutdown()
            node.destroy_node()
        for context in self.contexts:
            rclpy.try_shutdown(context=context)


def positions(command: Any) -> Array:
    """Return the positions (N, 7) of a command, one per tick [rad]."""
    if isinstance(command, JointTrajectory):
        return np.array([point.positions for point in command.points])
    return np.array([command.position[:7] if isinstance(command, JointState) else command.data])


def joint_state(joints: Array) -> JointState:
    """Return a joint state in another order and with an additional joint."""
    names = [*reversed(ROBOT.joints), *ROBOT.fingers, "of_another_robot"]
    return JointState(name=names, position=[*joints[::-1].tolist(), 0.04, 0.04, 1.0])


def packed(image: Image) -> CompressedImage:
    """Compress an image as `image_transport` does."""
    data = io.BytesIO()
    Picture.fromarray(messages.image_from(image)).save(data, "PNG")
    return CompressedImage(header=image.header, format="rgb8; png compressed bgr8", data=data.getvalue())
