"""Training windows: equal to a naive loop over the episodes; `test_trainer` resumes their order."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import toy
from collecting import until
from reading import fit, windows

from vla.data.datamodule import Prefetcher, is_held_out
from vla.data.episodes import EpisodeStore, observations_of
from vla.data.verification import episode_of
from vla.data.window_batches import WindowBatcher, is_perturbed
from vla.io.images import resize
from vla.io.parts import Part
from vla.parallel.pool import Cluster
from vla.rollouts.collect import collect
from vla.spec import Array

EPISODES = toy.EPISODES


def naive(store: EpisodeStore, row: int, history: int, chunk: int) -> dict[str, Any]:
    """The window whose newest frame is `row`, built frame by frame."""
    entry = next(entry for entry in store.episodes if entry.start <= row < entry.start + entry.steps)
    rows = store.read(entry)
    newest = row - entry.start
    frames: list[dict[str, Any]] = []
    for step in range(newest - history + 1, newest + 1):
        present = step >= 0
        seen = {name: values[max(step, 0)] * present for name, values in rows.items()}
        labels = [min(max(step + ahead, 0), entry.steps - 1) if present else 0 for ahead in range(chunk)]
        seen["labels"], seen["done"] = ([rows[name][label] for label in labels] for name in ("action", "executed"))
        off = is_perturbed(rows["action"], rows["executed"], store.spec)
        seen["valid"] = [
            present and step + ahead < entry.steps and not off[step : step + ahead].any() for ahead in range(chunk)
        ]
        seen["perturbations"] = [
            off[step : step + ahead].sum() if present and step + ahead < entry.steps else -1 for ahead in range(chunk)
        ]
        seen["present"] = present
        frames.append(seen)
    return {name: np.stack([frame[name] for frame in frames]) for name in frames[0]} | {"text": entry.instruction}


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the world with a robot and depth."""
    return toy.make_store(tmp_path_factory.mktemp("arms"), toy.make_arm).folder


@pytest.mark.parametrize(("history", "chunk"), [(1, 1), (3, 2), (6, 8)])
def test_a_batch_is_what_a_loop_over_the_episodes_gives(arms: Path, history: int, chunk: int) -> None:
    store = EpisodeStore(arms)
    chosen = np.concatenate([np.arange(store.episodes[5].start - 2, store.episodes[5].start + 9), [0, 1]])
    batch = WindowBatcher(store, history, chunk)(chosen)
    assert {images.dtype for images in batch["rgb"].values()} == {torch.uint8} and "depth" not in batch
    assert {batch[name].dtype for name in ("state", "truth", "action")} == {torch.float32}
    assert {batch[name].dtype for name in ("present", "valid")} == {torch.bool}
    for place, row in enumerate(chosen):
        expected = naive(store, row, history, chunk)
        for camera in toy.ARM_SPEC.cameras:
            np.testing.assert_array_equal(batch["rgb"][camera][place], expected[f"rgb_{camera}"])
        for name in ("state", "truth", "present", "valid", "perturbations"):
            np.testing.assert_array_equal(batch[name][place], expected[name])
        usable = expected["valid"]
        np.testing.assert_array_equal(batch["action"][place].numpy()[usable], expected["labels"][usable])
        inside = expected["perturbations"] >= 0
        np.testing.assert_array_equal(batch["executed"][place].numpy()[inside], expected["done"][inside])
        beyond = ~usable & expected["present"][:, None]
        np.testing.assert_array_equal(batch["action"][place].numpy()[beyond], expected["labels"][beyond])
        assert batch["instruction"][place] == expected["text"]


def test_a_further_store_may_lack_the_truth(folder: Path, tmp_path: Path) -> None:
    source = EpisodeStore(folder)
    lacking = EpisodeStore.create_or_open(tmp_path / "lacking", source.spec.without_truth, {})
    with lacking.writing():
        for seed, entry in enumerate(source.episodes[:4]):
            seen = observations_of(lacking.spec, source.read(entry), entry.instruction)
            given = replace(episode_of(source, entry), seed=seed, outcome="unverified", draws={}, observations=seen)
            lacking.append(given)
    module, twice = (windows(folder, more=[lacking.folder] * number) for number in (1, 2))
    added = len(module.training_windows) - len(windows(folder).training_windows)
    assert len(twice.training_windows) == len(module.training_windows) + added and added > 0
    last = source.episodes[-1].end
    batch = module.make_batch(np.array([0, last, last + 1]))
    assert torch.isfinite(batch["truth"][0]).all() and batch["truth"][1:, -1].isnan().all()
    np.testing.assert_array_equal(batch["state"][1, -1], np.asarray(source.rows("state"))[0])
    # A batch without truth has a loss of 0 there, which would dilute the mean over the batches of a validation.
    mixed = windows(folder, more=[lacking.folder] * 8).val_dataloader()
    shares = [batch["truth"][:, -1].isnan().any(-1).float().mean() for batch in mixed]
    assert len(shares) > 1 and max(shares) - min(shares) < 0.3


def test_a_further_store_may_have_images_of_another_size(folder: Path, tmp_path: Path) -> None:
    further = toy.make_store(tmp_path, partial(toy.ToyEnvironment, spec=replace(toy.SPEC, image_size=(12, 24))))
    module, first = windows(folder, more=[tmp_path]), EpisodeStore(folder)
    start = first.episodes[-1].end
    images = module.make_batch(np.array([5, start + 5, start]))["rgb"]["eye"]
    for seen, store, row in zip(images, (first, further, further), (5, 5, 0), strict=True):
        np.testing.assert_array_equal(seen[-1], resize(np.asarray(store.rows("rgb_eye"))[row], (16, 16)))
    assert not images[2, :-1].any()  # before the start of the episode
    with pytest.raises(ValueError, match=r"the model has image_size = \(16, 16\), but .* has \(12, 24\)"):
        windows(folder, more=[tmp_path], spec=replace(toy.SPEC, parts=(Part("eye"),)))
    with pytest.raises(ValueError, match="the model has truth = "):
        windows(tmp_path, spec=replace(toy.SPEC, truth=(("target", 2),)))


def test_every_window_comes_once_per_shuffle(folder: Path) -> None:
    module = windows(folder)
    count = len(module.training_windows)
    drawn = np.concatenate([module.order(step) for step in range(2 * count // 8 + 1)])
    for first in (0, count):
        np.testing.assert_array_equal(np.sort(drawn[first : first + count]), module.training_windows)
    assert not np.array_equal(drawn[:count], drawn[count : 2 * count])
    assert not np.array_equal(windows(folder, seed=2).order(0), module.order(0))
    larger = windows(folder, batch_size=2 * count + 5)
    assert np.bincount(larger.order(0))[module.training_windows].min() == 2
    steps = count // (8 * 2)  # two processes share the windows out
    ranks = [np.concatenate([module.order(step, rank, 2) for step in range(steps)]) for rank in (0, 1)]
    assert len({*ranks[0], *ranks[1]}) == steps * 8 * 2


def test_the_split_is_by_episode_and_does_not_move_when_episodes_are_added(folder: Path) -> None:
    few, many = windows(folder, episodes=20), windows(folder)
    assert set(few.held_out_windows) < set(many.held_out_windows)
    assert set(few.training_windows) < set(many.training_windows)
    for entry in EpisodeStore(folder).episodes:
        side = many.held_out_windows if is_held_out(entry.seed, 0.2) else many.training_windows
        assert np.isin(np.arange(entry.start, entry.start + entry.steps), side).all()
    for fraction in (0.05, 0.1, 0.5):  # every stretch of seeds holds out its share
        held, length = np.array([is_held_out(seed, fraction) for seed in range(10_000)]), round(2 / fraction)
        assert abs(held.mean() - fraction) < 0.001
        assert all(held[first : first + length].any() for first in range(0, 10_000 - length))


def test_validation_is_the_same_pass_in_whole_batches(folder: Path) -> None:
    module = windows(folder)
    loader = module.val_dataloader()
    assert len(loader) == 5  # 40 windows
    first, second = list(loader), list(loader)
    assert len(first) == len(second) == 5
    assert all(torch.equal(one["rgb"]["eye"], two["rgb"]["eye"]) for one, two in zip(first, second, strict=True))
    assert all(len(batch["action"]) == 8 for batch in first)
    assert windows(folder, validation_fraction=0.0).val_dataloader() == []


def test_the_stream_is_made_ahead_but_not_without_bound(folder: Path) -> None:
    module, made = windows(folder, ahead=2), []
    gather = module.make_batch
    module.make_batch = lambda rows: (made.append(len(rows)), gather(rows))[1]  # type: ignore[assignment,func-returns-value]
    stream = iter(module.train_dataloader())
    for _ in islice(stream, 4):
        pass
    until(lambda: len(made) >= 4 + 2)
    stream.close()  # type: ignore[attr-defined]
    assert len(made) == 4 + 2

    def fail(rows: Array) -> dict[str, Any]:
        raise ValueError(f"row {rows[0]} is gone")

    with pytest.raises(ValueError, match="row 7 is gone"):  # where the batch is waited for
        next(iter(Prefetcher(fail, lambda: [np.array([7])], 2)))


def test_what_is_kept_of_a_batch_does_not_change(folder: Path) -> None:
    module = windows(folder)
    stream = iter(module.train_dataloader())
    kept = [next(stream)["rgb"]["eye"][1:, 0].numpy()[:3] for _ in range(5)]
    for _ in islice(stream, 10):
        pass
    for step, images in enumerate(kept):
        expected = WindowBatcher(EpisodeStore(folder), 3, 2)(module.order(step))["rgb"]["eye"][1:4, 0]
        np.testing.assert_array_equal(images, expected)


def test_training_leaves_the_store_as_it_is(folder: Path, tmp_path: Path) -> None:
    """Also where nothing could be written; who runs this may be root, whom no permission keeps from it."""
    store = tmp_path / "store"
    shutil.copytree(folder, store)
    for path in (*store.iterdir(), store):
        path.chmod(0o555 if path.is_dir() else 0o444)
    before = {path: path.stat().st_mtime_ns for path in (store, *store.iterdir())}
    # What job=train does: it looks whether there are episodes enough, and trains on them.
    complete, cluster = EpisodeStore.create_or_open(store, toy.SPEC, {}), Cluster(1, "beside")
    assert collect(complete, toy.make_environment, toy.make_expert, EPISODES, cluster, seed=0).added == 0
    seen = fit(store, 5).seen
    assert all(torch.equal(one, two) for one, two in zip(seen, fit(folder, 5).seen, strict=True))
    assert {path: path.stat().st_mtime_ns for path in (store, *store.iterdir())} == before
    opened = EpisodeStore(store)
    assert all(isinstance(rows, np.ndarray) and not rows.flags.writeable for rows in map(opened.rows, opened.fields))
    store.chmod(0o755)  # so that it can be tidied away


def test_what_cannot_be_trained_on_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"the model has control_hz = 5\.0, but the episode store .* has 10\.0"):
        windows(folder, spec=replace(toy.SPEC, control_hz=5.0))
    with pytest.raises(ValueError, match=r"of 1 episode 0 would train, 1 validate: raise collect\.episodes"):
        windows(folder, episodes=1)


def test_a_training_goes_on_with_batches_of_its_size_alone(folder: Path) -> None:
    module = windows(folder, batch_size=4)
    saved = module.state_dict()
    module.load_state_dict(saved)
    with pytest.raises(ValueError, match="had batches of 8 windows, and 1 process would have batches of 4"):
        module.load_state_dict({**saved, "batch": 8})
