"""Files of arms: what they refer to is found, or said in one sentence, and the tabletop's own settings hold."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arm_models import arguments_of, fingers, make, mjcf, successes, urdf

from vla.tasks.tabletop import robot_file
from vla.tasks.tabletop.file_robot import FileRobot
from vla.tasks.tabletop.robot_file import RobotFile

# A tetrahedron of 6 cm.
CORNERS = 0.06 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def write_mesh(path: Path) -> None:
    """A binary STL file."""
    path.parent.mkdir(parents=True)
    triangle = np.dtype([("normal", "<3f4"), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles = np.zeros(len(FACES), triangle)
    triangles["corners"] = CORNERS[FACES]
    path.write_bytes(bytes(80) + np.array([len(FACES)], "<u4").tobytes() + triangles.tobytes())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"arm\.xml: there is no such file"),
        ("<mujoco><include file='/etc/hostname'/></mujoco>", r"arm\.xml does not compile: XML"),
        (mjcf(more='<asset><mesh file="link.stl"/></asset>'), r"link\.stl"),
        (mjcf().replace('name="j5"', 'name="j4"'), r"arm\.xml does not compile: .*repeated name 'j4'"),
        (urdf("package://parts/link.stl"), r"mesh at package://parts/link\.stl: no folder parts is above the file, in"),
        (
            urdf("model://parts/link.stl"),
            r"mesh at model://parts/link\.stl: meshes are at package://, file://",
        ),
        (urdf("package://[parts/link.stl"), r"mesh at package://\[parts/link\.stl, which is no address: Invalid IPv6"),
        (urdf("file:///dev/zero"), r"/dev/zero is a folder, a pipe or a device, not a file"),
        (urdf("file:///nowhere/link.stl"), r"does not compile: .*'/nowhere/link\.stl'"),
    ],
)
def test_a_file_that_does_not_compile_is_named(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        FileRobot(RobotFile(**arguments_of(tmp_path / "arm.xml")), "light")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("mesh", "address", "variable"),
    [
        ("my_arm/meshes/a link.stl", "package://my_arm/meshes/a%20link.stl", ""),
        ("src/parts/link.stl", "package://parts/link.stl", ""),  # beside the file's own package
        ("install/share/parts/link.stl", "package://parts/link.stl", "AMENT_PREFIX_PATH=nowhere:{}/install"),
        ("ros/parts/link.stl", "package://parts/link.stl", "ROS_PACKAGE_PATH={}/ros"),
        ("ros/parts/link.stl", "package://parts/link.stl", "ROS_PACKAGE_PATH={}/ros/parts"),
        ("link.stl", "file://{}/meshes/link.stl", ""),
    ],
)
def test_meshes_of_packages_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mesh: str, address: str, variable: str
) -> None:
    folder = tmp_path / ("src" if mesh.startswith("src") else "") / "my_arm" / "urdf"
    folder.mkdir(parents=True)
    write_mesh(tmp_path / "meshes" / mesh if address.startswith("file") else tmp_path / mesh)
    (folder / "arm.urdf").write_text(urdf(address.format(tmp_path)))
    for name in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(*variable.format(tmp_path).split("=", 1))
    model = RobotFile(**arguments_of(folder / "arm.urdf")).read().compile()
    assert model.nmesh == 1
    assert np.ptp(model.mesh_vert, axis=0).max() == pytest.approx(0.06 * np.sqrt(2), rel=0.1)


TEXTURED = """<asset><texture name="skin" type="2d" file="none.png"/><material name="skin" texture="skin"
    rgba="0.1 0.2 0.3 1"/></asset>"""


@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_textures_are_not_needed_and_one_sentence_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str
) -> None:
    text = mjcf(fingers().replace("<geom", '<geom material="skin"'), more=TEXTURED)
    if kind == "urdf":
        skin = '<material name="skin"><texture filename="package://none/none.png"/></material>'
        text = urdf().replace('<link name="base">', f'{skin}<link name="base">')
    (tmp_path / "arm.xml").write_text(text)
    with caplog.at_level(logging.INFO, robot_file.__name__):
        models = [RobotFile(**arguments_of(tmp_path / "arm.xml")).read().compile() for _ in range(2)]
    said = "its textures are left out, and shapes have the colours of their materials"
    assert [record.message for record in caplog.records] == [f"task.robot.file={tmp_path / 'arm.xml'}: {said}"]
    assert models[0].ntex == 0


SETTINGS = """<option timestep="0.0005" integrator="RK4" cone="pyramidal" impratio="3" gravity="0 0 -1" o_margin="0.1">
    <flag contact="disable" override="enable"/></option><size memory="9M" nuserdata="3" nuser_geom="2"/>
    <statistic extent="3"/><visual><headlight ambient="1 1 1"/><map znear="0.5"/><quality shadowsize="64"/></visual>"""
HAND = f"""<mujoco>{SETTINGS.replace("0.0005", "0.001")}<worldbody><body name="hand">
    <geom type="box" size="0.02 0.06 0.01" user="1 2"/>{fingers()}</body></worldbody></mujoco>"""


def test_the_settings_of_the_tabletop_hold_without_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(mjcf("", "", more=SETTINGS).replace('"hand"', '"flange"'))
    (tmp_path / "hand.xml").write_text(HAND)
    grips = {f"hand_{name}": value for name, value in (("left", 0.04), ("right", 0.04))}
    tips = [["hand_left_link"], ["hand_right_link"]]
    own: dict[str, object] = {"hand": str(tmp_path / "hand.xml"), "mount": "flange", "tool": "hand_hand"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = make(tmp_path / "arm.xml", open=grips, closed=dict.fromkeys(grips, 0.0), fingertips=tips, **own)
        assert successes(environment, range(4)) == 4
    model = environment.simulation.compiled.model
    option = (model.opt.timestep, model.opt.integrator, model.opt.cone, model.opt.impratio, model.opt.gravity[2])
    fast, elliptic = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option == (0.004, fast, elliptic, 10, -9.81)
    assert (model.opt.disableflags, model.opt.enableflags, model.stat.extent) == (0, 0, 1.0)
    assert model.vis.map.znear == pytest.approx(0.01)
    environment.close()
    assert "conflict" not in "".join(capfd.readouterr())
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
