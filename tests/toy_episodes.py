"""Episodes of the toy world, and small stores of them to damage."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from toy import ARM_SPEC, ToyExpert, make_arm

from vla.data.episodes import EpisodeStore
from vla.data.header import Codec
from vla.rollouts.rollout import rollout
from vla.spec import Episode, Spec

CONFIG = {"task": {"size": 1.0}, "seed": 0}

EPISODES = [rollout(make_arm(), ToyExpert(), seed) for seed in range(5)]  # seed 3 fails


CODECS = [Codec("raw"), Codec("lossless"), Codec("jpeg", 95)]


def add(
    folder: Path, episodes: list[Episode], codec: Codec | None = None, spec: Spec = ARM_SPEC, **config: Any
) -> EpisodeStore:
    store = EpisodeStore.create_or_open(folder, spec, {**CONFIG, **config}, codec)
    with store.writing():
        for episode in episodes:
            if episode.success:
                store.append(episode)
            else:
                store.fail(episode)
    return store


MORE = [*EPISODES, *(rollout(make_arm(), ToyExpert(), seed) for seed in range(5, 9))]  # seeds 3 and 8 fail


def change(path: Path, edit: Callable[[bytes], bytes]) -> None:
    path.write_bytes(edit(path.read_bytes()))


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """A disk on which no file becomes larger than a size [bytes]."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def flip(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]
