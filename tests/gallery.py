"""A model with every shape, texture and light that renderers draw."""

from __future__ import annotations

import mujoco

SPOT = (
    '<light pos="0 -1 3" dir="0 .3 -1" type="spot" cutoff="40" exponent="5" attenuation="1 .05 .02" '
    'diffuse=".6 .5 .4" castshadow="true"/>'
)
LIGHTS = {
    "directional": '<light pos="1 -1 3" dir="-.3 .3 -1" type="directional" diffuse=".6 .6 .6" ambient=".1 .1 .1"/>',
    "spot": SPOT,
    "several": SPOT
    + '<light pos="-1 -1 2" dir=".5 .5 -1" type="directional" castshadow="false" diffuse=".2 .2 .5"/>'
    + '<light pos="2 0 2" dir="-1 0 -1" type="spot" cutoff="60" exponent="1" diffuse=".1 .5 .1"/>',
    "headlight": "",
}
MODEL = """
<mujoco>
  <visual>
    <headlight ambient=".2 .2 .2" diffuse=".3 .3 .3" specular=".2 .2 .2"/>
    <quality shadowsize="512" offsamples="0"/>
    <map znear="0.01" zfar="20"/>
  </visual>
  <statistic extent="1" center="0 0 .5"/>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".3 .5 .7" rgb2=".9 .9 1" width="64" height="384"/>
    <texture name="grid" type="2d" builtin="checker" rgb1=".8 .3 .2" rgb2=".2 .3 .4" width="64" height="64"
             mark="cross" markrgb="1 1 1"/>
    <texture name="fine" type="2d" builtin="gradient" rgb1=".1 .9 .2" rgb2=".9 .3 .9" width="96" height="32"/>
    <texture name="dice" type="cube" builtin="checker" rgb1=".9 .8 .1" rgb2=".2 .1 .6" width="32" height="192"/>
    <texture name="same" type="cube" builtin="checker" rgb1=".1 .8 .8" rgb2=".6 .1 .1" width="32" height="32"/>
    <material name="grid" texture="grid" texrepeat="2 3"/>
    <material name="uniform" texture="fine" texrepeat="3 3" texuniform="true"/>
    <material name="floor" texture="grid" texrepeat="1 1" texuniform="true" specular=".2"/>
    <material name="dice" texture="dice"/>
    <material name="same" texture="same" texuniform="true" shininess=".9" specular="1"/>
    <material name="glow" rgba=".2 .6 .3 1" emission=".5"/>
    <mesh name="plain" vertex="0 0 0  .3 0 0  0 .3 0  0 0 .3"/>
    <mesh name="mapped" vertex="0 0 0  .3 0 0  0 .3 0  0 0 .3" texcoord="0 0 1 0 0 1 1 1"
          face="0 2 1 0 1 3 0 3 2 1 2 3"/>
  </asset>
  <worldbody>
    LIGHTS
    <geom type="plane" size="FLOOR" material="floor"/>
    <geom type="sphere" size=".2" pos="-.9 0 .2" material="grid"/>
    <geom type="sphere" size=".2" pos="-.9 .6 .2" material="dice"/>
    <geom type="box" size=".2 .15 .1" pos="-.3 0 .1" material="grid" euler="0 0 20"/>
    <geom type="box" size=".15 .15 .15" pos="-.3 .6 .15" material="dice" euler="10 0 20"/>
    <geom type="capsule" size=".1 .2" pos=".2 0 .3" material="uniform" euler="20 0 0"/>
    <geom type="capsule" size=".1 .2" pos=".2 .6 .3" material="same"/>
    <geom type="cylinder" size=".15 .1" pos=".7 0 .1" material="grid"/>
    <geom type="cylinder" size=".15 .1" pos=".7 .6 .1" material="same" euler="80 0 30"/>
    <geom type="ellipsoid" size=".1 .2 .15" pos="1.1 0 .15" material="uniform"/>
    <geom type="ellipsoid" size=".1 .2 .15" pos="1.1 .6 .15" rgba=".3 .5 .9 1"/>
    <geom type="mesh" mesh="plain" pos="-.6 -.6 .1" material="grid"/>
    <geom type="mesh" mesh="mapped" pos="-.1 -.6 .1" material="grid"/>
    <geom type="mesh" mesh="plain" pos=".3 -.6 .1" material="same"/>
    <geom type="box" size=".1 .1 .1" pos=".8 -.6 .1" material="glow"/>
    <geom type="sphere" size=".15" pos="-.5 -.9 .3" rgba=".9 .2 .2 .4"/>
    <geom type="box" size=".15 .02 .15" pos="-.4 -1.1 .3" rgba=".2 .2 .9 .5"/>
    <geom type="plane" size=".2 .2 .1" pos=".6 -1 .3" euler="70 0 0" rgba=".9 .9 .2 1"/>
    <geom type="plane" size=".2 .2 .1" pos="1.1 -1 .3" euler="-80 0 0" rgba=".9 .9 .2 1"/>
    <geom type="sphere" size=".3" pos="0 0 1" group="3"/>
    <site type="sphere" size=".05" pos="0 -1 .6" rgba="1 0 1 1"/>
    <site type="box" size=".05 .02 .03" pos=".2 -1 .6" rgba="0 1 1 1" group="1"/>
    <camera pos="0 -2.4 1.3" xyaxes="1 0 0 0 .45 1"/>
    <camera pos="2.2 .6 .5" xyaxes="-.2 1 0 -.2 0 1" fovy="60"/>
    <camera pos="0 0 4" projection="orthographic" fovy="3"/>
    <camera pos="0 -2.4 1.3" xyaxes="1 0 0 0 .45 1" resolution="100 100" focalpixel="90 110"
            principalpixel="10 -15" sensorsize="1 1"/>
    <body pos="-1.5 -1.5 1.5"><joint/><geom size=".01"/><camera mode="targetbody" target="middle"/></body>
    <body name="middle" pos=".2 0 .2"/>
  </worldbody>
</mujoco>
"""


def compiled(text: str, files: dict[str, bytes] | None = None) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return a model and its state."""
    model = mujoco.MjModel.from_xml_string(text, files)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def gallery(lights: str, floor: str = "2 2 .1") -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the model under some of `LIGHTS`, with a floor of this size, and its state."""
    return compiled(MODEL.replace("LIGHTS", LIGHTS[lights]).replace("FLOOR", floor))
