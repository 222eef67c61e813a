"""The tabletop scene: table, lights, cameras, pads, blocks and robot."""

from __future__ import annotations

import numpy as np
from dm_control import mjcf

from vla.tasks.tabletop.robot import PHYSICS, VISIBLE, CameraPose, TabletopRobot, look_at

COLOURS: dict[str, tuple[float, float, float]] = {
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
BLOCK_CONTACT = {"contype": 1, "conaffinity": 3}


FRONT = CameraPose(position=(1.02, 0.0, 0.52), target=(0.5, 0.0, 0.05), fovy=45.0)  # in the base frame


class Block:
    """A coloured block, a cube before randomisation."""

    def __init__(self, name: str) -> None:
        self.root = mjcf.RootElement(model=name)
        self.root.compiler.angle = "radian"
        self.geom = self.root.worldbody.add(
            "geom",
            name="cube",
            type="box",
            size=(BLOCK_HALF_SIZE,) * 3,
            density=BLOCK_DENSITY,
            condim=4,
            friction=(1.0, 0.01, 0.0002),
            group=VISIBLE,
            **BLOCK_CONTACT,
        )


class Scene:
    """The complete scene; `CompiledScene` indexes its compiled model."""

    def __init__(self, robot: TabletopRobot, blocks: int, shadows: bool = True) -> None:
        """Args: the robot; number of blocks; whether the lamp casts shadows."""
        self._root = mjcf.RootElement(model="tabletop")
        self._root.compiler.angle = "radian"
        self._set_physics()
        self._set_quality()
        self._add_table()
        self._add_lights(shadows)
        self.robot = robot
        if robot.root is not None:
            self._root.attach(robot.root)
        self._add_camera()
        self.blocks = [Block(name=f"block{index}") for index in range(blocks)]
        for block in self.blocks:
            self._root.attach(block.root).add("freejoint")

    def compile(self) -> mjcf.Physics:
        """Compile the scene with its robot."""
        return self.robot.compile(self._root)

    def _set_physics(self) -> None:
        for name, value in PHYSICS.items():
            setattr(self._root.option, name, value)

    def _set_quality(self) -> None:
        visual = self._root.visual
        # On a CPU, MuJoCo's default multisampling and shadow map take thirty times as long, and its default
        # tessellation of boxes and cylinders half as much again.
        visual.quality.shadowsize, visual.quality.offsamples = 192, 0
        visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 24, 2, 1
        visual.map.znear, visual.map.zfar = 0.01, 10.0
        visual.headlight.ambient, visual.headlight.diffuse = (0.42,) * 3, (0.2,) * 3
        visual.headlight.specular = (0.0,) * 3
        visual.map.shadowclip = SHADOW_REACH  # [m], as the extent is 1
        self._root.statistic.extent, self._root.statistic.center = 1.0, (0.4, 0, 0.2)
        self._root.asset.add(
            "texture",
            type="skybox",
            builtin="gradient",
            rgb1=(0.78, 0.83, 0.88),
            rgb2=(0.55, 0.60, 0.66),
            width=64,
            height=384,
        )

    def _add_table(self) -> None:
        world = self._root.worldbody
        world.add(
            "geom",
            name="table",
            type="box",
            size=TABLE_HALF_SIZE,
            pos=(*TABLE_CENTRE, -TABLE_HALF_SIZE[2]),
            rgba=(0.72, 0.66, 0.58, 1),
            friction=(1.0, 0.01, 0.0002),
            group=VISIBLE,
            material=self._add_material("table", repeat=(3, 4)),
        )
        world.add(
            "geom",
            name="floor",
            type="plane",
            size=(3, 3, 0.1),
            pos=(0, 0, -0.75),
            rgba=(0.45, 0.46, 0.48, 1),
            group=VISIBLE,
            material=self._add_material("floor", repeat=(6, 6)),
        )
        for name, rgb in PADS.items():
            pad = world.add("body", name=f"{name}_pad", mocap=True, pos=(0.5, 0, PAD_THICKNESS))
            pad.add(
                "geom",
                name=f"{name}_pad",
                type="cylinder",
                size=(PAD_RADIUS, PAD_THICKNESS),
                rgba=(*rgb, 1),
                contype=0,
                conaffinity=0,
                group=VISIBLE,
            )

    def _add_material(self, name: str, repeat: tuple[int, int]) -> mjcf.Element:
        """Add a material with its own texture, white before randomisation."""
        texture = self._root.asset.add(
            "texture", name=name, type="2d", builtin="flat", rgb1=(1, 1, 1), width=TEXTURE, height=TEXTURE
        )
        return self._root.asset.add("material", name=name, texture=texture, texrepeat=repeat, specular=0.0)

    def _add_lights(self, shadows: bool) -> None:
        self._root.worldbody.add(
            "light",
            name="lamp",
            pos=np.array(SHADOWED) - LAMP_DISTANCE * LAMP_DIRECTION,
            dir=LAMP_DIRECTION,
            directional=True,
            castshadow=shadows,
            diffuse=(0.55,) * 3,
            specular=(0.15,) * 3,
        )

    def _add_camera(self) -> None:
        axes = look_at(FRONT.position, FRONT.target, (0, 0, 1))
        self._root.worldbody.add(
            "camera", name="front", pos=FRONT.position, xyaxes=(*axes[:, 0], *axes[:, 1]), fovy=FRONT.fovy
        )
