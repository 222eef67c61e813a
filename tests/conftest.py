"""Shared by all tests: headless rendering, one thread per process, the tabletop as the configuration builds it, and a
store of episodes of the toy world."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from vla.tasks.backend import choose_backend
from vla.workers import THREAD_SETTINGS

if TYPE_CHECKING:
    from vla.tasks.tabletop import Tabletop

CONF = Path(__file__).parents[1] / "conf"

# Read by libraries when they are first imported, which tests do after this file.
for name, threads in THREAD_SETTINGS.items():
    os.environ.setdefault(name, threads)
choose_backend()

# What a shell runs in the background ignores interrupts, and so would the programs that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """What has been imported by now stays: nobody need look through it again and again for what could be freed."""
    gc.collect()
    gc.freeze()


def make_tabletop(*overrides: str) -> Tabletop:
    """The environment that `task=tabletop` and `overrides` of it compose to."""
    from hydra import compose, initialize_config_dir
    from hydra.utils import instantiate

    with initialize_config_dir(str(CONF / "task"), version_base="1.3"):
        config: Any = compose("tabletop", overrides=list(overrides))
    environment: Tabletop = instantiate(config, _convert_="all")
    return environment


@pytest.fixture(scope="module")
def tabletop() -> Iterator[Tabletop]:
    """The default task, for tests that do not change it."""
    environment = make_tabletop()
    yield environment
    environment.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small store of the toy world."""
    import toy

    return Path(toy.make_store(tmp_path_factory.mktemp("episodes")).folder)
