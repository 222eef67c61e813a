"""The goal of placing a block on one of two pads."""

from __future__ import annotations

from vla.tasks.tabletop.goals.goal import Arrangement, Referents
from vla.tasks.tabletop.goals.pick_place import PickPlace


class Place(PickPlace):
    """Put the named block on the named pad of two and let go of it."""

    pads = 2

    def after(self, arrangement: Arrangement, referents: Referents) -> Arrangement | None:
        """See `Goal`."""
        (block,), (pad, _) = referents.blocks, referents.pads
        return arrangement.on_pad(block, pad) if arrangement.allows(block) else None
