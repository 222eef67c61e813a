"""Demonstrations that exist already, as experts: their episodes are copied into the store instead of made."""

from __future__ import annotations

from abc import ABC, abstractmethod

from rich.progress import track

from vla.data.episodes import EpisodeStore
from vla.spec import Episode, Spec


class Recorded(ABC):
    """Episodes of somebody else; `spec` is what one of their steps looks like, which has no truth."""

    spec: Spec

    @abstractmethod
    def __len__(self) -> int:
        """How many episodes there are."""

    @abstractmethod
    def episode(self, number: int) -> Episode:
        """One of them; the number is its seed."""

    def fill(self, store: EpisodeStore, episodes: int) -> int:
        """Append those that are missing until the store holds `episodes`; how many that were.

        Raises:
            ValueError: there are not so many, one of them is damaged, or the disk is full.
        """
        if episodes > len(self):
            raise ValueError(
                f"there are only {len(self)} recorded episodes: set collect.episodes={len(self)}, or fewer"
            )
        if len(store.episodes) >= episodes:
            return 0
        with store.writing():
            missing = range(len(store.episodes), episodes)
            for number in track(missing, "importing"):
                store.append(self.episode(number))
        return len(missing)
