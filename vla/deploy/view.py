"""Show the inputs, commands and states of a deployed policy in Rerun.

python -m vla.deploy.view                   opens the viewer
python -m vla.deploy.view --save FILE.rrd   writes a recording until interrupted
python -m vla.deploy.view --expected STORE  also overlays the training images on the live ones

The arm is drawn as the agent describes it: as lines between its joints, or with the surface named by --shell.
"""

from __future__ import annotations

import argparse
import os
import pkgutil
import re
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vla.data.episodes import EpisodeStore
from vla.deploy import messages
from vla.deploy.control_loop import REPEATED
from vla.deploy.ros import NETWORKS, command_node, spin
from vla.deploy.topic_listener import TopicListener
from vla.io.errors import UserError
from vla.io.files import atomic_path
from vla.io.images import resize
from vla.robots.chain import frame_positions
from vla.rollouts.recorder import CURVES, draw_poses, draw_shapes, encoded
from vla.spec import Array, Shell

SMALL = 256 * 256  # images of at most so many pixels are logged as PNG: JPEG artefacts would hide small objects
POSE_PERIOD = 0.1  # between two poses of the arm [s]
EYE, LOOK_AT = (1.2, -0.9, 0.8), (0.25, 0.0, 0.35)  # initial camera of the 3-D view [m]
ARM_TOPIC = "/vla_agent/arm"  # of the agent, in any namespace
THICKNESS = 0.02  # radius of the lines between joints [m]
CAMERAS = ("front=/isaac/camera/image_raw", "wrist=/isaac/wrist_camera/image_raw")  # as in deploy/topics=isaac
LOOKS = 32  # episodes whose first images make up an expected picture
NUMBER = re.compile(r"\d+(\.\d+)?")
LEVELS = (rr.TextLogLevel.INFO, rr.TextLogLevel.WARN, rr.TextLogLevel.ERROR)  # of a DiagnosticStatus


class View(TopicListener):
    """Logs arm, images, joints, commands, instructions and the agent's states on the timeline "time" [s] until `close`.

    Instructions and states are logged when they change.
    """

    def __init__(
        self,
        node: Any,
        save: Path | None = None,
        shell: Shell | None = None,
        expected: Mapping[str, Array] | None = None,
    ) -> None:
        """Args:
        node: the node that subscribes, which the caller spins.
        save: a .rrd file; None opens the viewer.
        shell: surface of arms with the same kinematic chain; other arms, or all if None, are drawn as lines.
        expected: topic of a camera → picture (H, W, 3) uint8 that is laid over its images.
        """
        self._expected = dict(expected or {})
        self._stream = rr.RecordingStream("vla_deploy", recording_id=os.urandom(6).hex())
        self._file, self._cameras = ExitStack(), list[str]()
        if save is None:
            self._stream.spawn()
        else:
            save.parent.mkdir(parents=True, exist_ok=True)
            self._stream.save(self._file.enter_context(atomic_path(save)))
        self._started = time.monotonic()
        self._last_texts: dict[str, tuple[str, float]] = {}  # source → its last text, and when that arrived
        self._curves: set[str] = set()  # paths whose style is logged
        self._latencies: list[str] = []  # quantities in the order of their colours
        self._arm: messages.ArmDescription | None = None
        self._shell, self._posed_at = shell, -np.inf
        super().__init__(node)
        self._send_layout()

    def callback_for(self, topic: str, kind: str) -> Callable[[Any], None] | None:
        """Return the callback that logs the messages of a topic; None for types that are not shown."""
        if kind in ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"):
            self._cameras.append(topic)
            self._send_layout()
        log: dict[str, Callable[[str, Any], None]] = {
            "sensor_msgs/msg/Image": self._image,
            "sensor_msgs/msg/CompressedImage": self._image,
            "sensor_msgs/msg/JointState": self._joint_state,
            "trajectory_msgs/msg/JointTrajectory": self._trajectory,
            "diagnostic_msgs/msg/DiagnosticStatus": self._status,
            "std_msgs/msg/String": lambda topic, m: self._log_text(topic, m.data, repeat_after=REPEATED),
        }
        if topic.endswith(ARM_TOPIC):
            log["std_msgs/msg/String"] = self._describe
        if kind not in log:
            return None

        def callback(message: Any) -> None:
            self._stream.set_time("time", duration=time.monotonic() - self._started)
            log[kind](topic, message)

        return callback

    def close(self) -> None:
        """Finish the recording."""
        super().close()
        self._stream.flush()
        self._stream.disconnect()
        self._file.close()

    def _log_text(
        self, source: str, text: str, level: rr.TextLogLevel = rr.TextLogLevel.INFO, repeat_after: float = np.inf
    ) -> None:
        """Log a text, unless it equals the last one of its source, less than `repeat_after` seconds ago."""
        text, now = messages.shorten(text, 300), time.monotonic()
        before, at = self._last_texts.get(source, ("", -np.inf))
        self._last_texts[source] = (text, now)
        if text != before or now - at > repeat_after:
            self._stream.log("words", rr.TextLog(f"{source}: {text}", level=level))

    def _image(self, topic: str, message: Any) -> None:
        try:
            pixels = messages.image_from(message)
        except ValueError as error:
            return self._log_text(topic, str(error), rr.TextLogLevel.WARN)
        small = pixels.shape[0] * pixels.shape[1] <= SMALL
        blob = encoded(pixels, "PNG", compress_level=1) if small else encoded(pixels, "JPEG", quality=90)
        kind = "image/png" if small else "image/jpeg"
        self._stream.log(f"camera{topic}", rr.EncodedImage(contents=blob, media_type=kind))
        if (picture := self._expected.get(topic)) is not None:
            both = resize(pixels, (picture.shape[0], picture.shape[1]), "centre").astype(np.uint16) + picture
            blob = encoded((both // 2).astype(np.uint8), "PNG", compress_level=1)
            self._stream.log(f"expected{topic}", rr.EncodedImage(contents=blob, media_type="image/png"))
        return None

    def _describe(self, topic: str, message: Any) -> None:
        """Draw another arm from now on."""
        try:
            arm = messages.arm_from(message)
        except ValueError as error:
            return self._log_text(topic, str(error), rr.TextLogLevel.WARN)
        if arm != self._arm:
            self._arm = arm
            draw_shapes(self._stream, self._shell.shapes() if self._shell and self._shell.chain == arm.chain else [])
        return None

    def _joint_state(self, topic: str, message: Any) -> None:
        self._joints(topic, message.name, message.position)
        if "command" not in topic and time.monotonic() >= self._posed_at + POSE_PERIOD:
            self._pose(dict(zip(message.name, message.position, strict=False)))

    def _pose(self, positions: dict[str, float]) -> None:
        """Draw the arm, if its kinematics are known and all its joints have a position [rad]."""
        arm = self._arm
        joints = np.array([positions.get(name, np.nan) for name in arm.joints]) if arm else np.empty(0)
        if arm is None or not arm.chain or not np.isfinite(joints).all():
            return
        self._posed_at = time.monotonic()
        if self._shell is not None and self._shell.chain == arm.chain:
            opening = float(np.nansum([positions.get(name, np.nan) for name in arm.fingers]))
            draw_poses(self._stream, self._shell.poses(joints, opening))
        else:
            lines = rr.LineStrips3D([frame_positions(arm.chain, joints)], radii=THICKNESS)
            self._stream.log("world/arm", lines)

    def _trajectory(self, topic: str, message: Any) -> None:
        if message.points:
            self._joints(topic, message.joint_names, message.points[0].positions)

    def _joints(self, topic: str, names: list[str], positions: Any) -> None:
        """Log a curve per joint, coloured by index; commanded positions have thinner lines than measured ones."""
        commanded = "command" in topic
        for place, (name, position) in enumerate(zip(names, positions, strict=False)):
            finger = name in self._arm.fingers if self._arm else "finger" in name
            group = "gripper" if finger else "joints"
            path = f"{group}/{'commanded' if commanded else 'measured'}/{name}"
            label = f"{name}, commanded" if commanded else name
            colour = int(CURVES[place % len(CURVES)])
            self._curve(path, position, label, colour, 0.75 if commanded else 1.75)

    def _status(self, topic: str, message: Any) -> None:
        level = LEVELS[min(int.from_bytes(message.level, "little"), len(LEVELS) - 1)]
        self._log_text(message.name, message.message, level)
        for pair in message.values:
            if pair.key.endswith(" [ms]") and NUMBER.fullmatch(pair.value):
                self._latency(pair.key.removesuffix(" [ms]"), float(pair.value))

    def _latency(self, name: str, milliseconds: float) -> None:
        """Log a curve per percentile; those of one quantity share a colour, the higher one darker."""
        quantity, _, percentile = name.rpartition(" ")
        if quantity not in self._latencies:
            self._latencies.append(quantity)
        *rgb, alpha = int(CURVES[self._latencies.index(quantity) % len(CURVES)]).to_bytes(4, "big")
        colour = int.from_bytes([*(each // 2 if percentile == "p99" else each for each in rgb), alpha], "big")
        self._curve(f"latency/{name.replace(' ', '_')}", milliseconds, name, colour)

    def _curve(self, path: str, value: float, name: str, colour: int, width: float = 1.75) -> None:
        """Log a point of a curve in a `colour` 0xRRGGBBAA, `width` [px] wide."""
        if path not in self._curves:
            self._curves.add(path)
            self._stream.log(path, rr.SeriesLines(names=name, colors=[colour], widths=[width]), static=True)
        self._stream.log(path, rr.Scalars(value))

    def _send_layout(self) -> None:
        """Send the layout: arm, cameras and texts above, curves below."""
        eye = rrb.EyeControls3D(position=EYE, look_target=LOOK_AT, eye_up=(0, 0, 1))
        arm = rrb.Spatial3DView(origin="/world", name="arm", eye_controls=eye)
        views = [rrb.Spatial2DView(origin=f"camera{topic}", name=topic) for topic in self._cameras]
        views += [
            rrb.Spatial2DView(origin=f"expected{topic}", name=f"{topic} over training")
            for topic in self._cameras
            if topic in self._expected
        ]
        columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
        texts = rrb.TextLogView(origin="/words", name="instructions and states", columns=columns)
        legend = rrb.PlotLegend(visible=False)
        curves = [
            rrb.TimeSeriesView(origin="/joints", name="joints [rad], commanded thinner", plot_legend=legend),
            rrb.TimeSeriesView(origin="/gripper", name="fingers [m]", plot_legend=legend),
            rrb.TimeSeriesView(origin="/latency", name="latencies [ms]"),
        ]
        above = rrb.Horizontal(arm, *views, texts, column_shares=[3, *(3 for _ in views), 4])
        layout = rrb.Vertical(above, rrb.Horizontal(*curves, column_shares=[4, 2, 3]))
        panels = [panel(state="collapsed") for panel in (rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel)]
        self._stream.send_blueprint(rrb.Blueprint(layout, *panels))


def _shell(name: str) -> Shell:
    """Build the shell of a dotted name; a UserError if there is none."""
    try:
        shell: Shell = pkgutil.resolve_name(name)()
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise UserError(f"--shell {name} cannot be built: {error}") from error
    return shell


def expected_pictures(folder: Path, cameras: Iterable[str]) -> dict[str, Array]:
    """Return topic → median first image of the episodes of a store, (H, W, 3) uint8.

    The median over episodes keeps what is always at the same place, such as the table.

    Args:
        folder: of the store.
        cameras: as in "front=/front/image_raw".

    Raises:
        UserError: there is no such store, or no such camera in it.
    """
    store = EpisodeStore(folder)
    store.require_episodes()
    pictures = {}
    for camera, _, topic in (each.partition("=") for each in cameras):
        if camera not in store.spec.cameras or not topic:
            known = ", ".join(store.spec.cameras)
            raise UserError(f"--cameras {camera}={topic}: name a topic for cameras of {folder}, which has {known}")
        rows = store.rows(f"rgb_{camera}")
        first = [rows[entry.start : entry.start + 1][0] for entry in store.episodes[:LOOKS]]
        pictures[topic] = np.median(first, axis=0).astype(np.uint8)
    return pictures


def main() -> None:
    """Log until interrupted."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.view", description=__doc__.splitlines()[0])
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a recording instead of opening the viewer")
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    parser.add_argument(
        "--shell", metavar="CLASS", help="surface of the arm, such as vla.tasks.tabletop.panda.PandaShell"
    )
    parser.add_argument(
        "--expected", type=Path, metavar="STORE", help="episodes whose pictures the cameras should give"
    )
    parser.add_argument("--cameras", nargs="+", default=CAMERAS, metavar="CAMERA=TOPIC", help="for --expected")
    options = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "disabled")  # no rendering in this process
    with command_node("vla_view", options.network) as (node, stopped):
        shell = _shell(options.shell) if options.shell else None
        expected = expected_pictures(options.expected, options.cameras) if options.expected else None
        with closing(View(node, options.save, shell, expected)):
            spin(node, stopped)


if __name__ == "__main__":
    main()
