"""Recordings of episodes for the Rerun viewer: scene, cameras, curves, token probabilities, instruction and draws."""

from __future__ import annotations

import os
import subprocess
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
import rerun_cli

from vla.data.image_codec import encode
from vla.io.errors import UserError, counted
from vla.io.files import atomic_path
from vla.io.types import Natural, Point
from vla.rollouts.moving_picture import save_moving_picture
from vla.rollouts.results import recording_name
from vla.spec import Array, Environment, Episode, HasScene, Observation, Shape, Spec

# N steps, S series of a plot, D action components, K bins, V vertices, F faces

VIEWER = str(Path(rerun_cli.__file__).with_name("rerun"))  # the binary: killing its wrapper script would orphan it
CURVES = np.array([0xE5574CFF, 0x5ABE64FF, 0x508CF0FF, 0xF0AA3CFF, 0xB46EE6FF, 0x3CC8C8FF, 0xDCDCDCFF], np.uint32)
EVENTS = "events"  # entity of the log
TOKENS = (56, 84)  # height and width of the image of token probabilities [px]


class RerunRecorder:
    """Recorder of one .rrd file per episode, with the timelines "step" and "time" [s].

    It contains the scene if the environment is `HasScene`, and a log if it has `events`.
    """

    def __init__(self, folder: str | os.PathLike[str], pictures: Natural) -> None:
        """Create the folder of the recordings, in which files are named by `recording_name`.

        The first `pictures` episodes of each outcome also get a moving picture.
        """
        self._folder, self._pictures = Path(folder), pictures
        self._folder.mkdir(parents=True, exist_ok=True)
        self._picture_counts = Counter[str]()  # outcome → number of moving pictures

    def start(self, environment: Environment) -> None:
        """Begin an episode; an unfinished one is discarded."""
        self._spec = environment.spec
        self._world = environment if isinstance(environment, HasScene) else None
        self._environment = environment
        self._steps, self._poses = 0, list[dict[str, Array]]()
        self._probabilities: dict[int, Array] = {}

    def step(self, observation: Observation, action: Array, info: Mapping[str, Any]) -> None:
        """Buffer what is not in `Episode`; writing whole columns in `end` is much faster than single steps."""
        if "probabilities" in info:
            self._probabilities[self._steps] = np.array(info["probabilities"], dtype=np.float32)
        self._steps += 1
        self._pose()

    def end(self, episode: Episode) -> None:
        """Write the files of the episode atomically; raise an OSError if they cannot be written."""
        self._pose()
        name, spec = recording_name(episode.seed, episode.outcome), self._spec
        # Random part: the viewer merges recordings of the same id, and policies share seeds.
        stream = rr.RecordingStream("vla", recording_id=f"{name}-{os.urandom(3).hex()}")
        content = rr.binary_stream(stream)  # Rerun's own file sink can block for ever on a full disk
        viewpoint = self._world.viewpoint if self._world else None
        events = getattr(self._environment, "events", ())
        _send_blueprint(stream, _blueprint(spec, bool(self._probabilities), bool(events), viewpoint))
        writer = _Writer(stream, spec)
        writer.facts(episode)
        writer.events(events)
        if self._world:
            draw_shapes(stream, self._world.shapes())
            writer.poses(self._poses)
        writer.cameras(episode.observations)
        writer.curves(episode)
        if self._probabilities:
            writer.tokens(np.array([*self._probabilities]), np.stack([*self._probabilities.values()]))
        recording = content.read() or b""
        stream.disconnect()
        del writer, stream
        rerun_bindings.flush_and_cleanup_orphaned_recordings()  # else its threads and memory leak
        with atomic_path(self._folder / f"{name}.rrd") as draft:
            draft.write_bytes(recording)
        self._picture_counts[episode.outcome] += 1
        if self._picture_counts[episode.outcome] <= self._pictures:
            save_moving_picture(episode, self._folder / f"{name}.webp")

    def _pose(self) -> None:
        if self._world is not None:
            poses = self._world.poses()
            self._poses.append({body: np.array(pose, dtype=np.float32) for body, pose in poses.items()})


class _Writer:
    """Writer of the parts of one episode into a recording."""

    def __init__(self, stream: rr.RecordingStream, spec: Spec) -> None:
        self._stream, self._spec = stream, spec

    def facts(self, episode: Episode) -> None:
        """Write name, properties, draws, and the instruction, or each one from the step at which it was given."""
        steps = len(episode.observations)
        self._stream.send_recording_name(f"{episode.outcome}: {episode.instruction}")
        self._stream.send_property("episode", rr.AnyValues(outcome=episode.outcome, seed=episode.seed, steps=steps))
        end = f"{'✔' if episode.success else '✘'} **{episode.outcome}** after {steps} steps, seed {episode.seed}"
        draws = "\n".join(f"- **{axis}** {_format_draw(draw)}" for axis, draw in episode.draws.items())
        instructions = [observation.instruction for observation in episode.observations]
        starts = [step for step in range(steps) if step == 0 or instructions[step] != instructions[step - 1]]
        texts = [f"### {instructions[step]}\n\n{end}" for step in starts]
        columns = rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(texts))
        self._columns("instruction", np.array(starts), columns)
        self._static("draws", rr.TextDocument(draws, media_type="text/markdown"))

    def events(self, events: Sequence[tuple[int, str]]) -> None:
        """Write events that the agent did not cause, at the last step before them or the first one that shows them."""
        if events:
            steps, texts = zip(*events, strict=True)
            self._columns(EVENTS, np.array(steps), rr.TextLog.columns(text=texts))

    def poses(self, poses: Sequence[Mapping[str, Array]]) -> None:
        """Write body poses at the steps where they change: for many bodies, never."""
        for body in poses[0]:
            track = np.stack([pose[body] for pose in poses])  # (N + 1, 7)
            steps = np.flatnonzero(np.append(True, (track[1:] != track[:-1]).any(axis=1)))
            columns = rr.Transform3D.columns(translation=track[steps, :3], quaternion=_xyzw(track[steps, 3:]))
            self._columns(_path("world", body), steps, columns)

    def cameras(self, observations: Sequence[Observation]) -> None:
        """Write colour as JPEG; depth [mm] as it is, which Rerun compresses faster and better than PNG would."""
        steps = np.arange(len(observations))
        for camera in observations[0].rgb:
            blobs = [encode(observation.rgb[camera], "jpeg", quality=90) for observation in observations]
            columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
            self._columns(_path("camera", camera, "rgb"), steps, columns)
        for camera in observations[0].depth:
            depth = np.stack([observation.depth[camera] for observation in observations])
            sample = depth[::8]
            shades = np.percentile(sample[sample > 0], (1, 90)) if sample.any() else (0.0, 1.0)
            self._shades(_path("camera", camera, "depth"), steps, depth, "turbo", shades, meter=1000.0)

    def curves(self, episode: Episode) -> None:
        """Write state and executed action by unit, and the clean action if it differs."""
        spec, state = self._spec, np.stack([observation.state for observation in episode.observations])
        for unit, indices in _by_unit(spec.state_units).items():
            self._series(_path("state", unit), state[:, indices], [spec.state[index] for index in indices])
        for unit, indices in _by_unit(spec.units).items():
            names = [spec.action[index] for index in indices]
            self._series(_path("action", unit, "executed"), episode.executed[:, indices], names)
            if not np.array_equal(episode.actions, episode.executed):
                names = [f"{name}, clean" for name in names]
                self._series(_path("action", unit, "clean"), episode.actions[:, indices], names, width=0.75)

    def tokens(self, steps: Array, probabilities: Array) -> None:
        """Write the probabilities (N, D, K) of steps (N,) as images: a row per component, scaled by its maximum."""
        components, bins = probabilities.shape[1:]
        row = max(TOKENS[0] // components, 1)  # height [px]
        edges = np.arange(TOKENS[1]) * bins // TOKENS[1]  # bin of each column
        # The square root makes small probabilities visible.
        strength = np.maximum.reduceat(np.sqrt(probabilities / probabilities.max(axis=2, keepdims=True)), edges, axis=2)
        pixels = np.round(strength * 255).astype(np.uint8).repeat(row, axis=1)
        if row > 1:
            pixels[:, ::row] = 0  # a line between rows
        self._shades("tokens", steps, pixels, "inferno", (0.0, 255.0))
        places = [(-11.0, (index + 0.5) * row) for index in range(components)]
        self._static("tokens/names", rr.Points2D(places, labels=self._spec.action, radii=0.0, show_labels=True))

    def _shades(self, path: str, steps: Array, pixels: Array, colours: Any, ends: Any, **fields: float) -> None:
        """Write integer images (N, H, W) in a colour map that ranges over the two values `ends`.

        They are logged as depth images, the only kind for which Rerun has colour maps.
        """
        height, width = pixels.shape[1:]
        kind = {1: "U8", 2: "U16"}[pixels.itemsize]
        image = rr.components.ImageFormat(width=width, height=height, channel_datatype=kind)
        self._static(path, rr.DepthImage.from_fields(colormap=colours, depth_range=ends, **fields))
        buffers = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        self._columns(path, steps, rr.DepthImage.columns(buffer=buffers, format=[image] * len(pixels)))

    def _series(self, path: str, values: Array, names: Sequence[str], width: float = 1.75) -> None:
        """Write a plot; values (N, S), S names, width of the curves [px]."""
        count = len(names)
        self._static(path, rr.SeriesLines(names=names, colors=np.resize(CURVES, count), widths=[width] * count))
        columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition([count] * len(values))
        self._columns(path, np.arange(len(values)), columns)

    def _static(self, path: str, *parts: Any) -> None:
        self._stream.log(path, *parts, static=True)

    def _columns(self, path: str, steps: Array, columns: Iterable[Any]) -> None:
        seconds = rr.TimeColumn("time", duration=steps / self._spec.control_hz)
        self._stream.send_columns(path, [rr.TimeColumn("step", sequence=steps), seconds], columns)


def draw_shapes(stream: rr.RecordingStream, shapes: Iterable[Shape]) -> None:
    """Log the geometry of every body, in its own frame."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for shape in shapes:
        place = rr.Transform3D(translation=shape.position, quaternion=_xyzw(shape.quaternion))
        stream.log(_path("world", shape.body, shape.name), place, _solid(shape), static=True)


def _by_unit(units: Sequence[str]) -> dict[str, list[int]]:
    """Return unit → indices of its components."""
    return {unit: [index for index, other in enumerate(units) if other == unit] for unit in dict.fromkeys(units)}


def _format_draw(draw: Any) -> str:
    """Format a draw, which is plain data, for people: floats with three digits."""
    if isinstance(draw, Mapping):
        return ", ".join(f"{name} {_format_draw(value)}" for name, value in draw.items())
    if isinstance(draw, (list, tuple)):
        return " ".join(map(_format_draw, draw))
    return f"{draw:.3g}" if isinstance(draw, float) else str(draw)


def _path(*parts: str) -> str:
    """Return an entity path; a slash within a name would create a level."""
    return "/".join(part.replace("/", ".") for part in parts)


def _xyzw(wxyz: Array) -> Any:
    return np.asarray(wxyz)[..., [1, 2, 3, 0]]


def _solid(shape: Shape) -> Any:
    colour, (radius, half_length) = np.round(255 * np.clip(shape.rgba, 0, 1)).astype(np.uint8), shape.size[:2]
    if shape.kind == "mesh":
        vertices, faces = np.asarray(shape.vertices), np.asarray(shape.faces)
        normals = _normals(vertices, faces)
        return rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=faces, vertex_normals=normals, albedo_factor=colour
        )
    if shape.kind == "box":
        return rr.Boxes3D(half_sizes=[shape.size], colors=[colour], fill_mode="solid")
    if shape.kind == "sphere":
        return rr.Ellipsoids3D(radii=[radius], colors=[colour], fill_mode="solid")
    size: dict[str, Any] = {"lengths": [2 * half_length], "radii": [radius], "colors": [colour], "fill_mode": "solid"}
    if shape.kind == "cylinder":
        return rr.Cylinders3D(**size)
    return rr.Capsules3D(translations=[[0, 0, -half_length]], **size)  # Rerun's capsule begins at the origin


def _normals(vertices: Array, faces: Array) -> Array:
    """Return (V, 3) unit normals: the area-weighted mean of the normals of adjacent faces."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))  # (F, 3) each
    normals = np.zeros(vertices.shape)
    np.add.at(normals, faces.reshape(-1), np.cross(second - first, third - first).repeat(3, axis=0))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _blueprint(spec: Spec, tokens: bool, events: bool, viewpoint: tuple[Point, Point] | None) -> rrb.Blueprint:
    """Lay out the scene, if there is one, on the left, texts and cameras on the right, curves and tokens below."""
    texts: list[Any] = [rrb.TextDocumentView(origin=f"/{name}", name=name) for name in ("instruction", "draws")]
    if events:
        texts.insert(1, rrb.TextLogView(origin=f"/{EVENTS}", name=EVENTS))
    images = [(name, kind) for kind, names in (("rgb", spec.cameras), ("depth", spec.depth)) for name in names]
    views = [rrb.Spatial2DView(origin=_path("camera", name, kind), name=f"{name} {kind}") for name, kind in images]
    states = _curves("state", spec.state_units)
    plots: list[Any] = _curves("action", spec.units)
    if tokens:
        bounds = rrb.VisualBounds2D(x_range=(-22, TOKENS[1] + 1), y_range=(-2, TOKENS[0] + 2))
        plots.append(rrb.Spatial2DView(origin="/tokens", name="token probabilities", visual_bounds=bounds))
    top: Any = rrb.Vertical(rrb.Horizontal(*texts), rrb.Grid(*views, grid_columns=len(spec.cameras)), row_shares=[1, 3])
    if viewpoint is not None:
        controls = rrb.EyeControls3D(position=viewpoint[0], look_target=viewpoint[1], eye_up=(0, 0, 1))
        scene = rrb.Spatial3DView(origin="/world", name="scene", eye_controls=controls, line_grid=False)
        top = rrb.Horizontal(scene, top, column_shares=[5, 4])
    return rrb.Blueprint(
        rrb.Vertical(top, rrb.Horizontal(rrb.Tabs(*states), *plots), row_shares=[5, 3]),
        rrb.TimePanel(state="collapsed", timeline="step", fps=spec.control_hz),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _send_blueprint(stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
    """Do as `stream.send_blueprint(blueprint, make_active=False)`, which never frees the stream of the blueprint."""
    native = rerun_bindings.new_blueprint("vla", make_default=False, make_thread_default=False)
    layout_stream = rr.RecordingStream._from_native(native)
    layout_stream.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(layout_stream)
    rerun_bindings.send_blueprint(layout_stream.memory_recording().storage, False, True, recording=stream.to_native())
    layout_stream.disconnect()


def _curves(kind: str, units: Sequence[str]) -> list[rrb.TimeSeriesView]:
    """Return one view per unit."""
    return [rrb.TimeSeriesView(origin=_path(kind, unit), name=f"{kind} [{unit}]") for unit in _by_unit(units)]


def merge(files: Sequence[Path], target: Path) -> None:
    """Merge recordings into one file, in which the viewer lists them by name.

    Raises a UserError if a file is no recording.
    """
    with atomic_path(target) as draft:
        command = [VIEWER, "rrd", "merge", *map(str, files), "-o", str(draft)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            reason = result.stderr[-500:].strip()
            raise UserError(f"rerun could not merge {counted(len(files), 'recording')} into {target}: {reason}")
