"""See in Rerun what a deployed policy sees and commands.

python -m vla.deploy.view                   opens the viewer
python -m vla.deploy.view --save FILE.rrd   writes a recording until interrupted
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from vla.deploy import messages
from vla.deploy.overhear import Eavesdropper
from vla.deploy.ros import NETWORKS, Network, ros, spin
from vla.record import CURVES

LEVELS = (rr.TextLogLevel.INFO, rr.TextLogLevel.WARN, rr.TextLogLevel.ERROR)  # of a DiagnosticStatus


class View(Eavesdropper):
    """Draws images, joints, commands, words and the agent's status on the timeline "time" [s]; ends with `close`."""

    def __init__(self, node: Any, save: Path | None = None) -> None:
        """Args: the node whose spinning draws; a .rrd file, or None for a viewer that opens."""
        self._stream = rr.RecordingStream("vla_deploy", recording_id=os.urandom(6).hex())
        self._save, self._cameras = save, list[str]()
        if save is None:
            self._stream.spawn()
        else:
            save.parent.mkdir(parents=True, exist_ok=True)
            self._stream.save(save.with_name(f"{save.name}.partial"))
        self._began = time.monotonic()
        super().__init__(node)
        self._arrange()

    def hearer(self, topic: str, kind: str) -> Callable[[Any], None] | None:
        """How messages of a topic are drawn; None for those that nobody would look at."""
        if kind == "sensor_msgs/msg/Image":
            self._cameras.append(topic)
            self._arrange()
        draw: dict[str, Callable[[str, Any], None]] = {
            "sensor_msgs/msg/Image": self._image,
            "sensor_msgs/msg/JointState": lambda topic, m: self._joints(topic, m.name, m.position),
            "trajectory_msgs/msg/JointTrajectory": self._trajectory,
            "diagnostic_msgs/msg/DiagnosticStatus": self._status,
            "std_msgs/msg/String": lambda topic, m: self._say(f"{topic}: {m.data}"),
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

    def _say(self, words: str, level: rr.TextLogLevel = rr.TextLogLevel.INFO) -> None:
        self._stream.log("words", rr.TextLog(words, level=level))

    def _image(self, topic: str, message: Any) -> None:
        try:
            pixels = messages.image_from(message, (message.height, message.width))
        except ValueError as error:
            return self._say(f"{topic}: {error}", rr.TextLogLevel.WARN)
        return self._stream.log(f"camera{topic}", rr.Image(pixels).compress(jpeg_quality=90))

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
            style = rr.SeriesLines(names=label, colors=CURVES[place % len(CURVES)], widths=0.75 if commanded else 1.75)
            self._stream.log(path, rr.Scalars(position), style)

    def _status(self, topic: str, message: Any) -> None:
        level = LEVELS[min(int.from_bytes(message.level, "little"), len(LEVELS) - 1)]
        self._say(f"{message.name}: {message.message}", level)
        for pair in message.values:
            if pair.key.endswith("[ms]"):
                name = pair.key.removesuffix(" [ms]")
                self._stream.log(
                    f"latency/{name.replace(' ', '_')}", rr.Scalars(float(pair.value)), rr.SeriesLines(names=name)
                )

    def _arrange(self) -> None:
        """Cameras and words above, curves below."""
        views = [rrb.Spatial2DView(origin=f"camera{topic}", name=topic) for topic in self._cameras]
        words = rrb.TextLogView(origin="/words", name="words and states")
        legend = rrb.PlotLegend(visible=False)
        curves = [
            rrb.TimeSeriesView(origin="/joints", name="joints [rad], commanded thinner", plot_legend=legend),
            rrb.TimeSeriesView(origin="/gripper", name="fingers [m]", plot_legend=legend),
            rrb.TimeSeriesView(origin="/latency", name="latencies [ms]"),
        ]
        layout = rrb.Vertical(rrb.Horizontal(*views, words), rrb.Horizontal(*curves, column_shares=[2, 1, 1]))
        panels = [panel(state="collapsed") for panel in (rrb.BlueprintPanel, rrb.SelectionPanel, rrb.TimePanel)]
        self._stream.send_blueprint(rrb.Blueprint(layout, *panels))


def main() -> None:
    """Draw until interrupted."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.view", description=__doc__.splitlines()[0])
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a recording instead of opening the viewer")
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    options = parser.parse_args()
    with ros(Network.named(options.network)) as stopped:
        import rclpy

        node = rclpy.create_node("vla_view")
        view = View(node, options.save)
        spin(node, stopped)
        view.close()
        node.destroy_node()


if __name__ == "__main__":
    main()
