"""Import of LeRobot datasets as demonstrations.

Shapes: N steps, P state components, D action components, H by W pixels.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow.compute as pc
from annotated_types import MinLen, Predicate

from vla.data.episodes import EpisodeStore, observations_of
from vla.data.formats import lerobot_layout as layout
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.imported_demonstrations import ImportedDemonstrations, Recording, action_bounds
from vla.data.formats.lerobot_compatibility import mismatches, out_of_bounds
from vla.data.formats.lerobot_dataset import LeRobotDataset
from vla.data.formats.lerobot_episodes import Part
from vla.data.formats.lerobot_tables import MEND
from vla.io.errors import UserError
from vla.io.images import describe_resize
from vla.io.types import Count, Text, unique
from vla.spec import Array, Episode, Spec

Keys = Annotated[list[Text], MinLen(1), Predicate(unique)]

log = logging.getLogger(__name__)


class LeRobotDemonstrations(ImportedDemonstrations):
    """Episodes of a LeRobot dataset, version 3.0, that has the cameras, state, action and rate of the task.

    Images are videos, or PNG, JPEG or WebP in tables or files; those of another size are cropped at the centre
    to the aspect ratio of the task, and resized. Actions beyond the bounds of the task are clipped. Every episode is a
    success. An episode in which the task changes becomes several episodes, one per instruction: what is done after a
    change is no answer to the instruction before it, so neither a chunk of actions nor a history may cross it. Missing
    features are filled in: depth by 0 (no return), `velocities` of the robot by differences of its joint positions,
    `executed` by the actions to imitate. The draws of the episode list them, and its number and first step in the
    dataset.

    Args:
        folder: of the dataset.
        images: camera → key of its images; None: `observation.images.CAMERA`.
        state, action: keys of the features that hold the components, which are found by name.
        every: keep every n-th frame with the last of n actions, which suits absolute actions only.
        spec: of the task.

    Raises:
        UserError: the dataset is missing or damaged, or differs from the task; the message lists all differences.
    """

    def __init__(
        self,
        folder: Path | str | None,
        images: dict[str, Text] | None,
        state: Keys,
        action: Keys,
        every: Count,
        *,
        spec: Spec,
    ) -> None:
        self.spec, self._every = spec.without_truth, every
        self._dataset = dataset = _opened(folder, images)
        features = dataset.info.features
        known = {key: layout.Feature(**feature) for key, feature in _exported(spec).items()}
        extra = [layout.RATES] if features.get(layout.RATES) and features[layout.RATES].components else []
        self._state = dataset.components(state, [spec.state[index] for index in spec.pose])
        self._action = dataset.components(action, spec.action)
        for name, place in dataset.components(extra).items():
            self._state.setdefault(name, place)
        self._low, self._high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
        self._require_fit(action)
        for camera in spec.cameras:
            key = dataset.images[camera]
            spec.require_cut(camera, features[key].image_size, f"{key} of {dataset.folder}")
        self._has_depth = all(features.get(key) == known[key] for key in map(layout.depth_key, spec.depth))
        self._has_executed = features.get(layout.EXECUTED) == known[layout.EXECUTED]
        self._lacks = [] if self._has_depth else ["depth"]
        self._lacks += [] if self._has_executed else [layout.EXECUTED]
        self._lacks += [] if all(name in self._state for name in spec.state) else [layout.RATES]
        executed = [layout.EXECUTED] if self._has_executed else []
        depth = [layout.depth_key(camera) for camera in spec.depth if self._has_depth]
        dataset.open(spec.cameras, list(dict.fromkeys([*state, *action, *extra, *executed])), depth)

    @classmethod
    def recording(
        cls, folder: Path | str | None, images: dict[str, Text] | None, state: Keys, action: Keys, every: Count
    ) -> Recording:
        """Describe a dataset, see `ImportedDemonstrations.recording`."""
        dataset = _opened(folder, images)
        states, actions = dataset.components(state), dataset.components(action)
        values = dataset.read(action)
        return Recording(
            cameras=tuple(dataset.images),
            control_hz=dataset.info.fps / every,
            state=tuple(states),
            action=tuple(actions),
            bounds={name: action_bounds(values[key][:, at]) for name, (key, at) in actions.items()},
            episodes=len(dataset.parts),
        )

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._dataset.parts)

    def episode(self, number: int) -> Episode:
        """Return one episode, with its images.

        Raises:
            UserError: images are damaged.
        """
        spec, dataset, part = self.spec, self._dataset, self._dataset.parts[number]
        first = np.arange(part.steps.start, part.steps.stop, self._every)
        last = np.minimum(first + self._every - 1, part.steps.stop - 1)  # the target at the end of the period
        actions = np.clip(self._columns(spec.action, self._action, part)[last], self._low, self._high)
        executed = dataset.numbers(layout.EXECUTED, part)[last] if self._has_executed else actions
        images = {
            f"rgb_{camera}": dataset.frames(part, camera, spec.image_size, self._every) for camera in spec.cameras
        }
        images |= {f"depth_{camera}": self._depth(part, camera)[:: self._every] for camera in spec.depth}
        observations = observations_of(spec, {**images, "state": self._states(part)[first]}, part.instruction)
        draws = {"recorded": {"episode": part.episode, "first_step": part.steps.start, "lacks": self._lacks}}
        what = (number, "recorded", part.instruction, "success", frozenset[str](), draws)
        return Episode(*what, observations, actions, executed)

    def _require_fit(self, keys: Keys) -> None:
        """Raise a UserError unless metadata and action range, from the features `keys`, match the task."""
        dataset, spec = self._dataset, self.spec
        found = [*mismatches(dataset, self._state, self._action, spec, self._every)]
        if all(name in self._action for name in spec.action):
            values = dataset.read(keys)
            places = [self._action[name] for name in spec.action]
            actions = np.stack([values[key][:, at] for key, at in places], axis=1)
            found += out_of_bounds(actions, spec)
            self._beyond = float(((actions < self._low) | (actions > self._high)).mean())
        if found:
            raise UserError(f"{dataset.folder} does not match the task: {'; '.join(found)}")

    def _states(self, part: Part) -> Array:
        """Return (N, P) float32; joint velocities are differences of positions if the dataset has none."""
        spec = self.spec
        state = self._columns([name for name in spec.state if name in self._state], self._state, part)
        if state.shape[1] == len(spec.state) or spec.robot is None:
            return state
        joints = self._columns(spec.robot.joints, self._state, part)
        rates = np.diff(joints, axis=0, prepend=joints[:1]) * np.float32(self._dataset.info.fps)
        known = dict(zip(spec.robot.velocities, rates.T, strict=True))
        found = dict(zip((name for name in spec.state if name in self._state), state.T, strict=True))
        return np.stack([{**known, **found}[name] for name in spec.state], axis=1)

    def _columns(self, names: Iterable[str], places: Mapping[str, tuple[str, int]], part: Part) -> Array:
        """Return components by name, (N, …) float32, of the whole episode of a part."""
        found = [places[name] for name in names]
        return np.stack([self._dataset.numbers(key, part)[:, at] for key, at in found], axis=1)

    def _depth(self, part: Part, camera: str) -> Array:
        """Return the steps of a part, (N, H, W) uint16 [mm]."""
        shape = (part.steps.stop - part.steps.start, *self.spec.image_size)
        if not self._has_depth:
            return np.zeros(shape, np.uint16)
        column = self._dataset.column(part, layout.depth_key(camera), tables.pixels)
        values = np.asarray(pc.list_flatten(pc.list_flatten(column)).combine_chunks())
        regular = tables.lists_have(column, *self.spec.image_size) and len(values) == np.prod(shape)
        if values.dtype != np.uint16 or not regular:
            raise UserError(
                f"{self._dataset.folder} has {layout.depth_key(camera)} of another size in episode {part.episode}: "
                f"{MEND}"
            )
        return values.reshape(shape)

    def fill(self, store: EpisodeStore, episodes: int) -> int:
        """Append episodes, and log what an import changes: images, episodes of several tasks, actions beyond bounds."""
        for camera in self.spec.cameras:
            shape = self._dataset.info.features[self._dataset.images[camera]].image_size
            if resizing := describe_resize(shape, self.spec.image_size, "centre"):
                log.info("camera %s: %s", camera, resizing)
        whole = len({part.episode for part in self._dataset.parts})
        if whole < len(self):
            log.info(
                "%d episodes become %d, one for each instruction in turn: the task changes within some",
                whole,
                len(self),
            )
        if self._beyond:
            log.info("%.2g %% of the actions are clipped to the bounds of the task", 100 * self._beyond)
        return super().fill(store, episodes)


def _opened(folder: Path | str | None, images: dict[str, Text] | None) -> LeRobotDataset:
    if folder is None:
        raise UserError("expert=lerobot needs a dataset: name its folder with expert=lerobot expert.folder=DIR")
    return LeRobotDataset(Path(folder), images)


def _exported(spec: Spec) -> dict[str, dict[str, Any]]:
    """Return the non-image features of an export for `spec`, with shapes as tuples, as `Info` reads them."""
    features = layout.features(spec, depth=True)
    return {
        key: {**feature, "shape": tuple(feature["shape"])} for key, feature in features.items() if "info" not in feature
    }
