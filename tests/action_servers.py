"""Controllers that listen to actions, as the real ones answer: ros2_control's and Franka's gripper."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future

from vla.spec import Array


class Controller:
    """An action server whose goals a test ends; a new goal aborts the one before."""

    def __init__(self, node: Any, kind: Any, name: str) -> None:
        self.goals: list[Any] = []
        self.ended: list[str] = []  # how goals ended, in this order
        self.accepts, self.takes = True, 0.0  # goals, after so long [s]
        self._kind = kind
        self._running: tuple[Any, Future] | None = None
        self.server = ActionServer(
            *(node, kind, name, self._execute),
            goal_callback=self._on_goal,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
        )

    @property
    def running(self) -> bool:
        """Whether a goal is executed."""
        return self._running is not None

    @property
    def cancelled(self) -> bool:
        """Whether the client has cancelled the goal that is executed."""
        return self._running is not None and bool(self._running[0].is_cancel_requested)

    def _on_goal(self, goal: Any) -> GoalResponse:
        time.sleep(self.takes)
        return GoalResponse.ACCEPT if self.accepts else GoalResponse.REJECT

    async def _execute(self, handle: Any) -> Any:
        if self._running is not None:
            self.end("abort", **self.replaced)
        done = Future()
        self._running = handle, done
        self.goals.append(handle.request)
        self.begin(handle.request)
        how, result = await done
        getattr(handle, how)()
        self.ended.append(how)
        return result

    replaced: ClassVar[dict[str, Any]] = {}  # what the result of a replaced goal says

    def begin(self, goal: Any) -> None:
        """Begin to execute a goal."""

    def end(self, how: str, **result: Any) -> None:
        """End the goal that is executed: succeed, abort, or as a cancelled one."""
        assert self._running is not None
        (_, done), self._running = self._running, None
        done.set_result((how, self._kind.Result(**result)))

    def obey(self) -> None:
        """End a goal that the client has cancelled."""
        if self.cancelled:
            self.end("canceled")


class TrajectoryController(Controller):
    """Plays the joint_trajectory_controller: `follow` moves the arm."""

    replaced: ClassVar[dict[str, Any]] = {
        "error_code": -1,
        "error_string": "Current goal cancelled due to new incoming action.",
    }

    def begin(self, goal: Any) -> None:
        """Forget the trajectory before."""
        points = goal.trajectory.points
        self._start = time.monotonic()
        self._times = np.array([point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in points])
        self._positions = np.array([point.positions for point in points])

    def follow(self, joints: Array) -> Array:
        """Return where the trajectory is now; without one the arm stays."""
        self.obey()
        if not self.running:
            return joints
        passed = time.monotonic() - self._start
        if passed >= self._times[-1]:
            self.end("succeed")
            return self._positions[-1]
        times, positions = [0.0, *self._times], np.vstack([joints, self._positions])
        place = int(np.searchsorted(times, passed, side="right"))
        if place == 1:  # on the way to the first point
            return joints + (positions[1] - joints) * passed / times[1]
        share = (passed - times[place - 1]) / (times[place] - times[place - 1])
        return positions[place - 1] + share * (positions[place] - positions[place - 1])
