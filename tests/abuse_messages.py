"""Messages that no camera, robot or person sends, to a policy that moves an arm."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from arm import ROBOT
from trials import CHECKPOINT, Trials

from vla.deploy.joint_limiter import JointLimits
from vla.deploy.messages import fill_image
from vla.deploy.ros import RosNetwork, ros
from vla.robots.panda import HOME

SECONDS = 3.0  # that each kind of message is sent
CAMERAS = ("/isaac/camera/image_raw", "/isaac/wrist_camera/image_raw")
JOINTS, INSTRUCTION, COMMANDS = "/isaac/franka/joint_states", "/user/command", "/isaac/franka/joint_commands"
NAN, INF = float("nan"), float("inf")


def messages(root: Path) -> Trials:
    """The policy's node goes on, and its commands keep to the limits of position, speed and acceleration."""
    command = [
        sys.executable,
        "-m",
        "vla.run",
        f"checkpoint={CHECKPOINT}",
        "job=deploy",
        "deploy=ros2",
        "output=deployed",
    ]
    with (root / "deployed.log").open("w") as log, ros(RosNetwork("loopback", None, None)):
        process = subprocess.Popen(command, cwd=root, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            world = World(replace(ROBOT, fingers=["panda_finger_joint1", "panda_finger_joint2"]))
            world.live(90.0, until=5)
            for name, hostile in world.hostile().items():
                before = len(world.commands)
                world.live(SECONDS, hostile)
                world.live(1.0)
                there, wrong = len(world.commands) - before, world.beyond(before)
                alive = process.poll() is None
                yield name, alive and there > 20 and not wrong, f"alive {alive}, {there} commands, {wrong}"
            process.send_signal(signal.SIGTERM)
            code = process.wait(20)
            log.flush()
            calm = "Traceback" not in (root / "deployed.log").read_text()
            yield "SIGTERM after all that", code == 0 and calm, f"status {code}, no traceback: {calm}"
        finally:
            if process.poll() is None:
                process.kill()


class World:
    """Cameras, an arm that follows its commands exactly, and a person."""

    def __init__(self, robot: JointLimits) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import Image, JointState
        from std_msgs.msg import String

        self._robot, self._random = robot, random.Random(0)
        self._node = rclpy.create_node("abuse")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._images = [self._node.create_publisher(Image, topic, 1) for topic in CAMERAS]
        self._joints = self._node.create_publisher(JointState, JOINTS, 1)
        self._words = self._node.create_publisher(String, INSTRUCTION, 1)
        self._node.create_subscription(JointState, COMMANDS, self._follow, 1000)
        self._kinds = {"image": Image, "joints": JointState, "words": String}
        self.commands: list[list[float]] = []
        self._told = 0.0

    def _follow(self, message: Any) -> None:
        self.commands.append(list(message.position))

    def live(self, seconds: float, hostile: Sequence[tuple[Any, Any]] = (), until: int | None = None) -> None:
        """Publish what a whole world does, with hostile messages in between, or until so many commands have come."""
        end, number = time.monotonic() + seconds, 0
        wanted = None if until is None else len(self.commands) + until
        while time.monotonic() < end and (wanted is None or len(self.commands) < wanted):
            for publisher in self._images:
                image = fill_image(self._kinds["image"](), np.full((32, 32, 3), number % 256, np.uint8), "camera")
                image.header.stamp = self._node.get_clock().now().to_msg()
                publisher.publish(image)
            where = self.commands[-1] if self.commands and np.isfinite(self.commands[-1]).all() else [*HOME, 0.04, 0.04]
            self._joints.publish(self.joints(where))
            if time.monotonic() - self._told > 1.0:
                self._words.publish(self._kinds["words"](data="pick up the red block"))
                self._told = time.monotonic()
            if hostile:
                publisher, message = hostile[number % len(hostile)]
                publisher.publish(message(where) if callable(message) else message)
            number += 1
            tick = time.monotonic() + 0.02
            while time.monotonic() < tick:
                self._executor.spin_once(timeout_sec=0.005)

    def joints(self, position: Sequence[float], **changes: Any) -> Any:
        """A joint state."""
        names = [*self._robot.joints, *self._robot.fingers]
        return self._kinds["joints"](**{"name": names, "position": list(position), **changes})

    def beyond(self, first: int) -> str:
        """Which limit a command since the `first` one exceeds, or nothing."""
        arm = np.array([command[:7] for command in self.commands[max(0, first - 2) :]])
        if not len(arm):
            return "no commands"
        if not np.isfinite(arm).all():
            return "not finite"
        period = 1 / 50
        steps, robot = np.diff(arm, axis=0), self._robot
        limits = {
            "position": bool((arm < np.array(robot.low)).any() or (arm > np.array(robot.high)).any()),
            "speed": bool((np.abs(steps) > robot.max_speed * period + 1e-6).any()),
            "acceleration": bool((np.abs(np.diff(steps, axis=0)) > robot.max_acceleration * period**2 + 1e-6).any()),
        }
        return ", ".join(name for name, exceeded in limits.items() if exceeded)

    def hostile(self) -> dict[str, list[tuple[Any, Any]]]:
        """Kind of attack → publishers and what they publish in turns."""
        noise = [self._random.randbytes(size) for size in (0, 1, 4, 40, 400, 40_000)]
        image = {"height": 32, "width": 32, "step": 96, "encoding": "rgb8", "data": bytes(3072)}
        pictures: list[dict[str, Any]] = [
            *({"encoding": encoding} for encoding in ("", "16UC1", "rgb8; rm", "x" * 100_000)),
            *({"height": 0}, {"width": 0}, {"step": 0}, {"step": 2**32 - 1}, {"height": 2**32 - 1, "width": 2**32 - 1}),
            *({"data": b""}, {"data": bytes(3071)}, {"height": 1, "width": 1, "step": 3, "data": bytes(3)}),
            {"height": 2000, "width": 2000, "step": 6000, "data": bytes(12_000_000)},
        ]
        # Where the arm is: a joint state that claims another place is no nonsense, and the arm is to hold it.
        states: list[Callable[[list[float]], Any]] = [
            *(lambda at, value=value: self.joints([value, *at[1:]]) for value in (NAN, INF, -INF)),
            *(lambda at, speed=speed: self.joints(at, velocity=speed) for speed in ([NAN] * 9, [0.0], [INF] * 9)),
            *(lambda _, at=at: self.joints(at) for at in ([], [*HOME][:5], [*HOME, 0.04, 0.04] * 1000)),
            *(
                lambda at, names=names: self.joints(at, name=names)
                for names in ([], ["a"] * 9, ["x" * 100_000] * 9, ["panda_joint1"] * 9)
            ),
        ]
        far = [self.joints([value, *HOME[1:], 0.04, 0.04]) for value in (1e308, -1e30, 100.0)]
        texts = [
            "",
            " " * 999,
            "\n\x1b[2J\x07" * 100,
            "{0.__class__}%s%n${PATH}",
            "🤖" * 1000,
            "a" * 10**6,
            "b" * 10**7,
        ]
        words = [self._kinds["words"](data=text) for text in texts]
        return {
            "images of nonsense": [(self._images[0], self._kinds["image"](**image | one)) for one in pictures],
            "joint states of nonsense": [(self._joints, state) for state in states],
            "instructions of nonsense": [(self._words, message) for message in words],
            "bytes that are no image": [(self._images[0], data) for data in noise],
            "bytes that are no joint state": [(self._joints, data) for data in noise],
            "bytes that are no instruction": [(self._words, data) for data in noise],
            "joints that are far away": [(self._joints, state) for state in far],
        }
