"""The goal of stacking two blocks."""

from __future__ import annotations

import numpy as np

from vla.tasks.tabletop.goals.goal import AT_REST, Arrangement, Goal, Referents, Subgoal, WorldState

UP = np.array([0.0, 0.0, 1.0])
SAG = 0.006  # tolerance of a stacked block's height [m]


class Stack(Goal):
    """Put one named block on top of another and let go of it."""

    named, blocks = 2, 3  # with two blocks the lower one would be unambiguous

    def subgoals(self, state: WorldState, referents: Referents) -> list[Subgoal]:
        """Place the upper block centred on top of the lower one."""
        upper, lower = referents.blocks
        top = state.positions[lower] + UP * state.extents[lower, 2]
        destination = top + UP * state.extents[upper, 2]
        free = state.speeds[upper] < AT_REST and not state.touched[upper]
        level = abs(state.positions[upper, 2] - destination[2]) < SAG
        done = bool(free and level and state.away(upper, top) < state.extents[lower, 0])
        return [Subgoal(upper, destination, "place", done, tolerance=0.007)]

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`: towers have two blocks."""
        upper, lower = referents.blocks
        return arrangement.on_block(upper, lower) if arrangement.allows(upper) else None
