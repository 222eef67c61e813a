"""New episode stores from others, by repair, filtering and merging.

Nothing is changed in place: a new store is written to a temporary folder and renamed when it is complete.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vla.data.episode_filter import episode_filter
from vla.data.episodes import DamageError, EpisodeStore
from vla.data.header import Codec
from vla.data.index import DAMAGED, LOST, Entry
from vla.data.verification import entries_by_config, episode_of, without_rows
from vla.io.documents import canonicalize
from vla.io.errors import UserError
from vla.io.files import atomic_path, remove_drafts, try_lock
from vla.io.printable import track

Copies = Sequence[tuple[EpisodeStore, Entry]]  # of one seed and config
EpisodeSelection = dict[str, dict[int, list[tuple[EpisodeStore, Entry]]]]  # config as JSON → seed → its copies


def derive_store(
    stores: Sequence[EpisodeStore], folder: Path, where: Mapping[str, Any] | None = None, repair: bool = False
) -> list[int]:
    """Write a new store of the episodes that match `where` in `stores` of one spec, atomically (UserError: the folder
    exists, or another process writes it; specs differ, nothing matches, or an episode is damaged).

    Episodes are sorted by seed within each config. Of those with the same seed and config, one undamaged one is kept.
    The store equals a collected one, and can grow, if it has one config, no gaps in its seeds, no filter and one codec
    loss. With `repair`, an episode that is damaged in all sources becomes a failed seed. Returns the seeds of these.
    """
    for store in stores[1:]:
        store.spec.require(stores[0].spec, f"the episode store {store.folder}", f"{stores[0].folder}")
    selection = _choose(stores, where or {})
    if not any(entry.is_stored for seeds in selection.values() for copies in seeds.values() for _, entry in copies):
        condition = f" that fit inspect.where={dict(where)}" if where else ""
        raise UserError(f"{', '.join(str(store.folder) for store in stores)}: there are no episodes{condition}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    message = f"another process writes {folder}: wait for it, or choose another inspect.into"
    lock = try_lock(folder.with_name(f".{folder.name}.lock"), message)
    try:
        _require_new(folder)
        remove_drafts(folder)  # of a process that was killed
        codecs = {store.codec for store in stores}
        codec = Codec("lossless") if len(codecs) > 1 else codecs.pop()  # no further loss
        with atomic_path(folder) as draft:
            target = EpisodeStore.create_or_open(draft, stores[0].spec, _config(selection, stores, where), codec)
            with target.writing():
                seeds = [(seed, copies) for part in selection.values() for seed, copies in sorted(part.items())]
                damaged_seeds = [seed for seed, copies in track(seeds, "writing") if not _write(target, copies, repair)]
            _require_new(folder)  # another job may have made it meanwhile, and the draft would replace it
    except (UserError, OSError) as error:
        if isinstance(error.__cause__, OSError):  # its message is about a store that grows, or names the draft
            reason = f"{folder} cannot be written ({error.__cause__.strerror}), nothing of it is kept"
            raise UserError(f"{reason}: make room there, or choose another inspect.into") from error
        raise
    finally:
        Path(lock.lock_file).unlink(missing_ok=True)  # while it is held: a later process creates a new one
        lock.release()
    return damaged_seeds


def _require_new(folder: Path) -> None:
    if folder.exists():
        raise UserError(f"{folder} exists already and is left alone: choose another inspect.into")


def _choose(stores: Sequence[EpisodeStore], where: Mapping[str, Any]) -> EpisodeSelection:
    matches = episode_filter(where, [entry for store in stores for entry in store.attempts])
    selection: EpisodeSelection = {}
    keys = dict[str, str]()  # config as it is compared → the first one, as it is written
    for store in stores:
        for config, entries in entries_by_config(store):
            key = keys.setdefault(json.dumps(canonicalize(config)), json.dumps(config))
            for entry in filter(matches, entries):
                selection.setdefault(key, {}).setdefault(entry.seed, []).append((store, entry))
    return selection


def _config(
    selection: EpisodeSelection, stores: Sequence[EpisodeStore], where: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the config of the episodes if one collection could have produced them all, else a `DerivedConfig`."""
    conditions = [condition for store in stores if store.is_derived for condition in store.config["where"]]
    conditions += [dict(where)] if where else []
    (config, seeds), *other_configs = selection.items()
    same_loss = len({store.codec.loss for store in stores}) == 1
    if not other_configs and not conditions and same_loss and max(seeds) - min(seeds) == len(seeds) - 1:
        return json.loads(config)
    return {"parts": [(json.loads(config), len(seeds)) for config, seeds in selection.items()], "where": conditions}


def _write(target: EpisodeStore, copies: Copies, repair: bool) -> bool:
    """Add a seed to a store from its first undamaged copy; returns whether there was one."""
    candidates = [(source, entry) for source, entry in copies if entry.outcome != LOST]
    for source, entry in sorted(candidates, key=lambda copy: not copy[1].is_stored):  # an episode rather than a failure
        if not entry.is_stored:
            target.fail(without_rows(entry))
            return True
        try:
            target.append(
                episode_of(source, entry), source.packed_images(entry) if source.codec == target.codec else None
            )
            return True
        except DamageError:
            if not repair:
                raise
    _, entry = (candidates or copies)[0]
    target.fail(replace(without_rows(entry), outcome=DAMAGED))
    return False
