"""See in Rerun what a deployed policy sees and commands.

python -m vla.deploy.view                   opens the viewer
python -m vla.deploy.view --save FILE.rrd   writes a recording until interrupted
"""

from __future__ import annotations

import argparse
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vla.deploy import messages
from vla.deploy.overhear import Eavesdropper
from vla.deploy.ros import NETWORKS, Network, plain_errors, ros, spin
from vla.record import CURVES, draw_poses, draw_shapes, encoded
from vla.spec import Array

SMALL = 256 * 256  # images of so many pixels are drawn without loss: JPEG would smear what is few pixels wide
POSE_PERIOD = 0.1  # between two poses of the arm [s]
REPEATED = 2.0  # who says the same in shorter intervals repeats it, as `ros2 topic pub` does [s]
EYE, LOOK_AT = (1.2, -0.9, 0.8), (0.25, 0.0, 0.35)  # from where and at what the viewer first looks [m]
ARM = re.compile(r"(?!.*finger).*joint([1-7])")  # name of a joint of a Panda or FR3
FIGURE = re.compile(r"\d+(\.\d+)?")
LEVELS = (rr.TextLogLevel.INFO, rr.TextLogLevel.WARN, rr.TextLogLevel.ERROR)  # of a DiagnosticStatus


class View(Eavesdropper):
    """Draws arm, images, joints, commands, words and the agent's states on the timeline "time" [s]; ends with `close`.

    Words and states are drawn when they change.
    """

    def __init__(self, node: Any, save: Path | None = None) -> None:
        """Args: the node whose spinning draws; a .rrd file, or None for a viewer that opens."""
        from vla.tasks.arm import Arm  # here, because it imports MuJoCo, which reads MUJOCO_GL then

        self._stream = rr.RecordingStream("vla_deploy", recording_id=os.urandom(6).hex())
        self._save, self._cameras = save, list[str]()
        if save is None:
            self._stream.spawn()
        else:
            save.parent.mkdir(parents=True, exist_ok=True)
            self._stream.save(save.with_name(f"{save.name}.partial"))
        self._began = time.monotonic()
        self._said: dict[str, tuple[str, float]] = {}  # who → what was said last, and when
        self._curves: set[str] = set()  # that have got their looks
        self._latencies: list[str] = []  # in the order of their colours
        self._arm, self._posed_at = Arm(), -np.inf
        draw_shapes(self._stream, self._arm.shapes())
        super().__init__(node)
        self._arrange()

    def hearer(self, topic: str, kind: str) -> Callable[[Any], None] | None:
        """How messages of a topic are drawn; None for those that nobody would look at."""
        if kind == "sensor_msgs/msg/Image":
            self._cameras.append(topic)
            self._arrange()
        draw: dict[str, Callable[[str, Any], None]] = {
            "sensor_msgs/msg/Image": self._image,
            "sensor_msgs/msg/JointState": self._joint_state,
            "trajectory_msgs/msg/JointTrajectory": self._trajectory,
            "diagnostic_msgs/msg/DiagnosticStatus": self._status,
            "std_msgs/msg/String": lambda topic, m: self._say(topic, m.data, again=REPEATED),
        }
        if kind not in draw:
            return None

        def hear(message: Any) -> None:
            self._stream.set_time("time", duration=time.monotonic() - self._began)
            draw[kind](topic, message)

        return hear

    def close(self) -> None:
        """Finish the recording."""
        super().close()
        self._stream.flush()
        self._stream.disconnect()
        if self._save is not None:
            os.replace(self._save.with_name(f"{self._save.name}.partial"), self._save)

    def _say(self, who: str, words: str, level: rr.TextLogLevel = rr.TextLogLevel.INFO, again: float = np.inf) -> None:
        """What somebody says, unless it is what they said last, less than `again` seconds ago."""
        words, now = messages.cut(words, 300), time.monotonic()
        before, at = self._said.get(who, ("", -np.inf))
        self._said[who] = (words, now)
        if words != before or now - at > again:
            self._stream.log("words", rr.TextLog(f"{who}: {words}", level=level))

    def _image(self, topic: str, message: Any) -> None:
        try:
            pixels = messages.image_from(message)
        except ValueError as error:
            return self._say(topic, str(error), rr.TextLogLevel.WARN)
        if pixels.shape[0] * pixels.shape[1] <= SMALL:
            blob, kind = encoded(pixels, "PNG", compress_level=1), "image/png"
        else:
            blob, kind = encoded(pixels, "JPEG", quality=90), "image/jpeg"
        return self._stream.log(f"camera{topic}", rr.EncodedImage(contents=blob, media_type=kind))

    def _joint_state(self, topic: str, message: Any) -> None:
        self._joints(topic, message.name, message.position)
        now = time.monotonic()
        if "command" not in topic and now >= self._posed_at + POSE_PERIOD:
            posture = _posture(dict(zip(message.name, message.position, strict=False)))
            if posture is not None:
                self._posed_at = now
                draw_poses(self._stream, self._arm.poses(*posture))

    def _trajectory(self, topic: str, message: Any) -> None:
        if message.points:
            self._joints(topic, message.joint_names, message.points[0].positions)

    def _joints(self, topic: str, names: list[str], positions: Any) -> None:
        """A curve per joint in the colour of its place; what is commanded is drawn thinner than what is measured."""
        commanded = "command" in topic
        for place, (name, position) in enumerate(zip(names, positions, strict=False)):
            group = "gripper" if "finger" in name else "joints"
            path = f"{group}/{'commanded' if commanded else 'measured'}/{name}"
            label = f"{name}, commanded" if commanded else name
            colour = int(CURVES[place % len(CURVES)])
            self._curve(path, position, label, colour, 0.75 if commanded else 1.75)

    def _status(self, topic: str, message: Any) -> None:
        level = LEVELS[min(int.from_bytes(message.level, "little"), len(LEVELS) - 1)]
        self._say(message.name, message.message, level)
        for pair in message.values:
            if pair.key.endswith(" [ms]") and FIGURE.fullmatch(pair.value):
                self._latency(pair.key.removesuffix(" [ms]"), float(pair.value))

    def _latency(self, name: str, milliseconds: float) -> None:
        """A curve per figure; the percentiles of one quantity have one colour, the higher one darker."""
        quantity, _, percentile = name.rpartition(" ")
        if quantity not in self._latencies:
            self._latencies.append(quantity)
        *rgb, alpha = int(CURVES[self._latencies.index(quantity) % len(CURVES)]).to_bytes(4, "big")
        colour = int.from_bytes([*(each // 2 if percentile == "p99" else each for each in rgb), alpha], "big")
        self._curve(f"latency/{name.replace(' ', '_')}", milliseconds, name, colour)

    def _curve(self, path: str, value: float, name: str, colour: int, width: float = 1.75) -> None:
        """The next point of a curve in a `colour` 0xRRGGBBAA, `width` [px] wide."""
        if path not in self._curves:
            self._curves.add(path)
            self._stream.log(path, rr.SeriesLines(names=name, colors=[colour], widths=[width]), static=True)
        self._stream.log(path, rr.Scalars(value))

    def _arrange(self) -> None:
        """Arm, cameras and words above, curves below."""
        eye = rrb.EyeControls3D(position=EYE, look_target=LOOK_AT, eye_up=(0, 0, 1))
        arm = rrb.Spatial3DView(origin="/world", name="arm", eye_controls=eye)
        views = [rrb.Spatial2DView(origin=f"camera{topic}", name=topic) for topic in self._cameras]
        columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
        words = rrb.TextLogView(origin="/words", name="words and states", columns=columns)
        legend = rrb.PlotLegend(visible=False)
        curves = [
            rrb.TimeSeriesView(origin="/joints", name="joints [rad], commanded thinner", plot_legend=legend),
            rrb.TimeSeriesView(origin="/gripper", name="fingers [m]", plot_legend=legend),
            rrb.TimeSeriesView(origin="/latency", name="latencies [ms]"),
        ]
        above = rrb.Horizontal(arm, *views, words, column_shares=[3, *(3 for _ in views), 4])
        layout = rrb.Vertical(above, rrb.Horizontal(*curves, column_shares=[4, 2, 3]))
        panels = [panel(state="collapsed") for panel in (rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel)]
        self._stream.send_blueprint(rrb.Blueprint(layout, *panels))


def _posture(positions: dict[str, float]) -> tuple[Array, float] | None:
    """Joints (7,) [rad] and opening of the gripper [m] among named positions; None where the arm is not there."""
    arm = {int(found[1]): position for name, position in positions.items() if (found := ARM.fullmatch(name))}
    if len(arm) != 7 or not np.isfinite([*arm.values()]).all():
        return None
    fingers = [position for name, position in positions.items() if "finger" in name and np.isfinite(position)]
    return np.array([arm[number] for number in range(1, 8)]), float(sum(fingers))


def main() -> None:
    """Draw until interrupted."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.view", description=__doc__.splitlines()[0])
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a recording instead of opening the viewer")
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    options = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is rendered here
    with plain_errors(), ros(Network.named(options.network)) as stopped:
        import rclpy

        node = rclpy.create_node("vla_view")
        view = View(node, options.save)
        spin(node, stopped)
        view.close()
        node.destroy_node()


if __name__ == "__main__":
    main()
