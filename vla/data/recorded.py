"""Demonstrations that exist already, as experts: their episodes are copied into the store instead of made."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
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
            ValueError: there are not so many, those in the store are others, one is damaged, or the disk is full.
        """
        if episodes > len(self):
            raise ValueError(
                f"there are only {len(self)} recorded episodes: set collect.episodes={len(self)}, or fewer"
            )
        last = min(len(store.episodes), len(self)) - 1
        if last >= 0 and not np.array_equal(store.read(store.episodes[last])["action"], self.episode(last).actions):
            raise ValueError(
                f"{store.folder} holds other episodes than are recorded now: choose another collect.folder"
            )
        if len(store.episodes) >= episodes:
            return 0
        with store.writing():
            missing = range(len(store.episodes), episodes)
            for number in track(missing, "importing"):
                store.append(self.episode(number))
        return len(missing)
