"""Descriptions and index lines that anybody may have written are refused in one sentence, which names the file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from toy import ARM_SPEC
from toy_episodes import EPISODES, add

from vla.data.episodes import EpisodeStore
from vla.data.index import index_line
from vla.spec import LONGEST_INSTRUCTION, Spec

NAN = float("nan")


SPECS: list[dict[str, Any]] = [
    {"cameras": 5},
    {"cameras": ["../../front", "wrist"]},
    {"cameras": ["front", "front"]},
    {"image_size": [-1, -1]},
    {"image_size": ["a", "b"]},
    {"image_size": [5000, 16]},
    {"action": []},
    {"state": ["x" * 10_000]},
    {"state_units": ["m"]},
    {"depth": ["side"]},
    {"robot": {"joints": ["elbow"], "frame": "base"}},
    {"robot": {"joints": ["joint1", "joint2"], "frame": "base", "velocities": ["speed1"]}},
    {"units": ["m"]},
    {"low": [1.0, 1.0, 1.0]},
    {"low": [NAN, 0.0, 0.0]},
    {"control_hz": 0},
    {"control_hz": NAN},
    {"robot": {"joints": ["joint1"], "frame": "base", "chain": [[0.0] * 7]}},
    {"truth": [["target", -2]]},
    {"more": 1},
]


@pytest.mark.parametrize(
    "change",
    [
        {"spec": 3},
        {"spec": None},
        *({"spec": {**ARM_SPEC.to_dict(), **wrong}} for wrong in SPECS),
        {"codec": None},
        {"codec": "lossless"},
        {"codec": {"images": "zlib"}},
        {"codec": {"images": "jpeg"}},
        {"codec": {"images": "jpeg", "quality": 100}},
        {"codec": {"images": "lossless", "quality": 90}},
        {"fields": {}},
        {"config": None},
        {"config": []},
        {"config": {"task": "${oc.env:HOME}"}},
        {"config": {"size": NAN}},
        {"config": {"parts": None, "where": []}},
        {"config": {"parts": [[{}, 10**30]], "where": []}},
        {"format": "2"},
    ],
    ids=lambda change: str(change)[-60:],
)
def test_a_description_of_another_kind_is_refused_by_name(tmp_path: Path, change: dict[str, Any]) -> None:
    path = add(tmp_path, EPISODES[:1]).folder / "store.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ValueError, match=r"store\.json") as caught:
        EpisodeStore(tmp_path, damaged=True)
    assert len(str(caught.value)) < 1000


def test_a_description_without_a_config_is_refused(tmp_path: Path) -> None:
    path = add(tmp_path, []).folder / "store.json"
    header = json.loads(path.read_text())
    del header["config"]
    path.write_text(json.dumps(header))
    with pytest.raises(ValueError, match=r"store\.json is damaged or of another kind: config: Field required"):
        EpisodeStore(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"draws": None},
        {"draws": "text"},
        {"draws": {"mass": [1.0, [10**400]]}},
        {"outcome": 5},
        {"steps": 0},
        {"task": 5},
        {"milestones": "near"},
        {"instruction": 5},
        {"instruction": "a" * (LONGEST_INSTRUCTION + 1)},
        {"seed": 10**30},
        {"seed": -1},
        {"start": 1.5},
        {"crc": 5},
    ],
    ids=lambda change: str(change)[:40],
)
def test_an_index_line_of_another_kind_is_refused_by_name(tmp_path: Path, change: dict[str, Any]) -> None:
    store = add(tmp_path, EPISODES[:2])
    lines = [index_line(replace(store.tried[0], **change)), index_line(store.tried[1])]
    (tmp_path / "index.jsonl").write_bytes(b"".join(lines))
    with pytest.raises(ValueError, match=r"line 1 of .*index\.jsonl is damaged.*job=inspect"):
        EpisodeStore(tmp_path)
    assert EpisodeStore(tmp_path, damaged=True).tried[0].outcome == "lost"


def test_every_damaged_line_is_named(tmp_path: Path) -> None:
    add(tmp_path, EPISODES)
    path = tmp_path / "index.jsonl"
    lines = path.read_bytes().splitlines()
    path.write_bytes(
        b"\n".join(line.replace(b"colour", b"color") if n in (1, 3) else line for n, line in enumerate(lines)) + b"\n"
    )
    with pytest.raises(ValueError, match=r"line 2 of .*index\.jsonl is damaged: .*; so are the lines 4: keep"):
        EpisodeStore(tmp_path)
    path.write_bytes(b"#\n#\n")
    with pytest.raises(ValueError, match=r"line 1 of .*so are the lines 2: copy the folder again"):
        EpisodeStore(tmp_path, damaged=True)


def test_what_could_not_be_read_back_is_not_stored(tmp_path: Path) -> None:
    store = add(tmp_path, [])
    wordy = replace(EPISODES[0], instruction="a" * (LONGEST_INSTRUCTION + 1))
    with store.writing(), pytest.raises(ValueError, match=r"the entry of seed 0 .*instruction: .* at most 1000 char"):
        store.append(wordy)
    assert EpisodeStore(tmp_path).tried == [] and not (tmp_path / "rgb_front.bin").read_bytes()


def test_a_spec_comes_back_as_it_was() -> None:
    assert Spec.from_dict(ARM_SPEC.to_dict()) == ARM_SPEC
    with pytest.raises(ValueError, match=r"^x\.ckpt is damaged or of another kind: .*set"):
        Spec.from_dict({**ARM_SPEC.to_dict(), "cameras": {1}}, "x.ckpt")


def test_a_description_is_read_only_up_to_a_size_and_a_depth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = add(tmp_path, EPISODES[:1]).folder / "store.json"
    header = json.loads(path.read_text())
    nested: Any = {}
    for _ in range(100):
        nested = {"a": nested}
    path.write_text(json.dumps({**header, "config": nested}))
    with pytest.raises(ValueError, match=r"store\.json holds more than \d+ values, or more than \d+ levels"):
        EpisodeStore(tmp_path)
    path.write_text(json.dumps(header).replace('"config": {', '"config": {"a": ' + "[" * 10**5, 1))
    with pytest.raises(ValueError, match=r"store\.json is damaged or of another kind: .*recursion limit"):
        EpisodeStore(tmp_path)
    with path.open("w") as file:
        file.truncate(10**12)  # without contents on the disk
    with pytest.raises(ValueError, match=r"store\.json has 1000000000000 bytes, more than the \d+"):
        EpisodeStore(tmp_path)
