"""The Franka Panda with its parallel gripper."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from dm_control import mjcf

from vla.robots.panda import (
    CHAIN,
    FINGER_SPEED,
    FINGER_TRAVEL,
    FLANGE,
    HAND_TO_TCP,
    HAND_YAW,
    JOINT_HIGH,
    JOINT_LOW,
    MAX_OPENING,
    PANDA,
)
from vla.spec import Array, RobotModel
from vla.tasks.tabletop.robot import (
    CORNERS,
    FINGERTIP_CONTACT,
    HIDDEN,
    ROBOT_CONTACT,
    VISIBLE,
    CameraPose,
    TabletopRobot,
    look_at,
    spread,
)

Link = tuple[float, tuple[float, ...], tuple[float, ...]]

# Mass [kg], centre of mass [m] and inertia xx yy zz xy xz yz [kg m²]: franka_description, inertial.yaml (identified
# by Gaz et al., "Dynamic Identification of the Franka Emika Panda Robot", RA-L 2019).
LINKS: tuple[Link, ...] = (
    (4.970684, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    (0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    (1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    (0.735522, (0.010517, -0.004252, 0.061597), (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
)
TORQUE = (87, 87, 87, 87, 12, 12, 12)  # [N m], Franka Control Interface documentation, "Limits for Panda"
STIFFNESS = (4500, 4500, 3500, 3500, 2000, 2000, 2000)  # position servo [N m/rad], as in MuJoCo Menagerie's Panda
LEAD = 0.05  # servo damping over stiffness [s]: tracks within a control period without overshoot
ARMATURE = 0.1  # reflected rotor inertia [kg m²], as in MuJoCo Menagerie's Panda
HAND_MASS, FINGER_MASS = 0.73, 0.015  # [kg], franka_description, hand.xacro
FINGER_OFFSET = 0.0584  # hand to finger along z [m], ibid.
GRIP_STIFFNESS, GRIP_DAMPING = 1000.0, 40.0  # of the finger servo [N/m], [N s/m]
GRIP_FORCE = 20.0  # of both fingers together [N]; the Franka Hand gives up to 70 N continuously

SHELL = (0.93, 0.94, 0.95, 1.0)
DARK = (0.22, 0.23, 0.25, 1.0)
NO_CONTACT = {"contype": 0, "conaffinity": 0}
WRIST = CameraPose(position=(0.085, 0.0, 0.035), target=(0.02, 0.0, 0.12), fovy=75.0)  # in the hand's frame
JOINTS = tuple(f"panda_joint{index}" for index in range(1, 8))
ARM = RobotModel(
    joints=JOINTS,
    frame="panda_link0",
    velocities=tuple(f"{joint}_velocity" for joint in JOINTS),
    gripper="gripper",
    chain=CHAIN,
)


def mesh_folder() -> Path:
    """Return the folder of the Panda's STL meshes, which the gymnasium-robotics package ships (Apache-2.0).

    Raises:
        FileNotFoundError: the package is not installed.
    """
    found = find_spec("gymnasium_robotics")
    if found is None or found.origin is None:
        raise FileNotFoundError("the Panda's meshes are missing: pip install gymnasium-robotics")
    return Path(found.origin).parent / "envs/assets/kitchen_franka/franka_assets/meshes"


def read_corners(path: Path) -> Array:
    """Read the distinct vertices (N, 3) of a binary STL file [m]."""
    triangle = np.dtype([("normal", "<3f4"), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.unique(np.fromfile(path, triangle, offset=84)["corners"].reshape(-1, 3), axis=0)


class Panda(TabletopRobot):
    """Seven position-servoed joints with gravity compensation and a gripper whose fingers share one servo."""

    prefix = "panda/"
    arm, kinematics, lead = ARM, PANDA, LEAD
    joints = servos = tuple(f"panda/joint{index}" for index in range(1, 8))
    fingers, grips, tool = ("panda/left_finger", "panda/right_finger"), ("panda/fingers",), "panda/tcp"
    fingertips = (("panda/left_pad",), ("panda/right_pad",))
    tip = (0.012, 0.012, 0.008, 0.0)  # half the diagonal of the square fingertips
    closed, opened = np.zeros(1), np.array([FINGER_TRAVEL])
    travel, finger_speed, widest = FINGER_TRAVEL, FINGER_SPEED, MAX_OPENING

    def __init__(self, meshes: Literal["light", "full"] = "light") -> None:
        """Args: meshes: visual meshes, "light" (1 200 faces) or "full" (134 000). Collision meshes are the same."""
        self.root = mjcf.RootElement(model="panda")
        self.root.compiler.angle = "radian"
        self._meshes = meshes
        self._add_assets()
        body = self.root.worldbody.add("body", name="link0")
        body.add(
            "inertial", mass=0.629769, pos=(-0.041018, -0.00014, 0.049974), diaginertia=(0.00315, 0.00388, 0.004285)
        )
        self._add_mesh(body, "link0", SHELL)
        for index, link in enumerate(LINKS):
            body = self._add_link(body, index, link)
        self._add_gripper(body)

    def _add_assets(self) -> None:
        folder = mesh_folder()
        names = [*(f"link{index}" for index in range(8)), "hand", "finger"]
        for name in names:
            self.root.asset.add("mesh", name=name, file=str(folder / "collision" / f"{name}.stl"))
            if self._meshes == "light":
                # Convex hulls of the collision meshes; with shadows, every face is rendered twice per camera.
                corners = spread(read_corners(folder / "collision" / f"{name}.stl"), CORNERS)
                self.root.asset.add("mesh", name=f"{name}_seen", vertex=corners.ravel())
            else:
                self.root.asset.add("mesh", name=f"{name}_seen", file=str(folder / "visual" / f"{name}.stl"))

    def _add_mesh(self, body: mjcf.Element, mesh: str, rgba: tuple[float, ...], collide: bool = True) -> None:
        body.add("geom", type="mesh", mesh=f"{mesh}_seen", group=VISIBLE, rgba=rgba, mass=0, **NO_CONTACT)
        if collide:
            body.add("geom", type="mesh", mesh=mesh, group=HIDDEN, mass=0, **ROBOT_CONTACT)

    def _add_link(self, parent: mjcf.Element, index: int, link: Link) -> mjcf.Element:
        body = parent.add("body", name=f"link{index + 1}", pos=CHAIN[index][:3], quat=CHAIN[index][3:], gravcomp=1)
        mass, com, inertia = link
        body.add("inertial", mass=mass, pos=com, fullinertia=inertia)
        limits = (JOINT_LOW[index], JOINT_HIGH[index])
        joint = body.add(
            "joint", name=f"joint{index + 1}", axis=(0, 0, 1), range=limits, limited=True, armature=ARMATURE
        )
        self.root.actuator.add(
            "position",
            name=f"joint{index + 1}",
            joint=joint,
            kp=STIFFNESS[index],
            kv=STIFFNESS[index] * LEAD,
            ctrlrange=limits,
            forcerange=(-TORQUE[index], TORQUE[index]),
        )
        self._add_mesh(body, f"link{index + 1}", DARK if index == 4 else SHELL)
        return body

    def _add_gripper(self, link: mjcf.Element) -> None:
        hand = link.add("body", name="hand", pos=(0, 0, FLANGE), euler=(0, 0, HAND_YAW), gravcomp=1)
        hand.add("inertial", mass=HAND_MASS, pos=(-0.01, 0, 0.03), diaginertia=(0.001, 0.0025, 0.0017))
        self._add_mesh(hand, "hand", SHELL)
        hand.add("site", name="tcp", pos=(0, 0, HAND_TO_TCP), size=(0.004,), group=4)
        axes = look_at(WRIST.position, WRIST.target, (1, 0, 0))
        hand.add("camera", name="wrist", pos=WRIST.position, xyaxes=(*axes[:, 0], *axes[:, 1]), fovy=WRIST.fovy)
        fingers = []
        for side, euler in (("left", (0, 0, 0)), ("right", (0, 0, np.pi))):
            finger = hand.add("body", name=f"{side}_finger", pos=(0, 0, FINGER_OFFSET), euler=euler, gravcomp=1)
            finger.add("inertial", mass=FINGER_MASS, pos=(0, 0, 0), diaginertia=(2.375e-6, 2.375e-6, 7.5e-7))
            fingers.append(
                finger.add(
                    "joint",
                    name=f"{side}_finger",
                    type="slide",
                    axis=(0, 1, 0),
                    range=(0, FINGER_TRAVEL),
                    limited=True,
                    armature=0.05,
                )
            )
            self._add_mesh(finger, "finger", DARK, collide=False)
            # The soft fingertip is the only part of a finger that collides.
            finger.add(
                "geom",
                name=f"{side}_pad",
                type="box",
                size=(0.0085, 0.004, 0.0085),
                pos=(0, 0.0045, 0.0445),
                rgba=DARK,
                group=VISIBLE,
                mass=0,
                **FINGERTIP_CONTACT,
                **ROBOT_CONTACT,
            )
        tendon = self.root.tendon.add("fixed", name="fingers")
        for joint in fingers:
            tendon.add("joint", joint=joint, coef=0.5)
        self.root.equality.add(
            "joint", joint1=fingers[0], joint2=fingers[1], solref=(0.005, 1), solimp=(0.95, 0.99, 0.001)
        )
        self.root.actuator.add(
            "position",
            name="fingers",
            tendon=tendon,
            kp=GRIP_STIFFNESS,
            kv=GRIP_DAMPING,
            ctrlrange=(0, FINGER_TRAVEL),
            forcerange=(-GRIP_FORCE, GRIP_FORCE),
        )

    def grip(self, opening: float) -> tuple[float, float]:
        """Return half the opening, for both fingers and their common servo."""
        return opening / 2, opening / 2

    def opening(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """Return the sum of both fingers' positions [m]."""
        return float(sum(data.joint(finger).qpos[0] for finger in self.fingers))
