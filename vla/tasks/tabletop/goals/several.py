"""Several goals: a mixture of which one is drawn per episode, and a chain without a reset in between."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Annotated, TypeVar

import numpy as np
from annotated_types import Ge, Le

from vla.io.errors import UserError
from vla.io.types import Share
from vla.tasks.tabletop.goals.goal import Arrangement, Goal, Referents
from vla.tasks.tabletop.goals.skills import Stay, Wait, absent_colours_needed

T = TypeVar("T")
Link = tuple[Goal, Referents]


class Mixed:
    """A mixture of goals, one drawn per episode; `blocks` and `absent` are the maxima over the goals.

    In a share of the episodes the instruction of the drawn goal names a block that is not on the table, and in another
    share the instruction is empty: the robot must then leave everything in place.
    """

    def __init__(self, goals: Mapping[str, Goal | None], impossible: Share, silent: Share) -> None:
        """Take name → goal, None to omit it, and the shares of episodes with an absent block and with no instruction
        (UserError: no goal remains, or the shares exceed one)."""
        self.goals = _require_goals(goals)
        if impossible + silent > 1:
            raise UserError(f"task.goal.impossible + task.goal.silent must be at most 1, not {impossible + silent:g}")
        self.impossible, self.silent = impossible, silent
        self.blocks = max(goal.blocks for goal in self.goals.values())
        counts = [absent_colours_needed(goal.language) for goal in self.goals.values() if impossible]
        self.absent = max([goal.absent for goal in self.goals.values()] + counts)

    def draw(self, random_state: np.random.RandomState) -> Goal:
        """Draw a goal, then whether to replace it by `Stay` or `Wait`; the drawn goal does not depend on the shares."""
        goal = self.goals[str(random_state.choice(list(self.goals)))]
        lot = random_state.uniform()
        if lot < self.impossible:
            return Stay.instead_of(goal)
        return Wait(goal.pads) if lot < self.impossible + self.silent else goal


class Chain:
    """Several instructions in a row, each of which is given when the one before is completed.

    All are drawn at the start of the episode, whatever the agent does. Each is feasible once the earlier ones
    are carried out: no block is put where another one is or taken from below one, and a lifted block is named next.

    Attributes:
        blocks: minimum number of blocks on the table.
        absent: minimum number of colours that no block has.
        pads: number of pads on the table.
    """

    name, absent = "chain", 0

    def __init__(self, goals: Mapping[str, Goal | None], length: Annotated[int, Ge(1), Le(9)]) -> None:
        """Take name → goal, or None to omit it, and the number of instructions (UserError: no goal remains, one cannot
        be part of a chain, or there are not enough possible instructions)."""
        self.goals, self.length = _require_goals(goals), length
        for name, goal in self.goals.items():
            if type(goal).after is Goal.after:
                raise UserError(f"task.goal.goals.{name} cannot be part of a chain (no `after`): set it to null")
            if goal.language.held_out_colours:
                raise UserError(
                    f"task.goal.goals.{name}.language.held_out_colours must be []: a chain names blocks of all colours"
                )
        self.blocks = max(goal.blocks for goal in self.goals.values())
        self.pads = max(goal.pads for goal in self.goals.values())
        self.plan(self.blocks, np.random.RandomState(0))

    def draw(self, random_state: np.random.RandomState) -> Chain:
        """Return the chain: its instructions are drawn by `plan`, once the number of blocks is known."""
        return self

    def plan(self, blocks: int, random_state: np.random.RandomState) -> list[Link]:
        """Draw the goals and what they name, with `blocks` blocks on the table; every goal that is possible is equally
        likely (UserError: there is no such chain)."""
        links = self._complete([], Arrangement(), blocks, random_state)
        if links is None:
            raise UserError(
                f"{', '.join(self.goals)} give no chain of {self.length} instructions with {blocks} blocks: lower "
                "task.goal.length or add goals"
            )
        return links

    def _complete(
        self, links: list[Link], arrangement: Arrangement, blocks: int, random_state: np.random.RandomState
    ) -> list[Link] | None:
        """Return the links completed to a whole chain, or None if that is impossible."""
        if len(links) == self.length:
            return links
        for goal in _shuffle(list(self.goals.values()), random_state):
            choices = permutations(range(blocks), goal.named)
            pads = list(permutations(range(goal.pads)))
            for referents in _shuffle([Referents(choice, order) for choice in choices for order in pads], random_state):
                successor = goal.after(arrangement, referents)
                if successor is not None:
                    chain = self._complete([*links, (goal, referents)], successor, blocks, random_state)
                    if chain is not None:
                        return chain
        return None


def _require_goals(goals: Mapping[str, Goal | None]) -> dict[str, Goal]:
    """Return the goals that are not None; a UserError if there is none."""
    result = {name: goal for name, goal in goals.items() if goal is not None}
    if not result:
        raise UserError("task.goal.goals names no goal")
    return result


def _shuffle(values: Sequence[T], random_state: np.random.RandomState) -> list[T]:
    return [values[index] for index in random_state.permutation(len(values))]
