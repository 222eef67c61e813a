"""Import of LIBERO's human demonstrations as LeRobot publishes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vla.data.formats.imported_demonstrations import Recording
from vla.data.formats.lerobot_dataset import LeRobotDataset
from vla.data.formats.lerobot_import import Keys, LeRobotDemonstrations, named
from vla.io.errors import UserError
from vla.io.types import Positive, Text
from vla.spec import Array, Spec


class LiberoDemonstrations(LeRobotDemonstrations):
    """Episodes of LeRobot's LIBERO data for task=libero.

    Their components are known by their order, for names are missing or ambiguous; actions are from -1 to 1, and 1
    closes the gripper. A frame is a step of the simulator, at 20 Hz, though the dataset and its videos say 10 Hz.

    Args:
        folder: of the dataset.
        images: camera → key of its images.
        state, action: keys of the features that hold the components, in the order of the task's.
        scale: action component → factor on the dataset's actions.
        control_hz: rate of the steps [Hz].
        spec: of the task.

    Raises:
        UserError: as of `LeRobotDemonstrations`.
    """

    def __init__(
        self,
        folder: Path | str | None,
        images: dict[str, Text],
        state: Keys,
        action: Keys,
        scale: dict[str, float],
        control_hz: Positive,
        *,
        spec: Spec,
    ) -> None:
        factors = np.array([scale.get(name, 1.0) for name in spec.action], np.float32)
        self._opened = partial(_Dataset, action[0], factors, control_hz)
        super().__init__(folder, images, state, action, 1, spec=spec)

    @classmethod
    def recording(cls, **options: Any) -> Recording:
        """Raise a UserError, as these are of a given task."""
        raise UserError("expert=lerobot_libero is for task=libero: choose that task, or expert=lerobot")


class _Dataset(LeRobotDataset):
    control_hz = 0.0  # of an object of its own

    def __init__(
        self, action: str, factors: Array, control_hz: float, folder: Path | str | None, images: Mapping[str, str]
    ) -> None:
        self._action, self._factors, self.control_hz = action, factors, control_hz
        super().__init__(named(folder), images)

    def components(self, keys: Sequence[str], anonymous: Sequence[str] = ()) -> dict[str, tuple[str, int]]:
        found = super().components(keys, anonymous)
        return dict(zip(anonymous, found.values(), strict=True)) if len(found) == len(anonymous) else found

    def read(self, keys: Sequence[str]) -> dict[str, Array]:
        found = super().read(keys)
        if self._action in found and found[self._action].shape[1] == len(self._factors):
            found[self._action] = found[self._action] * self._factors
        return found
