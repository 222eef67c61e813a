"""Comparison of a LeRobot dataset with the spec of a task, which collects all differences.

Shapes: N steps, D action components.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from vla.data.formats.lerobot_dataset import LeRobotDataset
from vla.data.formats.lerobot_layout import RATE_TOLERANCE
from vla.spec import Array, Spec

# Largest share of a component's actions beyond its bounds, and tolerance relative to its range. A larger share means
# other units. Bounds from quantiles exclude 2 % of the actions.
OUTSIDE, ROUNDING = 0.02, 1e-3
LONGEST = 200  # characters of a dataset text in a message

Places = Mapping[str, tuple[str, int]]  # component → feature and index


def mismatches(dataset: LeRobotDataset, state: Places, action: Places, spec: Spec, every: int) -> Iterator[str]:
    """Yield the differences between the spec and the metadata of a dataset of which every `every`-th frame is kept."""
    if abs(dataset.info.fps / every - spec.control_hz) > RATE_TOLERANCE * spec.control_hz:
        kept = f" and expert.every={every}" if every > 1 else ""
        yield f"a rate of {dataset.info.fps:g} Hz{kept}, the task has {spec.control_hz:g} Hz"
    if missing := [camera for camera in spec.cameras if camera not in dataset.images]:
        yield f"no images of {' and '.join(missing)}, it has {_shortened(dataset.images) or 'none at all'}"
    derived = spec.robot.velocities if spec.robot else ()
    for what, there, ours in (
        ("state", state, [name for name in spec.state if name not in derived]),
        ("action", action, [*spec.action]),
    ):
        if any(name not in there for name in ours):
            yield f"{what} of {len(there)} numbers ({_shortened(there)}), the task has {len(ours)} ({_shortened(ours)})"


def out_of_bounds(actions: Array, spec: Spec) -> Iterator[str]:
    """Yield the components of which more than a few of the (N, D) actions exceed the bounds of the spec."""
    for index, (name, low, high) in enumerate(zip(spec.action, spec.low, spec.high, strict=True)):
        values, slack = actions[:, index], ROUNDING * (high - low)
        if (beyond := ((values < low - slack) | (values > high + slack)).mean()) > OUTSIDE:
            unit = "" if spec.units[index] == "1" else f" {spec.units[index]}"
            yield (
                f"{name} in action from {values.min():.3g} to {values.max():.3g}, the task has {low:g} to "
                f"{high:g}{unit}, beyond which are {beyond:.0%} (other units, or absolute?)"
            )


def _shortened(names: Iterable[str]) -> str:
    text = ", ".join(names)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
