"""The Franka Panda with its parallel gripper."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from dm_control import mjcf

from vla.robots import panda
from vla.spec import Array, RobotModel
from vla.tasks.tabletop.robot import (
    FINGERTIP_CONTACT,
    HIDDEN,
    ROBOT_CONTACT,
    VISIBLE,
    TabletopRobot,
    attributes,
    camera,
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
MESHES = "envs/assets/kitchen_franka/franka_assets/meshes"  # STL of the package gymnasium-robotics, Apache-2.0
HAND_MASS, FINGER_MASS = 0.73, 0.015  # [kg], franka_description, hand.xacro
FINGER_OFFSET = 0.0584  # hand to finger along z [m], ibid.
GRIP_STIFFNESS, GRIP_DAMPING = 1000.0, 40.0  # of the finger servo [N/m], [N s/m]
GRIP_FORCE = 20.0  # of both fingers together [N]; the Franka Hand gives up to 70 N continuously

SHELL = (0.93, 0.94, 0.95, 1.0)
DARK = (0.22, 0.23, 0.25, 1.0)
WRIST = camera((0.085, 0.0, 0.035), (0.02, 0.0, 0.12), fovy=75.0, up=(1, 0, 0))  # in the hand's frame
JOINTS = tuple(f"panda_joint{index}" for index in range(1, 8))
ARM = RobotModel(
    joints=JOINTS,
    frame="panda_link0",
    velocities=tuple(f"{joint}_velocity" for joint in JOINTS),
    gripper="gripper",
    chain=panda.CHAIN,
    home=tuple(panda.HOME.tolist()),
)


def read_corners(path: Path) -> Array:
    """Read the distinct vertices (N, 3) of a binary STL file [m]."""
    triangle = np.dtype([("normal", "<3f4"), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.unique(np.fromfile(path, triangle, offset=84)["corners"].reshape(-1, 3), axis=0)


class Panda(TabletopRobot):
    """Seven position-servoed joints with gravity compensation and a gripper whose fingers share one servo."""

    prefix = "panda/"
    arm, kinematics, lead = ARM, panda.PANDA, LEAD
    joints = servos = tuple(f"panda/joint{index}" for index in range(1, 8))
    fingers, grips, tool = ("panda/left_finger", "panda/right_finger"), ("panda/fingers",), "panda/tcp"
    fingertips = (("panda/left_pad",), ("panda/right_pad",))
    tip = (0.012, 0.012, 0.008, 0.0)  # half the diagonal of the square fingertips
    closed, opened = np.zeros(1), np.array([panda.FINGER_TRAVEL])
    travel, finger_speed, widest = panda.FINGER_TRAVEL, panda.FINGER_SPEED, panda.MAX_OPENING

    def __init__(self, meshes: Literal["light", "full"]) -> None:
        """Choose the visual meshes, "light" (1 200 faces) or "full" (134 000). Collision meshes are the same."""
        self._meshes = meshes

    def attach(self, scene: mjcf.RootElement) -> None:
        """Attach the robot to a scene; the name of its model becomes the prefix of its names."""
        scene.attach(mjcf.from_xml_string(_mjcf(self._meshes)))

    def grip(self, opening: float) -> tuple[float, float]:
        """Return half the opening, limited to the travel of a finger, for both fingers and their common servo."""
        half = min(opening / 2, panda.FINGER_TRAVEL)
        return half, half

    def opening(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """Return the sum of both fingers' positions [m]."""
        return float(sum(data.joint(finger).qpos[0] for finger in self.fingers))


def _mjcf(meshes: str) -> str:
    """Return the model of the robot."""
    limits = [attributes(range=(low, high)) for low, high in zip(panda.JOINT_LOW, panda.JOINT_HIGH, strict=True)]
    links, servos = "", ""
    for index, (mass, com, inertia) in enumerate(LINKS):
        name, place = f"joint{index + 1}", attributes(pos=panda.CHAIN[index][:3], quat=panda.CHAIN[index][3:])
        links += f"""<body name="link{index + 1}" gravcomp="1" {place}>
            <inertial {attributes(mass=mass, pos=com, fullinertia=inertia)}/>
            <joint name="{name}" axis="0 0 1" limited="true" {limits[index]} armature="{ARMATURE}"/>
            {_geoms(f"link{index + 1}", DARK if index == 4 else SHELL)}"""
        gains = attributes(kp=STIFFNESS[index], kv=STIFFNESS[index] * LEAD, forcerange=(-TORQUE[index], TORQUE[index]))
        servos += f'<position name="{name}" joint="{name}" ctrl{limits[index]} {gains}/>'
    force = attributes(forcerange=(-GRIP_FORCE, GRIP_FORCE))
    return f"""<mujoco model="panda">
  <compiler angle="radian"/>
  <asset>{_assets(meshes)}</asset>
  <worldbody>
    <body name="link0">
      <inertial mass="0.629769" pos="-0.041018 -0.00014 0.049974" diaginertia="0.00315 0.00388 0.004285"/>
      {_geoms("link0", SHELL)}
      {links}
      <body name="hand" gravcomp="1" {attributes(pos=(0, 0, panda.FLANGE), euler=(0, 0, panda.HAND_YAW))}>
        <inertial mass="{HAND_MASS}" pos="-0.01 0 0.03" diaginertia="0.001 0.0025 0.0017"/>
        {_geoms("hand", SHELL)}
        <site name="tcp" size="0.004" group="4" {attributes(pos=(0, 0, panda.HAND_TO_TCP))}/>
        <camera name="wrist" {WRIST}/>
        {_finger("left", 0.0)}
        {_finger("right", np.pi)}
      </body>{"</body>" * len(LINKS)}
    </body>
  </worldbody>
  <tendon>
    <fixed name="fingers"><joint joint="left_finger" coef="0.5"/><joint joint="right_finger" coef="0.5"/></fixed>
  </tendon>
  <equality>
    <joint joint1="left_finger" joint2="right_finger" solref="0.005 1" solimp="0.95 0.99 0.001"/>
  </equality>
  <actuator>
    {servos}
    <position name="fingers" tendon="fingers" kp="{GRIP_STIFFNESS}" kv="{GRIP_DAMPING}" {force}
              {attributes(ctrlrange=(0, panda.FINGER_TRAVEL))}/>
  </actuator>
</mujoco>"""


def _assets(meshes: str) -> str:
    """Return the meshes that collide and those that are seen."""
    package: Any = find_spec("gymnasium_robotics")
    folder, text = Path(package.origin).parent / MESHES, ""
    for name in (*(f"link{index}" for index in range(8)), "hand", "finger"):
        file = folder / "collision" / f"{name}.stl"
        # Convex hulls of the collision meshes: every face costs time, with shadows more than once.
        light = attributes(vertex=spread(read_corners(file))) if meshes == "light" else ""
        text += f'<mesh name="{name}" file="{file}"/>'
        text += f'<mesh name="{name}_seen" {light or attributes(file=str(folder / "visual" / f"{name}.stl"))}/>'
    return text


def _geoms(mesh: str, rgba: tuple[float, ...], collides: bool = True) -> str:
    visual = f'mesh="{mesh}_seen" contype="0" conaffinity="0" {attributes(group=VISIBLE, rgba=rgba)}'
    solid = f'mesh="{mesh}" {attributes(group=HIDDEN, **ROBOT_CONTACT)}'
    return "".join(f'<geom type="mesh" mass="0" {text}/>' for text in (visual, solid)[: 1 + collides])


def _finger(side: str, turn: float) -> str:
    """Return a finger; only its soft fingertip collides."""
    tip = attributes(rgba=DARK, group=VISIBLE, **FINGERTIP_CONTACT, **ROBOT_CONTACT)
    return f"""<body name="{side}_finger" gravcomp="1" {attributes(pos=(0, 0, FINGER_OFFSET), euler=(0, 0, turn))}>
          <inertial mass="{FINGER_MASS}" pos="0 0 0" diaginertia="2.375e-6 2.375e-6 7.5e-7"/>
          <joint name="{side}_finger" type="slide" axis="0 1 0" limited="true" armature="0.05"
                 {attributes(range=(0, panda.FINGER_TRAVEL))}/>
          {_geoms("finger", DARK, collides=False)}
          <geom name="{side}_pad" type="box" size="0.0085 0.004 0.0085" pos="0 0.0045 0.0445" mass="0" {tip}/>
        </body>"""
