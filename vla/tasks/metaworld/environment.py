"""Meta-World as a `vla.spec.Environment`, under the protocol of LeRobot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Predicate

from vla.io.errors import UserError, suggestion
from vla.io.types import ImageSize, Names, Natural, Share, Text
from vla.spec import Array, Observation, Spec
from vla.tasks.metaworld.package import tasks_of
from vla.tasks.metaworld.scene import CAMERA, TaskScene, parts_of
from vla.tasks.rendering.renderer import RendererFactory
from vla.tasks.world import MultitaskWorld, command_of

CONTROL_HZ = 80.0  # five substeps of 2.5 ms
REACH = 0.01  # largest displacement of the hand per step, along each axis [m]
STATE = ("hand_x", "hand_y", "hand_z", "opening")  # the first four numbers of an observation
MOST_STEPS = 500  # of an episode, after which Meta-World refuses to go on
# Components of the simulator's observation (39,).
OBJECT, GOAL = slice(4, 7), slice(36, 39)


def within(window: Sequence[float]) -> bool:
    """[top, left, bottom, right] with top < bottom and left < right"""
    top, left, bottom, right = window
    return top < bottom and left < right


Window = Annotated[tuple[Share, Share, Share, Share], Predicate(within)]


class MetaWorld(MultitaskWorld):
    """Fifty tasks of a Sawyer arm, one of them per episode: seeds cycle through them.

    An episode ends at the first step that Meta-World counts as a success, or when its steps are used up. The state is
    the hand's position and the opening of the gripper, 0…1; the truth includes the positions of object and goal.
    """

    def __init__(
        self,
        tasks: Literal["mt1", "mt10", "mt25", "mt50"] | Names,
        sentences: Mapping[str, Text],
        tiers: Mapping[str, Names],
        renderer: RendererFactory,
        image_size: ImageSize,
        cameras: Names,
        window: Window | None,
        hand_size: Annotated[float, Gt(0), Le(1)],
        drawn: Annotated[int, Ge(16), Le(4096)] | None,
        shadows: Natural,
        steps: Annotated[int, Ge(1), Le(MOST_STEPS)],
    ) -> None:
        """Check the tasks; scenes are compiled when first played.

        Args:
            tasks: a benchmark of Meta-World, or names of its tasks.
            sentences: task → instruction.
            tiers: difficulty → tasks, for reports.
            renderer: renderer of the images.
            image_size: height and width of every camera's images [px]; equal, unless all images show the `window`.
            cameras: names of cameras, such as "corner2", which is moved and turned as LeRobot does, or "hand", the part
                of "corner2" around a point 75 mm below the hand, in whole pixels of LeRobot's picture.
            window: top, left, bottom and right of LeRobot's picture that "corner2" shows, as shares of its height and
                width; None: all of it.
            hand_size: height and width of the part that "hand" shows, as shares of LeRobot's picture.
            drawn: height and width in which a camera's full picture is rendered before it is cropped to its window and
                averaged down to `image_size` [px]. None: the window is rendered directly in `image_size`.
            shadows: edge of the shadow map [texels]; 0: no shadows.
            steps: largest number of steps of an episode.

        Raises a UserError if a task is unknown or has no sentence, or pictures would be stretched.
        """
        super().__init__()
        all_tasks = self._all_tasks = tasks_of("mt50")  # the truth gives a task by its index here
        self.tasks = tuple(tasks_of(tasks) if isinstance(tasks, str) else tasks)
        task_names = {*self.tasks, *sentences, *(name for names in tiers.values() for name in names)}
        if unknown_tasks := sorted(task_names - {*all_tasks}):
            hint = suggestion(unknown_tasks[0], all_tasks) or f": it has {', '.join(sorted(all_tasks))}"
            raise UserError(f"Meta-World has no task {', '.join(unknown_tasks)}{hint}")
        if missing_tasks := [name for name in self.tasks if name not in sentences]:
            raise UserError(f"task.sentences lacks {', '.join(missing_tasks)}: give every task an instruction")
        squares = [name for name in cameras if name != CAMERA or window is None]
        if squares and image_size[0] != image_size[1]:
            raise UserError(
                f"task.image_size={[*image_size]} would stretch what {', '.join(squares)} shows, which is square: give "
                "height and width the same number of pixels"
            )
        self.spec = Spec(
            cameras=tuple(cameras),
            image_size=(image_size[0], image_size[1]),
            state=STATE,
            state_units=("m", "m", "m", "1"),
            action=("dx", "dy", "dz", "gripper"),
            units=("m", "m", "m", "1"),
            low=(-REACH, -REACH, -REACH, -1.0),
            high=(REACH, REACH, REACH, 1.0),
            control_hz=CONTROL_HZ,
            truth=(("object", 3), ("goal", 3)),
            parts=tuple(parts_of(cameras, window, hand_size)),
        )
        self._sentences, self._steps = sentences, steps
        self._make_scene = partial(TaskScene, spec=self.spec, renderer=renderer, drawn=drawn, shadows=shadows)

    def reset(self, seed: int) -> Observation:
        """Start the episode of `seed`."""
        self.task, self.done, self.outcome, self._steps_taken = self.task_of(seed), False, "timeout", 0
        self._scene = self._scene_of(self.task, partial(self._make_scene, self.task))
        observation = self._scene.reset(seed)
        places = {"object": observation[OBJECT], "goal": observation[GOAL]}
        self.draws = {name: {"place": place[:2].tolist(), "height": float(place[2])} for name, place in places.items()}
        return self._look(observation)

    def step(self, action: Array) -> Observation:
        """Apply one (4,) action, clipped to the spec's bounds, for one control period."""
        self._require_running()
        action = np.clip(action, self.spec.low, self.spec.high)
        observation, solved = self._scene.step(command_of(action, REACH).astype(np.float32))
        self.outcome = "success" if solved else "timeout"
        self._steps_taken += 1
        self.done = solved or self._steps_taken == self._steps
        return self._look(observation)

    def _look(self, observation: Array) -> Observation:
        pictures = () if self._blind else self._scene.pictures()
        self.tool = observation[:3].copy()  # position of the hand
        truth = {
            "object": observation[OBJECT],
            "goal": observation[GOAL],
            "commanded_position": self._scene.simulator.data.mocap_pos[0].copy(),
            "observation": observation,
            "task": np.array([self._all_tasks.index(self.task)]),
        }
        return Observation(
            rgb=dict(zip(self.spec.cameras, pictures, strict=False)),
            state=observation[: len(STATE)].astype(np.float32),
            instruction=self._sentences[self.task],
            truth=truth,
        )
