"""Existing demonstrations in place of an expert: their episodes are copied into the store."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from rich.progress import track

from vla.data.episodes import EpisodeStore
from vla.spec import Episode, Spec


class ImportedDemonstrations(ABC):
    """Base class of imported episodes; `spec`, the layout of their steps, has no truth."""

    spec: Spec

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of episodes."""

    @abstractmethod
    def episode(self, number: int) -> Episode:
        """Return one episode; its number is its seed."""

    def fill(self, store: EpisodeStore, episodes: int) -> int:
        """Append episodes until the store holds `episodes`; returns the number appended.

        Raises:
            ValueError: there are too few, the store holds other ones, one is damaged, or the disk is full.
        """
        if episodes > len(self):
            raise ValueError(
                f"there are only {len(self)} recorded episodes: set collect.episodes={len(self)}, or fewer"
            )
        last = min(len(store.episodes), len(self)) - 1
        if last >= 0 and not np.array_equal(store.read(store.episodes[last])["action"], self.episode(last).actions):
            raise ValueError(f"{store.folder} holds other episodes than these: choose another collect.folder")
        if len(store.episodes) >= episodes:
            return 0
        with store.writing():
            missing = range(len(store.episodes), episodes)
            for number in track(missing, "importing"):
                store.append(self.episode(number))
        return len(missing)
