"""The tabletop scene, composed with PyMJCF: table, lights, cameras, pads, blocks and robot."""

from __future__ import annotations

from typing import Literal
from xml.etree import ElementTree

import mujoco
import numpy as np
from dm_control import mjcf

from vla.tasks.tabletop.robot import PHYSICS, VISIBLE, TabletopRobot, attributes, camera
from vla.tasks.tabletop.robot_file import compile_model

ColourName = Literal["red", "green", "blue", "yellow", "purple", "orange"]
COLOURS: dict[ColourName, tuple[float, float, float]] = {
    "red": (0.85, 0.10, 0.10),
    "green": (0.10, 0.65, 0.20),
    "blue": (0.12, 0.25, 0.85),
    "yellow": (0.95, 0.80, 0.10),
    "purple": (0.50, 0.15, 0.65),
    "orange": (0.95, 0.45, 0.08),
}
BLOCK_HALF_SIZE = 0.02  # nominal [m]
BLOCK_DENSITY = 600.0  # of hardwood [kg/m³]
PADS: dict[str, tuple[float, float, float]] = {"black": (0.12, 0.12, 0.14), "white": (0.93, 0.93, 0.90)}
PAD_RADIUS = 0.05  # [m]
PAD_THICKNESS = 0.001  # half [m]; pads do not collide
TABLE_HALF_SIZE = (0.6, 0.8, 0.03)  # [m]
TABLE_CENTRE = (0.4, 0.0)  # [m]
LAMP_DIRECTION = np.array([-0.1, 0.25, -1.0]) / np.linalg.norm([-0.1, 0.25, -1.0])
LAMP_DISTANCE = 2.0  # from the centre of the shadow region [m]
SHADOWED = (0.42, 0.0, 0.1)  # centre of the shadow region [m]
SHADOW_REACH = 0.6  # radius of the shadow region [m]
TEXTURE = 64  # edge of the table's and the floor's texture [px]
FRICTION = (1.0, 0.01, 0.0002)  # nominal, of table and blocks
FRONT = camera((1.02, 0.0, 0.52), (0.5, 0.0, 0.05), fovy=45.0, up=(0, 0, 1))  # in the base frame


def compile_scene(robot: TabletopRobot, blocks: int, shadows: bool) -> mujoco.MjModel:
    """Compile the scene with a robot and a number of blocks, cubes before randomisation (UserError: the robot's model
    does not compile)."""
    scene = mjcf.from_xml_string(_surroundings(shadows))
    robot.attach(scene)
    material = {"density": BLOCK_DENSITY, "condim": 4, "friction": FRICTION, "contype": 1, "conaffinity": 3}
    for name in (f"block{index}" for index in range(blocks)):
        body = scene.worldbody.add("body", name=name)
        body.add("freejoint")
        body.add("geom", name=name, type="box", size=(BLOCK_HALF_SIZE,) * 3, group=VISIBLE, **material)
    spec = _export(scene)
    robot.complete(spec)
    return compile_model(spec)


def _export(scene: mjcf.RootElement) -> mujoco.MjSpec:
    """Return a scene for MuJoCo, without the bodies around attached models and the names that PyMJCF adds to it."""
    tree = ElementTree.fromstring(scene.to_xml_string())
    for element in tree.iter():
        name = element.get("name", "")
        if "//unnamed" in name:
            del element.attrib["name"]
        elif element.tag == "body" and name.endswith("/"):
            element.tag = "frame"
    return mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding="unicode"), assets=scene.get_assets())


def _surroundings(shadows: bool) -> str:
    """Return the scene without robot and blocks."""
    # On a CPU, MuJoCo's default multisampling and shadow map take thirty times as long, and its default tessellation of
    # boxes and cylinders half as much again. The shadow region is in metres, as the extent is 1. Table and floor have
    # textures of their own, white before randomisation.
    flat = f'type="2d" builtin="flat" rgb1="1 1 1" width="{TEXTURE}" height="{TEXTURE}"'
    table = attributes(size=TABLE_HALF_SIZE, pos=(*TABLE_CENTRE, -TABLE_HALF_SIZE[2]), friction=FRICTION, group=VISIBLE)
    lamp = attributes(pos=np.array(SHADOWED) - LAMP_DISTANCE * LAMP_DIRECTION, dir=LAMP_DIRECTION, castshadow=shadows)
    pads = "".join(
        f"""<body name="{name}_pad" mocap="true" {attributes(pos=(0.5, 0, PAD_THICKNESS))}>
        <geom name="{name}_pad" type="cylinder" contype="0" conaffinity="0"
        {attributes(size=(PAD_RADIUS, PAD_THICKNESS), rgba=(*rgb, 1), group=VISIBLE)}/></body>"""
        for name, rgb in PADS.items()
    )
    return f"""<mujoco model="tabletop">
  <compiler angle="radian"/>
  <option {attributes(**PHYSICS)}/>
  <statistic extent="1" center="0.4 0 0.2"/>
  <visual>
    <quality shadowsize="192" offsamples="0" numslices="24" numstacks="2" numquads="1"/>
    <headlight ambient="0.42 0.42 0.42" diffuse="0.2 0.2 0.2" specular="0 0 0"/>
    <map znear="0.01" zfar="10" shadowclip="{SHADOW_REACH}"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.78 0.83 0.88" rgb2="0.55 0.6 0.66" width="64" height="384"/>
    <texture name="table" {flat}/>
    <material name="table" texture="table" texrepeat="3 4" specular="0"/>
    <texture name="floor" {flat}/>
    <material name="floor" texture="floor" texrepeat="6 6" specular="0"/>
  </asset>
  <worldbody>
    <geom name="table" type="box" material="table" rgba="0.72 0.66 0.58 1" {table}/>
    <geom name="floor" type="plane" material="floor" rgba="0.45 0.46 0.48 1" size="3 3 0.1" pos="0 0 -0.75"
          group="{VISIBLE}"/>
    {pads}
    <light name="lamp" type="directional" diffuse="0.55 0.55 0.55" specular="0.15 0.15 0.15" {lamp}/>
    <camera name="front" {FRONT}/>
  </worldbody>
</mujoco>"""
