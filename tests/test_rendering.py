"""The fast renderer beside MuJoCo's own."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import moderngl
import mujoco
import numpy as np
import pytest
from conftest import make_tabletop
from gallery import compiled, gallery
from toy_episodes import flip

from vla import jobs
from vla.config.compose import compose as compose_config
from vla.config.compose import substitutes
from vla.config.experiment import Experiment, to_plain
from vla.io.errors import UserError
from vla.spec import Array
from vla.tasks import gl
from vla.tasks.rendering import shapes
from vla.tasks.rendering.context import Context
from vla.tasks.rendering.fast import Detailed, Fast, FastRenderer
from vla.tasks.rendering.reference import Reference, ReferenceRenderer
from vla.tasks.rendering.renderer import Renderer, RendererFactory, Views
from vla.tasks.tabletop.environment import Tabletop

SIZE = 64
EDGE = 0.02  # difference of depth to a neighbour at the edge of an object [m]


def fast(samples: Any = 1, soft: int = 0, faces: int | None = None) -> Fast:
    return Fast(samples=samples, soft=soft, faces=faces)


def smooth(depth: Array) -> Array:
    """Return which pixels of (H, W) have neighbours at nearly the same depth."""
    padded = np.pad(depth, 1, mode="edge")
    height, width = depth.shape
    around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return np.max(around, axis=0) - np.min(around, axis=0) < EDGE


def grey_levels(first: Array, second: Array) -> Array:
    """Return the mean difference of every picture."""
    return np.abs(first.astype(int) - second).mean(axis=(1, 2, 3))


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """What a program does in a process of its own."""
    settings = {**os.environ, **environment}
    return subprocess.run([sys.executable, "-c", code], env=settings, capture_output=True, text=True)


def drawn(choice: RendererFactory, model: mujoco.MjModel, data: mujoco.MjData, views: Views) -> tuple[Array, Array]:
    """Return the pictures and depths that a renderer draws at once."""
    with closing(choice.open(model, views)) as renderer:
        return renderer.render(data)


@pytest.fixture(scope="module")
def wide() -> Iterator[tuple[Tabletop, Renderer, ReferenceRenderer]]:
    environment = make_tabletop("task/randomize=wide", "task.blocks=6")
    with environment.blind():
        environment.reset(0)  # compiles the model
    model, view = environment.simulation.compiled.model, Views((0, 1), SIZE, SIZE, geom_groups=(2,))
    first, second = fast().open(model, view), Reference().open(model, view)
    yield environment, first, second
    for each in (first, second, environment):
        each.close()


def start(environment: Tabletop, seed: int, *renderers: Renderer) -> mujoco.MjData:
    with environment.blind():
        environment.reset(seed)
    compiled = environment.simulation.compiled
    for renderer in renderers:
        renderer.update(range(compiled.model.ntex))
    return compiled.data


def test_pictures_of_forty_scenes_equal_mujocos(wide: tuple[Tabletop, Renderer, ReferenceRenderer]) -> None:
    environment, first, second = wide
    differences = []
    for seed in range(40):
        data = start(environment, seed, first, second)
        (rgb, depth), (reference, distance) = first.render(data), second.render(data)
        inside = np.stack([smooth(each) & smooth(other) for each, other in zip(depth, distance, strict=True)])
        assert inside.mean() > 0.5
        # Beside edges a tenth of a percent may still see another surface, through a gap of less than a pixel.
        assert (np.abs(depth - distance)[inside] > 0.001).mean() < 0.001, seed
        differences.append(grey_levels(rgb, reference))
    assert np.mean(differences) < 1
    assert np.max(differences) < 5  # at the edges of shadows


@pytest.mark.parametrize("choice", [fast(), Reference()])
def test_a_renderer_that_is_closed_leaves_the_others_as_they_are(choice: RendererFactory) -> None:
    model, data = gallery("several")
    views = Views((0,), SIZE, SIZE)
    with closing(choice.open(model, views)) as one:
        before = one.render(data)
        other = choice.open(model, views)
        other.render(data)
        one.render(data)
        other.close()
        for now, earlier in zip(one.render(data), before, strict=True):
            np.testing.assert_array_equal(now, earlier)


def test_changes_of_a_model_are_taken_over(wide: tuple[Tabletop, Renderer, ReferenceRenderer]) -> None:
    """A renderer that has seen other episodes draws the same bytes as a new one."""
    environment, first, _ = wide
    for seed in (3, 50, 7):
        data = start(environment, seed, first)
        new = drawn(fast(), environment.simulation.compiled.model, data, Views((0, 1), SIZE, SIZE, geom_groups=(2,)))
        for ours, theirs in zip(first.render(data), new, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_geoms_come_and_go() -> None:
    text = '<mujoco><worldbody><geom size=".2" rgba="1 0 0 1"/><camera pos="0 0 1"/></worldbody></mujoco>'
    model, data = compiled(text)
    renderer = fast().open(model, Views((0,), SIZE, SIZE))
    reds, depths = [], []
    for alpha in (1.0, 0.0, 0.5, 1.0):
        model.geom_rgba[0, 3] = alpha
        renderer.update()
        rgb, depth = renderer.render(data)
        reds.append(int(rgb[0, SIZE // 2, SIZE // 2, 0]))
        depths.append(float(depth[0, SIZE // 2, SIZE // 2]))
    renderer.close()
    assert reds[0] == reds[3] > reds[2] > reds[1] == 0
    assert depths == pytest.approx([0.8, 0, 0, 0.8], abs=1e-3)  # what is transparent has no depth, as in MuJoCo


def test_things_leave_and_enter_a_picture() -> None:
    text = """<mujoco><asset><texture type="skybox" builtin="gradient" rgb1="0 0 1" rgb2="0 1 0" width="8" height="48"/>
      </asset><worldbody><geom type="plane" size="1 1 .1" rgba="1 1 1 1"/><body mocap="true" pos="0 0 .3">
      <geom type="capsule" size=".1 .3" rgba="1 0 0 1"/></body><camera pos="0 -1 1" xyaxes="1 0 0 0 .7 .7" fovy="20"/>
      <camera pos="0 -3 1" xyaxes="1 0 0 0 0 1" projection="orthographic" fovy="2"/></worldbody></mujoco>"""
    (model, data), view = compiled(text), Views((0, 1), SIZE, SIZE)
    counts = []
    with closing(fast().open(model, view)) as first, closing(Reference().open(model, view)) as second:
        for x in (0.0, 0.25, 0.3, 0.95, 1.05, 9.0, 0.25):
            data.mocap_pos[0, 0] = x
            mujoco.mj_forward(model, data)
            rgb, reference = first.render(data)[0], second.render(data)[0]
            red, expected = (picture[..., 0] > 2 * picture[..., 1].astype(int) for picture in (rgb, reference))
            assert (red != expected).sum() < 0.02 * red.size
            sky, blue = (picture[..., 2] > 2 * picture[..., 0].astype(int) for picture in (rgb, reference))
            np.testing.assert_array_equal(sky.sum(axis=(1, 2)) > 0, blue.sum(axis=(1, 2)) > 0)
            counts.append(red.sum(axis=(1, 2)).tolist())
    near, far = zip(*counts, strict=True)
    assert near[0] > near[2] > near[5] == 0 and far[0] > far[3] > far[4] > far[5] == 0
    assert counts[1] == counts[-1] and (sky.sum(axis=(1, 2)) > 0).tolist() == [False, True]


@pytest.mark.parametrize(
    ("lights", "floor"), [("directional", "2 2 .1"), ("spot", "2 2 .1"), ("several", "2 2 .1"), ("headlight", "0 3 .1")]
)
def test_every_shape_texture_light_and_camera(lights: str, floor: str) -> None:
    model, data = gallery(lights, floor)
    view = Views(range(model.ncam), 96, 120, site_groups=(0,))
    (rgb, depth), (reference, distance) = (drawn(choice, model, data, view) for choice in (fast(), Reference()))
    for picture, other, near, far in zip(rgb, reference, depth, distance, strict=True):
        inside = smooth(near) & smooth(far)
        assert (np.abs(near - far)[inside] > 0.002).mean() < 0.002
        assert np.abs(picture.astype(int) - other)[inside].mean() < 3
        assert np.median(np.abs(picture.astype(int) - other)) <= 1


@pytest.mark.parametrize("renderer", [fast(), Reference()])
def test_a_window_is_a_part_of_what_a_camera_sees(renderer: Fast | Reference) -> None:
    model, data = gallery("directional")
    cameras, top, left = range(model.ncam), [0, 12, 30, 60, 20], [10, 0, 45, 70, 20]
    parts = [slice(y, y + 60) for y in top], [slice(x, x + 50) for x in left]
    whole = drawn(renderer, model, data, Views(cameras, 120, 120))[0]
    expected = np.stack([picture[y, x] for picture, y, x in zip(whole, *parts, strict=True)])
    windows = np.array([[y / 120, x / 120, y / 120 + 0.5, x / 120 + 50 / 120] for y, x in zip(top, left, strict=True)])
    every = np.tile((0.0, 0.0, 1.0, 1.0), (model.ncam, 1))
    with closing(renderer.open(model, Views(cameras, 60, 50, aspect=1.0))) as opened:
        np.testing.assert_array_equal(opened.render(data)[0], opened.render(data, every)[0])
        first, other, again = (opened.render(data, part)[0] for part in (windows, windows[::-1], windows))
    assert grey_levels(first, expected).max() < 0.5 and (first != expected).mean() < 0.05
    assert grey_levels(first, other).max() > 5
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize(
    ("shape", "closed"),
    [
        (shapes.box().scale(np.array([0.1, 0.2, 0.3])), True),
        (shapes.sphere(28, 16), True),
        (shapes.cylinder(24), True),
        (shapes.capsule(24, 16, 0.1, 0.2), True),
        (shapes.tube(24), False),
        (shapes.plane(1, 1), False),
        (shapes.sphere(28, 8, 0.0, 1.0), False),
        (dataclasses.replace(shapes.box(), triangles=shapes.box().triangles[:, ::-1]), False),  # inside out
    ],
)
def test_shapes_that_enclose_a_volume_are_told_from_others(shape: shapes.Surface, closed: bool) -> None:
    assert shape.outline.closed == closed


def test_open_shapes_cast_shadows_with_both_sides() -> None:
    text = """<mujoco><asset><mesh name="lid" inertia="shell" vertex="-1 -1 0 1 -1 0 1 1 0 -1 1 0 0 0 .1" face="FACES"/>
      </asset><worldbody><light pos="0 0 3" dir="0 0 -1" type="directional"/><geom type="plane" size="3 3 .1"/>
      <geom type="mesh" mesh="lid" pos="0 0 1"/><camera pos="0 -3 .9" xyaxes="1 0 0 0 .3 1"/></worldbody></mujoco>"""
    for faces in ("0 1 4 1 2 4 2 3 4 3 0 4", "0 4 1 1 4 2 2 4 3 3 4 0"):
        scene = compiled(text.replace("FACES", faces))
        pictures = [drawn(choice, *scene, Views((0,), SIZE, SIZE))[0] for choice in (fast(), Reference())]
        below = [picture[0, SIZE // 2, SIZE // 2].astype(int) for picture in pictures]
        beside = [picture[0, -1, 0].astype(int) for picture in pictures]
        assert (below[0] < 0.7 * beside[0]).all()
        np.testing.assert_allclose(below[0], below[1], atol=2)
        np.testing.assert_allclose(beside[0], beside[1], atol=2)


def test_edges_are_smooth_where_asked() -> None:
    scene, choices = gallery("directional"), {"plain": fast(), "smooth": fast(samples=4), "soft": fast(soft=1)}
    colours = {name: drawn(choice, *scene, Views((0,), SIZE, SIZE))[0] for name, choice in choices.items()}
    for name in ("smooth", "soft"):
        assert 0 < grey_levels(colours["plain"], colours[name])[0] < 6, name
        shades = [len(np.unique(colours[each].reshape(-1, 3), axis=0)) for each in (name, "plain")]
        assert shades[0] > shades[1]


def test_textures_are_as_coarse_as_mujocos_where_asked() -> None:
    text = """<mujoco><asset>
      <texture name="skin" type="2d" builtin="flat" rgb1="1 .9 .8" mark="random" random=".4" markrgb="0 .1 .2"
        width="256" height="256"/>
      <material name="skin" texture="skin"/></asset><worldbody>
      <geom type="plane" size="1 1 .1" material="skin"/><camera pos="0 -1.5 1" xyaxes="1 0 0 0 .55 .83"/>
      </worldbody></mujoco>"""
    scene, views = compiled(text), Views((0,), SIZE, SIZE)
    mujocos, *ours = (drawn(choice, *scene, views)[0] for choice in (Reference(), fast(samples=4), Detailed()))
    smooth, detailed = (grey_levels(mujocos, pictures)[0] for pictures in ours)
    assert detailed < 0.8 * smooth


def test_renderers_share_a_context_and_draw_by_turns() -> None:
    scenes, alone = [], []
    for lights, settings in (("spot", {}), ("directional", {"samples": 4}), ("several", {"soft": 1})):
        model, data = gallery(lights)
        alone.append(drawn(fast(**settings), model, data, Views((0,), SIZE, SIZE))[0])
        scenes.append((settings, model, data))
    renderers = [fast(**settings).open(model, Views((0,), SIZE, SIZE)) for settings, model, _ in scenes]
    with ThreadPoolExecutor() as pool:
        for left in (3, 3, 2):  # the last one is closed, and the others go on
            for renderer in renderers[left:]:
                renderer.close()
            for renderer, (_, _, data), expected in zip(renderers[:left], scenes, alone, strict=False):
                assert np.array_equal(renderer.render(data)[0], expected)
                assert np.array_equal(pool.submit(renderer.render, data).result()[0], expected)
    for renderer in renderers[:2]:
        renderer.close()


def test_what_is_left_out_is_named(caplog: pytest.LogCaptureFixture) -> None:
    model, _ = gallery("spot", "0 0 .1")
    fast().open(model, Views((0,), 8, 8)).close()
    assert "the fast renderer leaves out haze at the horizon; task/renderer=mujoco draws them" in caplog.text


def test_without_egl_the_error_names_the_other_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> None:
        raise Exception("libEGL.so not found")

    monkeypatch.setattr(moderngl, "create_standalone_context", refuse)
    monkeypatch.setattr("vla.tasks.rendering.fast.shared_context", Context)  # that of this process exists already
    model, _ = gallery("spot")
    with pytest.raises(UserError, match=r"lacks \(libEGL.so not found\): .*, or choose task/renderer=mujoco"):
        fast().open(model, Views((0,), 8, 8))


def test_without_egl_mujocos_renderer_is_chosen_and_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(gl.EGL_WORKS, "False")
    config = compose_config("output=here")
    others = substitutes(to_plain(config.task), ["output=here"])
    usable = compose_config("output=here", *others)
    assert "the fast renderer needs EGL, which this machine lacks" in caplog.text
    assert "task/renderer=mujoco instead" in caplog.text
    folders = [compose_config("output=here", f"task/renderer={each}").collect.folder for each in ("mujoco", "fast")]
    assert usable.collect.folder == folders[0] != folders[1]
    assert not substitutes(to_plain(config.task), ["task/renderer=fast"])  # and fails, in a sentence
    monkeypatch.setenv(gl.EGL_WORKS, "True")
    assert not substitutes(to_plain(config.task), [])
    for option, simulated in (("loop", True), ("simulator", True), ("ros2", False), ("server", False)):
        deploying = Experiment.from_config(compose_config("job=deploy", f"deploy={option}", "output=here"))
        assert jobs.builds_world(deploying) == simulated


def test_a_machine_without_gl_is_told_from_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(gl.EGL_WORKS, raising=False)
    monkeypatch.setattr(gl, "EGL_PROBE", "raise SystemExit(1)")
    assert not gl.has_egl()


@pytest.mark.parametrize(
    ("set_before", "device"),
    [({}, "4"), ({gl.WORKER: "3"}, "1"), ({"MUJOCO_EGL_DEVICE_ID": "3"}, "3"), ({gl.EGL_DEVICES: ""}, None)],
)
def test_workers_take_turns_on_the_gpus_of_a_machine(
    set_before: dict[str, str], device: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("MUJOCO_EGL_DEVICE_ID", "GLCONTEXT_DEVICE_INDEX", gl.EGL_DEVICE, gl.WORKER):
        monkeypatch.setenv(name, "")  # so that what the code sets is undone, too
        monkeypatch.delenv(name)
    settings = {gl.EGL_DEVICES: "1\n3\n4\n", gl.WORKER: "2", **set_before}
    worker = settings.pop(gl.WORKER)
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    gl.choose_device()  # as the main process does before it starts workers, which inherit its choice
    monkeypatch.setenv(gl.WORKER, worker)
    gl.choose_device()
    assert os.environ.get("MUJOCO_EGL_DEVICE_ID") == os.environ.get("GLCONTEXT_DEVICE_INDEX") == device


def test_both_renderers_draw_on_the_chosen_device() -> None:
    """There is none of this number, and both say so."""
    for probe in (gl.PROBE, gl.EGL_PROBE):
        code = f"from vla.tasks.gl import choose_device; choose_device()\n{probe}"
        done = run(code, MUJOCO_GL="egl", MUJOCO_EGL_DEVICE_ID="99")
        assert done.returncode != 0 and "99" in done.stderr, done.stderr


def test_a_software_renderer_is_no_gpu_to_take_turns_on() -> None:
    found = []
    for probe in (gl.DEVICES_PROBE, gl.DEVICES_PROBE.replace('b"software"', 'b"none of these"')):
        done = run(probe, MUJOCO_GL="egl", LIBGL_ALWAYS_SOFTWARE="1")
        assert done.returncode == 0, done.stderr
        found.append({*map(int, done.stdout.split())})
    assert found[0] < found[1]  # that of Mesa is there, and left out


def test_triton_is_loaded_before_the_software_renderer_where_a_gpu_needs_it() -> None:
    """In the other order the process would crash, as soon as Triton compiles."""
    code = """
from unittest.mock import patch
from vla.parallel import processes
from vla.tasks import gl
with patch.object(processes, "GPUS", ("null",)):  # as if /dev/null were one
    gl.choose_backend()
import moderngl
context = moderngl.create_standalone_context(backend="egl")
from triton._C.libtriton import llvm
llvm.init_targets()
picture = context.simple_framebuffer((8, 8))
picture.clear(1.0, 1.0, 1.0)
assert picture.read()[:3] == b"\\xff\\xff\\xff"
"""
    done = run(code)
    assert done.returncode == 0, (done.returncode, done.stderr)


def textured_ball(rows: int, columns: int) -> str:
    """A ball in Wavefront's format, whose texture has a seam between faces that share their vertices."""
    lines = []
    for row in range(rows + 1):
        polar = np.pi * (0.02 + 0.96 * row / rows)
        for azimuth in 2 * np.pi * np.arange(columns) / columns:
            lines.append(f"v {np.sin(polar) * np.cos(azimuth)} {np.sin(polar) * np.sin(azimuth)} {np.cos(polar)}")
        lines += [f"vt {column / columns} {row / rows}" for column in range(columns + 1)]
    for row, column in np.ndindex(rows, columns):
        corners = [(row, column), (row + 1, column), (row + 1, column + 1), (row, column + 1)]
        ids = [f"{y * columns + x % columns + 1}/{y * (columns + 1) + x + 1}" for y, x in corners]
        lines += [f"f {ids[0]} {ids[1]} {ids[2]}", f"f {ids[0]} {ids[2]} {ids[3]}"]
    return "\n".join(lines)


def test_a_heavy_mesh_is_decimated_once_and_keeps_its_texture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    text = """<mujoco><visual><headlight ambient=".6 .6 .6"/></visual><asset><mesh name="ball" file="ball.obj"/>
      <texture name="skin" type="2d" builtin="checker" rgb1="1 .2 .1" rgb2=".1 .3 .9" width="128" height="64"/>
      <material name="skin" texture="skin" texrepeat="4 3"/></asset><worldbody>
      <geom type="mesh" mesh="ball" material="skin"/><camera pos="3 0 0" xyaxes="0 1 0 0 0 1"/>
      <camera pos="-3 0 0" xyaxes="0 -1 0 0 0 1"/></worldbody></mujoco>"""
    model, data = compiled(text, {"ball.obj": textured_ball(60, 90).encode()})
    views = Views((0, 1), 128, 128)  # the first camera sees the seam

    def pictures(choice: Fast | Reference) -> Array:
        with closing(choice.open(model, views)) as renderer:
            if isinstance(renderer, FastRenderer) and choice == fast(faces=2000):
                assert 1900 < sum(len(each.visible.triangles) for each in renderer._geometry.elements) < 2100
            return renderer.render(data)[0]

    reference, whole, fewer = (pictures(choice) for choice in (Reference(), fast(), fast(faces=2000)))
    assert grey_levels(reference, whole).max() < 1
    assert grey_levels(reference, fewer).max() < 5  # without its texture 39
    (kept,) = (tmp_path / "vla" / "meshes").iterdir()
    content = kept.read_bytes()
    for damage in (content, b"", content[: len(content) // 2], b"[1]", flip(content, 400)):
        kept.write_bytes(damage)
        np.testing.assert_array_equal(pictures(fast(faces=2000)), fewer)
        assert kept.read_bytes() == content and [*kept.parent.iterdir()] == [kept]
