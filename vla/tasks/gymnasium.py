"""Any registered gymnasium environment with continuous actions as a `vla.spec.Environment`."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Annotated, Any

import gymnasium
import numpy as np
from annotated_types import MinLen
from gymnasium.error import Error
from gymnasium.spaces import Box

from vla.io.errors import UserError
from vla.io.images import resize
from vla.io.types import Count, ImageSize, Names, Positive, Text
from vla.spec import Array, Numbers, Observation, Spec
from vla.tasks.gl import choose_backend
from vla.tasks.recorded import units_of
from vla.tasks.world import World

log = logging.getLogger(__name__)

OBSERVATION, INFO, RENDER = "observation", "info", "render"
PATHS = (f"{OBSERVATION}.", f"{INFO}.")


class Gymnasium(World):
    """A gymnasium environment, with images, state, truth and success taken from its observation, `info` or rendering.

    A value is named by a dotted path: `observation.pixels.top` is the entry `top` of the entry `pixels` of the
    observation, `info.is_success` an entry of the dictionary `info`, `render` what `render()` returns. `observation`
    names an observation that is an array. An episode ends with its first success, or when the environment ends it.
    """

    def __init__(
        self,
        package: Text,
        id: Text,
        options: Mapping[str, object] | None,
        steps: Count | None,
        control_hz: Positive | None,
        instruction: Text,
        images: Annotated[Mapping[Text, Text], MinLen(1)],
        image_size: ImageSize,
        state: Annotated[Mapping[Text, Names | None], MinLen(1)],
        action: Names | None,
        units: Text | dict[str, Text],
        low: Numbers | float | None,
        high: Numbers | float | None,
        success: Text,
        truth: Mapping[Text, Text] | None,
    ) -> None:
        """Make the environment.

        Args:
            package: installed package that registers the environment when it is imported, and contains its class; one
                that a file names must be trusted.
            id: registered name, such as "gym_pusht/PushT-v0".
            options: further arguments of `gymnasium.make`.
            steps: maximum number of steps of an episode; None: as registered.
            control_hz: rate of actions [Hz]; None: the `render_fps` of the environment.
            instruction: of every episode, or a path that begins with "observation." or "info.".
            images: camera → path of its image, (H, W, 3) uint8 of any size.
            image_size: height and width to which images are resized [px], after a crop at the centre to this aspect
                ratio, as imported demonstrations are.
            state: path of an array → names of its components; None: numbered.
            action: names of the components of an action; None: numbered.
            units: one unit for all components of state and action, or name → unit for some; "1": none, or unknown.
            low, high: bounds to which actions are clipped, one for all components or one per component; None: those of
                the action space.
            success: path of the flag that is true in a successful step.
            truth: name → path of an array, for training and experts only.

        Raises a UserError if the package is not installed or does not contain the environment, an action has no bounds,
        an observation lacks a path or has no numbers there, or arguments do not fit each other.
        """
        super().__init__()
        self._truth, self._images, self._success, self._instruction = truth or {}, images, success, instruction
        self._environment = _make(package, id, options or {}, steps, render=RENDER in images.values())
        self._size, self._state, self.task = (image_size[0], image_size[1]), tuple(state), id
        space = self._environment.action_space
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise UserError(f"{id} has the actions {space}: task=gymnasium takes a Box with one axis")
        try:
            values = self._values(*self._environment.reset(seed=0))
        except Error as error:  # such as a library for drawing that is missing
            raise UserError(f"task.id={id} cannot be played: {error}") from error
        names = list[str]()
        for (path, components), label in zip(state.items(), _labels([*state]), strict=True):
            names += _component_names(path, _numbers(values, path), components, label)
        actions = _component_names("action", space.low, action, "action")
        state_units, action_units = units_of(units, names, actions)
        rate = control_hz or self._environment.metadata.get("render_fps")
        if rate is None:
            raise UserError(f"{id} does not tell its rate: set task.control_hz")
        spec = Spec(
            cameras=tuple(images),
            image_size=self._size,
            state=tuple(names),
            state_units=state_units,
            action=actions,
            units=action_units,
            low=_bound("low", low, space.low),
            high=_bound("high", high, space.high),
            control_hz=float(rate),
            truth=tuple((name, _numbers(values, path).size) for name, path in self._truth.items()),
        )
        self.spec = Spec.from_dict(spec.to_dict(), f"task.id={id}")
        self._observe(values)  # raises if an image is of another shape or type
        if not success.startswith(PATHS):
            raise UserError(f"task.success={success} must be a path that begins with {' or '.join(PATHS)}")
        self._success_reported = False  # whether a step had the flag, or the log has told that none had

    def reset(self, seed: int) -> Observation:
        """Start the episode of `seed`, which seeds the environment."""
        self.done, self.outcome = False, "timeout"
        return self._observe(self._values(*self._environment.reset(seed=seed)))

    def step(self, action: Array) -> Observation:
        """Apply one (D,) action, clipped to the bounds."""
        self._require_running()
        command, dtype = np.clip(action, self.spec.low, self.spec.high), self._environment.action_space.dtype
        command = (np.rint(command) if np.issubdtype(dtype, np.integer) else command).astype(dtype)
        observation, _, terminated, truncated, info = self._environment.step(command)
        values = self._values(observation, info)
        success = _get(values, self._success, None)
        if isinstance(success, Mapping | str) or np.asarray(success).size != 1:  # whose truth is not that of a flag
            raise UserError(f"task.success={self._success} must be a flag, and is of {type(success).__name__}")
        self.outcome = "success" if success else "failure" if terminated else "timeout"
        self.done = bool(success) or terminated or truncated
        self._success_reported |= success is not None
        if self.done and not self._success_reported:
            self._success_reported = True
            log.warning("a whole episode gave no %s, so it counts as failed: is task.success right?", self._success)
        return self._observe(values)

    def close(self) -> None:
        """Close the environment."""
        self._environment.close()

    def _values(self, observation: Any, info: Mapping[str, Any]) -> dict[str, Any]:
        renders = RENDER in self._images.values() and not self._blind
        return {OBSERVATION: observation, INFO: info, **({RENDER: self._environment.render()} if renders else {})}

    def _observe(self, values: Mapping[str, Any]) -> Observation:
        images, instruction = {} if self._blind else self._images, self._instruction
        return Observation(
            rgb={name: _resize(name, _get(values, path), self._size) for name, path in images.items()},
            state=np.concatenate([_numbers(values, path) for path in self._state]),
            instruction=str(_get(values, instruction)) if instruction.startswith(PATHS) else instruction,
            truth={name: _numbers(values, path) for name, path in self._truth.items()},
        )


def _make(package: str, id: str, options: Mapping[str, object], steps: int | None, render: bool) -> Any:
    """Make the environment, whose class must be in the package: a config file is trusted for the package it names."""
    choose_backend()  # before the package imports MuJoCo
    try:
        import_module(package)
    except ImportError as error:
        raise UserError(f"task.package={package} cannot be imported, install it by pip: {error}") from error
    try:
        spec = gymnasium.spec(id) if ":" not in id else None
    except Error as error:
        raise UserError(f"task.id={id} is not registered by {package}: {error}") from error
    entry = spec.entry_point if spec else ""
    module = entry if isinstance(entry, str) else getattr(entry, "__module__", "")
    if spec is None or module.partition(":")[0].partition(".")[0] != package:
        raise UserError(
            f"task.id={id} is no environment of task.package={package}: name the package that contains its class, and "
            "the id without a module"
        )
    if steps is None and spec.max_episode_steps is None:
        raise UserError(f"{id} does not tell how long an episode lasts: set task.steps")
    if render:
        options = {**options, "render_mode": "rgb_array"}
    try:
        return gymnasium.make(spec, max_episode_steps=steps, disable_env_checker=True, **options)
    except Exception as error:  # of any kind: it comes from a constructor of others
        kind = "" if isinstance(error, TypeError | ValueError | Error) else f"{type(error).__name__} "
        raise UserError(f"{id} cannot be made with task.options={dict(options)}: {kind}{error}") from error


def _bound(name: str, setting: Numbers | float | None, defaults: Array) -> tuple[float, ...]:
    """Return the low or high bounds of an action, by default those of its space; a UserError if they do not fit it."""
    if setting is None:
        bound = tuple(float(str(value)) for value in defaults)  # 0.1, not the 0.10000000149 of float32
    else:
        bound = (float(setting),) * len(defaults) if isinstance(setting, int | float) else tuple(setting)
    if len(bound) != len(defaults):
        raise UserError(f"task.{name} has {len(bound)} numbers, an action has {len(defaults)} components")
    if not np.isfinite(bound).all():
        raise UserError(f"the actions have no bounds: set task.{name}, a number, or one per component")
    return bound


def _get(values: Any, path: str, *default: Any) -> Any:
    """Return the value at a dotted path; a UserError if there is none, and no default."""
    value = values
    for name in path.split("."):
        if not isinstance(value, Mapping) or name not in value:
            if default:
                return default[0]
            names = ", ".join(map(str, value)) if isinstance(value, Mapping) else "nothing further"
            raise UserError(f"there is no {path} in what the environment returns: instead of {name} there is {names}")
        value = value[name]
    return value


def _numbers(values: Any, path: str) -> Array:
    """Return the numbers (N,) float32 at a dotted path; a UserError if there is something else."""
    value = _get(values, path)
    try:
        return np.ravel(value).astype(np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f"{path} is no array of numbers, but of {type(value).__name__}: {error}") from error


def _labels(paths: Sequence[str]) -> Sequence[str]:
    """Return the last part of each dotted path, or more of the paths if those are not distinct."""
    for labels in ([path.rpartition(".")[2] for path in paths], [path.partition(".")[2] for path in paths]):
        if len({*labels}) == len(labels):
            return labels
    return paths


def _component_names(path: str, values: Any, names: Names | None, label: str) -> tuple[str, ...]:
    """Return the names of an array's components, by default numbered labels; a UserError if their number differs."""
    size = np.size(values)
    if names is None:
        return tuple(f"{label}_{index}" for index in range(size))
    if len(names) != size:
        raise UserError(f"{path} has {size} components, and {len(names)} names: {', '.join(names)}")
    return tuple(names)


def _resize(camera: str, picture: Any, size: tuple[int, int]) -> Array:
    picture = np.asarray(picture)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise UserError(
            f"task.images.{camera} names no (H, W, 3) image of uint8, but {picture.dtype} of {picture.shape}"
        )
    return resize(picture, size)
