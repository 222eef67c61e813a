"""Stores of compressed images: without loss they are those of raw ones, and JPEG is compressed once."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from collecting import content
from composing import composed
from exporting import exporter
from resuming import same
from toy import ARM_SPEC, make_arm, make_expert
from toy_episodes import CODECS, CONFIG, EPISODES, MORE, add, change

from vla.config.experiment import Experiment
from vla.data.datamodule import digest_of
from vla.data.derivation import derive_store
from vla.data.episodes import DamageError, EpisodeStore
from vla.data.fields import END
from vla.data.header import Codec
from vla.data.image_codec import decode, encode
from vla.data.verification import episode_of, require_whole, verify_store
from vla.data.window_batches import WindowBatcher
from vla.io.errors import UserError
from vla.parallel.pool import Cluster
from vla.rollouts.collect import collect
from vla.rollouts.memorisation import NearestDemonstration

RAW, LOSSLESS, JPEG = CODECS
LATER = 1  # an episode after the first


def of_all(store: EpisodeStore, field: str) -> list[np.ndarray]:
    """The rows of every episode."""
    return [store.read(entry)[field] for entry in store.episodes]


def test_without_loss_batches_episodes_and_index_are_those_of_a_raw_store(tmp_path: Path) -> None:
    raw, small = add(tmp_path / "raw", EPISODES), add(tmp_path / "small", EPISODES, LOSSLESS)
    assert small.attempts == raw.attempts and digest_of(small.episodes) == digest_of(raw.episodes)
    assert content(small.folder)["index.jsonl"] == content(raw.folder)["index.jsonl"]
    for place in (0, -1, slice(2, 4)):
        np.testing.assert_array_equal(small.rows("rgb_front")[place], raw.rows("rgb_front")[place])
    rows = np.random.default_rng(0).permutation(len(raw.rows("action")))
    nearest = [NearestDemonstration(store.folder, None, spec=ARM_SPEC) for store in (raw, small)]
    np.testing.assert_array_equal(nearest[0]._images, nearest[1]._images)
    for history in (1, 6):
        made = [WindowBatcher(store, history, 2)(rows) for store in (small, raw)]
        assert same(*made) and made[0]["rgb"]["front"].any()
    for entry in raw.episodes:
        expected = raw.read(entry)
        for field, values in small.read(entry).items():
            np.testing.assert_array_equal(values, expected[field])
            assert values.dtype == expected[field].dtype


def test_jpeg_is_close_and_smaller_and_depth_exact(tmp_path: Path) -> None:
    store = add(tmp_path, EPISODES, JPEG)
    require_whole(verify_store(store))
    assert digest_of(store.episodes) != digest_of(add(tmp_path / "raw", EPISODES).episodes)
    for entry in store.episodes:
        rows, seen = store.read(entry), EPISODES[entry.seed].observations
        np.testing.assert_array_equal(rows["depth_wrist"], [one.depth["wrist"] for one in seen])
        assert 0 < np.abs(rows["rgb_front"].astype(float) - [one.rgb["front"] for one in seen]).mean() < 12


@pytest.mark.parametrize("codec", CODECS[1:], ids=str)
def test_images_of_an_even_colour_come_back_small(codec: Codec) -> None:
    image = np.full((64, 48, 3), 77, np.uint8)
    packed = encode(image, codec.of_field("rgb_front"), codec.quality)
    assert len(packed) < image.nbytes / 5
    np.testing.assert_array_equal(decode(packed, codec.of_field("rgb_front"), image.shape, image.dtype), image)
    for wrong in (packed[:-4], packed[:9], b"", packed + packed):
        if wrong[: len(packed)] != packed or codec == LOSSLESS:  # what follows a JPEG is not read
            with pytest.raises(ValueError, match="the image cannot be decoded"):
                decode(wrong, codec.of_field("rgb_front"), image.shape, image.dtype)
    with pytest.raises(ValueError, match="the image"):
        decode(packed, codec.of_field("rgb_front"), (64, 47, 3), image.dtype)


@pytest.mark.parametrize(("size", "codec"), [((128, 128), RAW), ((128, 129), LOSSLESS)])
def test_by_default_large_images_are_compressed_without_loss(
    tmp_path: Path, size: tuple[int, int], codec: Codec
) -> None:
    store = EpisodeStore.create_or_open(tmp_path, replace(ARM_SPEC, image_size=size), CONFIG)
    assert store.codec == codec == EpisodeStore(tmp_path).codec
    assert ("codec" in (tmp_path / "store.json").read_text()) == (codec != RAW)


@pytest.mark.parametrize("codec", CODECS[1:], ids=str)
def test_a_collection_grows_to_the_same_bytes(tmp_path: Path, codec: Codec) -> None:
    for folder, steps, workers in (("whole", [6], 2), ("grown", [2, 3, 6], 1)):
        for episodes in steps:
            store = EpisodeStore.create_or_open(tmp_path / folder, ARM_SPEC, CONFIG, codec)
            collect(store, make_arm, make_expert, episodes, Cluster(workers, "beside"), seed=0)
    assert content(tmp_path / "grown") == content(tmp_path / "whole")
    assert len(EpisodeStore(tmp_path / "grown").episodes) == 6


def test_a_store_keeps_its_codec_and_other_losses_are_refused(tmp_path: Path) -> None:
    add(tmp_path / "raw", EPISODES[:1])
    assert add(tmp_path / "raw", EPISODES[1:2], LOSSLESS).codec == RAW
    with pytest.raises(
        ValueError, match=r"raw holds raw images, not jpeg images of quality 95: set another collect\.folder"
    ):
        add(tmp_path / "raw", [], JPEG)
    add(tmp_path / "jpeg", EPISODES[:1], JPEG)
    assert add(tmp_path / "jpeg", EPISODES[1:2]).codec == JPEG
    for other in (RAW, LOSSLESS, replace(JPEG, quality=90)):
        with pytest.raises(ValueError, match="holds jpeg images of quality 95, not "):
            add(tmp_path / "jpeg", [], other)


@pytest.mark.parametrize(
    ("options", "codec"),
    [
        ((), None),
        (("collect.images=lossless",), LOSSLESS),
        (("collect.images=jpeg",), Codec("jpeg", 90)),
        (("collect.images=jpeg", "collect.quality=70"), Codec("jpeg", 70)),
    ],
)
def test_the_config_names_the_codec(options: tuple[str, ...], codec: Codec | None) -> None:
    assert Experiment.from_config(composed(*options)).collect.codec == codec


@pytest.mark.parametrize("codec", CODECS[1:], ids=str)
def test_a_damaged_image_is_named_by_episode_and_step(tmp_path: Path, codec: Codec) -> None:
    store = add(tmp_path / "store", EPISODES, codec)
    entry, row = store.attempts[LATER], store.attempts[LATER].start + 3
    begins = int(np.fromfile(store.folder / "rgb_wrist.ends", END)["end"][row - 1])
    change(store.folder / "rgb_wrist.pack", lambda data: data[:begins] + b"#" * 8 + data[begins + 8 :])
    says = r"rgb_wrist of step 3 of seed 1 in .*store was changed on disk: keep what is whole with job=inspect"
    for read in (
        lambda: store.read(entry),
        lambda: episode_of(store, entry),
        lambda: derive_store([store], tmp_path / "copy"),
        lambda: WindowBatcher(store, 1, 1)(np.array([0, entry.start])),
    ):
        with pytest.raises(ValueError, match=says):
            read()
    assert store.read(store.attempts[0]) and verify_store(store).damaged_seeds == {
        "rgb_wrist of step 3 changed or lost": [1]
    }
    assert derive_store([store], tmp_path / "repaired", repair=True) == [1]
    repaired = EpisodeStore(tmp_path / "repaired")
    assert repaired.codec == codec and [entry.seed for entry in repaired.episodes] == [0, 2, 4]
    assert repaired.packed_images(repaired.attempts[2]) == store.packed_images(store.attempts[2])


def test_damaged_images_of_several_episodes_are_named_by_seed(tmp_path: Path) -> None:
    store = add(tmp_path, EPISODES, LOSSLESS)
    change(tmp_path / "rgb_wrist.pack", lambda data: bytes(len(data)))
    with pytest.raises(ValueError, match=r"the rows of the seeds 0, 1, 2, 4 in .* were changed on disk"):
        WindowBatcher(store, 1, 1).verify()
    found = verify_store(store)
    with pytest.raises(ValueError, match=r"4 damaged .* \(4 seeds, 0, 1, 2, 4: rgb_wrist of step 0 changed or lost\)"):
        require_whole(found)
    found.damaged_seeds.update({f"rgb_front of step {step} changed or lost": [step] for step in range(20)})
    with pytest.raises(ValueError, match=r"24 damaged .*: rgb_front of step 6 changed or lost; and 13 others\)"):
        require_whole(found)


@pytest.mark.parametrize("end", [0, 2**16, 2**62, 2**63, 2**64 - 1])
def test_no_memory_is_taken_for_what_a_damaged_file_says(tmp_path: Path, end: int) -> None:
    store = add(tmp_path, EPISODES, LOSSLESS)
    ends = np.fromfile(tmp_path / "rgb_front.ends", END)
    ends["end"][2] = end
    ends.tofile(tmp_path / "rgb_front.ends")
    for opened in (store, EpisodeStore(tmp_path)):
        with pytest.raises(ValueError, match=r"rgb_front of step [23] of seed 0 in .* was changed on disk"):
            opened.read(store.attempts[0])


@pytest.mark.parametrize("file", ["rgb_wrist.pack", "rgb_wrist.ends"])
def test_a_truncated_file_is_named_and_what_is_before_it_is_kept(tmp_path: Path, file: str) -> None:
    store = add(tmp_path, EPISODES, LOSSLESS)
    change(tmp_path / file, lambda data: data[:-1])
    with pytest.raises(ValueError, match=r"rgb_wrist\.pack is shorter than its index says: keep what is whole"):
        EpisodeStore(store.folder)
    assert verify_store(EpisodeStore(tmp_path, allow_damage=True)).damaged_seeds == {"rows changed or lost": [4]}
    (tmp_path / file).unlink()
    assert len(verify_store(EpisodeStore(tmp_path, allow_damage=True)).intact_entries) == 0


def test_jpeg_is_not_compressed_a_second_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever an encoder would make of the images that a decoder gives."""
    store = add(tmp_path / "store", EPISODES, JPEG)
    monkeypatch.setattr("vla.data.fields.encode", lambda *_: pytest.fail("an image is compressed"))
    derive_store([store], tmp_path / "chosen", {"seed": [1, 2]})
    chosen = EpisodeStore(tmp_path / "chosen")
    derive_store([chosen, store], tmp_path / "both")
    for copied, seeds in ((chosen, [1, 2]), (EpisodeStore(tmp_path / "both"), [0, 1, 2, 4])):
        require_whole(verify_store(copied))
        assert copied.codec == JPEG and [entry.seed for entry in copied.episodes] == seeds
        for entry in copied.episodes:
            source = store.attempts[entry.seed]
            assert copied.packed_images(entry) == store.packed_images(source) and entry.crc == source.crc


def test_stores_with_different_codecs_are_merged_without_a_further_loss(tmp_path: Path) -> None:
    stores = [add(tmp_path / str(codec), MORE[2 * n : 2 * n + 2], codec) for n, codec in enumerate(CODECS)]
    derive_store(stores, tmp_path / "merged")
    merged = EpisodeStore(tmp_path / "merged")
    require_whole(verify_store(merged))
    assert merged.codec == LOSSLESS and merged.is_derived  # no collection makes it
    expected = [images for store in stores for images in of_all(store, "rgb_front")]
    for images, others in zip(of_all(merged, "rgb_front"), expected, strict=True):
        np.testing.assert_array_equal(images, others)
    derive_store(stores[:2], tmp_path / "exact")
    assert content(tmp_path / "exact") == content(add(tmp_path / "whole", MORE[:4], LOSSLESS).folder)


def test_a_video_of_jpeg_is_a_second_loss_and_that_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for codec in CODECS:
        caplog.clear()
        exporter("lerobot", tmp_path / f"export-{codec}").export(add(tmp_path / str(codec), EPISODES[:1], codec))
        assert ("videos lose more of the JPEG images in" in caplog.text) == (codec == JPEG)


def test_what_another_process_adds_does_not_disturb_a_reader(tmp_path: Path) -> None:
    add(tmp_path, EPISODES[:2], LOSSLESS)
    reader = EpisodeStore(tmp_path)
    rows = reader.rows("rgb_front")
    before = rows[0 : len(rows)]
    add(tmp_path, EPISODES[2:], LOSSLESS)
    np.testing.assert_array_equal(rows[0 : len(rows)], before)
    assert reader.rows("rgb_front").shape == rows.shape


def test_a_pipe_in_place_of_images_and_ends_beyond_any_file_are_told(tmp_path: Path) -> None:
    store = add(tmp_path, EPISODES, LOSSLESS)
    far = np.fromfile(tmp_path / "rgb_wrist.ends", END)
    far["end"][store.attempts[LATER].start :][:2] = 2**63 - 10, 2**63 + 10
    change(tmp_path / "rgb_wrist.ends", lambda _: far.tobytes())
    for row in range(2):
        with pytest.raises(DamageError, match=f"rgb_wrist of step {row} of seed 1 "):
            store.rows("rgb_wrist")[store.attempts[LATER].start + row :][:1]
    far["end"] = 0
    change(tmp_path / "rgb_wrist.ends", lambda _: far.tobytes())
    (tmp_path / "rgb_wrist.pack").unlink()
    os.mkfifo(tmp_path / "rgb_wrist.pack")
    with pytest.raises(UserError, match=r"rgb_wrist\.pack is a folder, a pipe or a device, not a file"):
        EpisodeStore(tmp_path)


def test_an_episode_larger_than_the_memory_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = add(tmp_path, EPISODES, LOSSLESS)
    monkeypatch.setattr("vla.data.episodes.memory", lambda: 10**4)
    with pytest.raises(UserError, match=r"seed 0 in .* unpacks to 0 GB, and this machine has 0 GB of memory"):
        store.read(store.attempts[0])
