"""Import of LeRobot datasets as demonstrations.

Shapes: N steps, P state components, D action components, H by W pixels.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import MinLen, Predicate

from vla.data.episodes import EpisodeStore
from vla.data.formats import imported_demonstrations as imported
from vla.data.formats import lerobot_layout as layout
from vla.data.formats.lerobot_dataset import LeRobotDataset
from vla.io.errors import UserError
from vla.io.types import Count, Positive, Text, unique
from vla.spec import Array, Episode, Spec

Keys = Annotated[list[Text], MinLen(1), Predicate(unique)]
Places = Mapping[str, tuple[str, int]]  # component → feature and index

# If a larger share of a component's actions is beyond its bounds, units differ: bounds from quantiles exclude 2 %.
MAX_OUTSIDE = 0.02
MAX_NAMES = 200  # characters of names from a dataset in a message

log = logging.getLogger(__name__)


class LeRobotDemonstrations(imported.ImportedDemonstrations):
    """Episodes of a LeRobot dataset, version 3.0, that has the cameras, state, action and rate of the task (UserError:
    the dataset is missing or damaged, or differs from the task; the message lists all differences).

    Images are videos, or PNG, JPEG or WebP in tables or files; those of another size are cropped at the centre
    to the aspect ratio of the task, and resized. Actions beyond the bounds of the task are clipped. Every episode is a
    success. An episode in which the task changes becomes several episodes, one per instruction: neither a chunk of
    actions nor a history may cross the change. Missing features are filled in: depth by 0, `velocities` of
    the robot by differences of its joint positions, `executed` by the actions to imitate. The draws of the episode list
    them, and its number and first step in the dataset.

    Args:
        folder: of the dataset.
        images: camera → key of its images; None: `observation.images.CAMERA` or `observation.CAMERA`.
        state, action: keys of the features that hold the components, which are found by name.
        every: keep every n-th frame with the last of n actions, which suits absolute actions only.
        scale: action component → factor on the dataset's actions, also the executed ones; None: 1.
        control_hz: rate of the frames [Hz]; None: as the dataset says.
        in_order: the components of state and action are those of the task in its order, whatever their names.
        spec: of the task.
    """

    def __init__(
        self,
        folder: Path | str | None,
        images: dict[str, Text] | None,
        state: Keys,
        action: Keys,
        every: Count,
        scale: dict[str, float] | None,
        control_hz: Positive | None,
        in_order: bool,
        *,
        spec: Spec,
    ) -> None:
        self.spec, self._every = spec.without_truth, every
        self._dataset = dataset = _open_dataset(folder, images)
        self._control_hz = (control_hz or dataset.info.fps) / every
        features = dataset.info.features
        pose = [spec.state[index] for index in spec.pose]
        self._state = dataset.components(state, pose, spec.state, in_order=in_order)
        self._action = dataset.components(action, spec.action, in_order=in_order)
        rates = [layout.RATES] if layout.RATES in features and features[layout.RATES].components else []
        self._state |= {name: place for name, place in dataset.components(rates).items() if name not in self._state}
        executed = dataset.components([layout.EXECUTED]) if layout.EXECUTED in features else {}
        has_executed = all(name in executed for name in spec.action)
        self._missing_fields = ["depth"] if spec.depth else []
        self._missing_fields += [] if has_executed else [layout.EXECUTED]
        self._missing_fields += [] if all(name in self._state for name in spec.state) else [layout.RATES]
        differences = [*self._mismatches()]
        if all(name in self._action for name in spec.action):
            keys = [*state, *action, *rates, *([layout.EXECUTED] if has_executed else [])]
            self._numbers = dataset.read(list(dict.fromkeys(keys)))
            factors = _factors(scale, spec.action)
            self._actions = self._columns(spec.action, self._action, slice(None)) * factors
            if has_executed:
                self._executed = self._columns(spec.action, executed, slice(None)) * factors
            differences += imported.out_of_bounds(self._actions, spec, MAX_OUTSIDE)
        if differences:
            raise UserError(f"{dataset.folder} does not match the task: {'; '.join(differences)}")
        for camera in spec.cameras:
            key = dataset.images[camera]
            spec.require_cut(camera, features[key].image_size, f"{key} of {dataset.folder}")
        dataset.require_images(spec.cameras)

    @classmethod
    def recording(
        cls,
        folder: Path | str | None,
        images: dict[str, Text] | None,
        state: Keys,
        action: Keys,
        every: Count,
        scale: dict[str, float] | None,
        control_hz: Positive | None,
        in_order: bool,
    ) -> imported.Recording:
        """Describe a dataset, see `ImportedDemonstrations.recording`."""
        dataset = _open_dataset(folder, images)
        if not dataset.images:
            raise UserError(f"{dataset.folder} has no images, which policies need: record it with a camera")
        states, actions = dataset.components(state), dataset.components(action)
        values, factors = dataset.read(action), _factors(scale, [*actions])
        places = zip(actions.items(), factors, strict=True)
        return imported.Recording(
            cameras=tuple(dataset.images),
            control_hz=(control_hz or dataset.info.fps) / every,
            state=tuple(states),
            action=tuple(actions),
            bounds={name: imported.action_bounds(factor * values[key][:, at]) for (name, (key, at)), factor in places},
            episodes=len(dataset.parts),
        )

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._dataset.parts)

    def episode(self, number: int) -> Episode:
        """Return one episode, with its images; a UserError if these are damaged."""
        spec, dataset, part = self.spec, self._dataset, self._dataset.parts[number]
        images = {
            f"rgb_{camera}": dataset.frames(part, camera, spec.image_size, self._every) for camera in spec.cameras
        }
        origin = {"episode": part.episode, "first_step": part.steps.start, "lacks": self._missing_fields}
        executed = None if layout.EXECUTED in self._missing_fields else self._executed[self._steps(number)[1]]
        instruction, state, actions = self.numbers(number)
        rows = {**images, "state": state}
        return self.recorded_episode(number, instruction, "success", origin, rows, actions, executed)

    def numbers(self, number: int) -> tuple[str, Array, Array]:
        """Return an episode without its images: instruction, state (N, P) and actions (N, D)."""
        part, (first_steps, last_rows) = self._dataset.parts[number], self._steps(number)
        return part.instruction, self._states(part.rows)[first_steps], self._actions[last_rows]

    def _steps(self, number: int) -> tuple[Array, Array]:
        """Return the first step of every period of an episode, and the row of its last, whose action is the target."""
        part = self._dataset.parts[number]
        first_steps = np.arange(part.steps.start, part.steps.stop, self._every)
        return first_steps, part.rows[np.minimum(first_steps + self._every - 1, part.steps.stop - 1)]

    def fill(self, store: EpisodeStore, episodes: int) -> int:
        """Append episodes, and log what an import changes: images, episodes of several tasks, actions beyond bounds."""
        for camera in self.spec.cameras:
            shape = self._dataset.info.features[self._dataset.images[camera]].image_size
            if shape != tuple(self.spec.image_size):
                log.info("images of %s are cropped at the centre and resized to task.image_size", camera)
        recordings = len({part.episode for part in self._dataset.parts})
        if recordings < len(self):
            log.info("episodes: %d become %d, one per instruction: the task changes within some", recordings, len(self))
        imported.log_clipped(self._actions, self.spec)
        return super().fill(store, episodes)

    def _mismatches(self) -> Iterator[str]:
        """Yield the differences between the spec and the metadata of the dataset."""
        dataset, spec = self._dataset, self.spec
        if abs(self._control_hz - spec.control_hz) > layout.RATE_TOLERANCE * spec.control_hz:
            yield f"its rate is {self._control_hz:g} Hz (expert.every={self._every}), the task's {spec.control_hz:g} Hz"
        if missing_cameras := [camera for camera in spec.cameras if camera not in dataset.images]:
            cameras = _name_list(dataset.images) or "no camera at all"
            yield f"expert.images gives no key for {' and '.join(missing_cameras)}, and there are images of {cameras}"
        derived_names = spec.robot.velocities if spec.robot else ()
        for kind, places, names in (
            ("state", self._state, [name for name in spec.state if name not in derived_names]),
            ("action", self._action, [*spec.action]),
        ):
            if any(name not in places for name in names):
                description = f"its {kind} has {len(places)} numbers ({_name_list(places)})"
                advice = ": expert.in_order=true takes them in their order" if len(places) == len(names) else ""
                yield f"{description}, that of the task {len(names)} ({_name_list(names)}){advice}"

    def _states(self, rows: Array) -> Array:
        """Return the state in the rows of an episode, (N, P) float32; unknown velocities are differences."""
        spec, columns = self.spec, dict[str, Array]()
        if layout.RATES in self._missing_fields and spec.robot:
            joints = self._columns(spec.robot.joints, self._state, rows)
            rates = np.diff(joints, axis=0, prepend=joints[:1]) * np.float32(self._control_hz * self._every)
            columns = dict(zip(spec.robot.velocities, rates.T, strict=True))
        names = [name for name in spec.state if name in self._state]
        columns |= dict(zip(names, self._columns(names, self._state, rows).T, strict=True))
        return np.stack([columns[name] for name in spec.state], axis=1)

    def _columns(self, names: Iterable[str], places: Places, rows: Array | slice) -> Array:
        """Return components by name, (N, …) float32, in rows of the dataset."""
        return np.stack([self._numbers[key][rows, index] for key, index in map(places.__getitem__, names)], axis=1)


def _name_list(names: Iterable[str]) -> str:
    text = ", ".join(names)
    return text if len(text) <= MAX_NAMES else f"{text[:MAX_NAMES]}…"


def _open_dataset(folder: Path | str | None, images: dict[str, Text] | None) -> LeRobotDataset:
    if folder is None:
        raise UserError("expert=lerobot needs a dataset: name its folder with expert=lerobot expert.folder=DIR")
    return LeRobotDataset(Path(folder), images)


def _factors(scale: Mapping[str, float] | None, names: Sequence[str]) -> Array:
    """Return the factors of action components, (D,) float32; a UserError if `scale` names others."""
    scale = scale or {}
    if unknown_names := [name for name in scale if name not in names]:
        raise UserError(f"expert.scale names {', '.join(unknown_names)}, the actions are {_name_list(names)}")
    return np.array([scale.get(name, 1.0) for name in names], np.float32)
