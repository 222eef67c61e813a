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
from vla.io.parts import Part
from vla.spec import LONGEST_INSTRUCTION, Spec

NAN = float("nan")
NESTED = json.loads('{"a": ' * 100 + "1" + "}" * 100)

SPECS: list[dict[str, Any]] = [
    *({"cameras": value} for value in (5, ["../../front", "wrist"], ["front", "front"])),
    *({"image_size": value} for value in ([-1, -1], ["a", "b"], [5000, 16])),
    *({"action": []}, {"state": ["x" * 10_000]}, {"state_units": ["m"]}, {"depth": ["side"]}, {"units": ["m"]}),
    *({"low": [1.0, 1.0, 1.0]}, {"low": [NAN, 0.0, 0.0]}, {"control_hz": 0}, {"control_hz": NAN}),
    {"robot": {"joints": ["elbow"], "frame": "base"}},
    {"robot": {"joints": ["joint1", "joint2"], "frame": "base", "velocities": ["speed1"]}},
    {"robot": {"joints": ["joint1"], "frame": "base", "chain": [[0.0] * 7]}},
    *({"truth": [["target", -2]]}, {"more": 1}),
]


@pytest.mark.parametrize(
    "change",
    [
        *({"spec": spec} for spec in (3, None, *({**ARM_SPEC.to_dict(), **wrong} for wrong in SPECS))),
        *({"codec": codec} for codec in (None, "lossless", {"images": "zlib"}, {"images": "jpeg"})),
        *({"codec": {"images": images, "quality": quality}} for images, quality in (("jpeg", 100), ("lossless", 90))),
        *({"config": config} for config in (None, [], {"task": "${oc.env:HOME}"}, {"size": NAN}, NESTED)),
        *({"config": {"parts": parts, "where": []}} for parts in (None, [[{}, 10**30]])),
        *({"fields": {}}, {"format": "2"}, {"format": 9}),
    ],
    ids=lambda change: str(change)[-60:],
)
def test_a_description_of_another_kind_is_refused_by_name(tmp_path: Path, change: dict[str, Any]) -> None:
    path = add(tmp_path, EPISODES[:1]).folder / "store.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ValueError, match=r"store\.json.*: .*collect again") as caught:
        EpisodeStore(tmp_path, allow_damage=True)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"{", "is damaged or of another kind"),
        (b'{"format": 3}', "is damaged or of another kind: .*Field required"),
        (b'{"format": 3, "config": ' + b"[" * 10**5, "is damaged or of another kind: .*recursion limit"),
        (None, r"has 1000000000000 bytes, more than the \d+"),
    ],
)
def test_a_garbled_description_is_named_with_the_way_out(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = add(tmp_path, []).folder / "store.json"
    with path.open("wb") as file:
        file.truncate(10**12) if content is None else file.write(content)  # without contents on the disk
    with pytest.raises(ValueError, match=rf"store\.json {says}.*collect again"):
        EpisodeStore(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        *({"draws": draws} for draws in (None, "text", {"mass": [1.0, [10**400]]})),
        *({"outcome": 5}, {"steps": 0}, {"task": 5}, {"milestones": "near"}, {"start": 1.5}, {"crc": 5}),
        *({"instruction": text} for text in (5, "a" * (LONGEST_INSTRUCTION + 1))),
        *({"seed": seed} for seed in (10**30, -1)),
    ],
    ids=lambda change: str(change)[:40],
)
def test_an_index_line_of_another_kind_is_refused_by_name(tmp_path: Path, change: dict[str, Any]) -> None:
    store = add(tmp_path, EPISODES[:2])
    lines = [index_line(replace(store.attempts[0], **change)), index_line(store.attempts[1])]
    (tmp_path / "index.jsonl").write_bytes(b"".join(lines))
    with pytest.raises(ValueError, match=r"line 1 of .*index\.jsonl is damaged.*job=inspect"):
        EpisodeStore(tmp_path)
    assert EpisodeStore(tmp_path, allow_damage=True).attempts[0].outcome == "lost"


def test_every_damaged_line_is_named(tmp_path: Path) -> None:
    store = add(tmp_path, EPISODES)
    path = tmp_path / "index.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    for number in (1, 3):
        lines[number] = lines[number].replace(b"colour", b"color")
    path.write_bytes(b"".join(lines))
    with pytest.raises(
        ValueError, match=r"line 2 of .* is damaged: it does not fit its checksum; so are the lines 4: keep"
    ):
        EpisodeStore(tmp_path)
    path.write_bytes(b"#\n#\n")
    with pytest.raises(ValueError, match=r"line 1 of .*so are the lines 2: copy the folder again"):
        EpisodeStore(tmp_path, allow_damage=True)
    path.write_bytes(lines[0] + index_line(replace(store.attempts[1], seed=10**6)))
    with pytest.raises(
        ValueError, match=r"index\.jsonl has too few lines for its seeds, 0 to 1000000: copy the folder again"
    ):
        EpisodeStore(tmp_path, allow_damage=True)


def test_what_could_not_be_read_back_is_not_stored(tmp_path: Path) -> None:
    store = add(tmp_path, [])
    wordy = replace(EPISODES[0], instruction="a" * (LONGEST_INSTRUCTION + 1))
    with store.writing(), pytest.raises(ValueError, match=r"the entry of seed 0 .*instruction: .* at most 1000 char"):
        store.append(wordy)
    assert EpisodeStore(tmp_path).attempts == [] and not (tmp_path / "rgb_front.bin").read_bytes()


def test_a_spec_comes_back_as_it_was() -> None:
    assert Spec.from_dict(ARM_SPEC.to_dict()) == ARM_SPEC
    for part, says in (
        (Part("roof"), "parts names roof, which is not among the cameras"),
        (Part("wrist", (0.5, 0.0, 0.5, 1.0)), r"the window of wrist is \(0\.5, 0\.0, 0\.5, 1\.0\), not top, left"),
        (Part("wrist", (0.5, 0.5, 1.5, 1.5)), "the window of wrist ends outside the picture"),
        (Part("wrist", point=("x", "y", "z")), "the part of wrist moves with x, y, z, which is not in the state"),
        (Part("wrist", point=("joint1", "joint2", "joint3")), "the part of wrist needs 3 names in point, 3 numbers"),
    ):
        with pytest.raises(ValueError, match=rf"^the spec is not valid: {says}"):
            Spec.from_dict(replace(ARM_SPEC, parts=(part,)).to_dict())
    with pytest.raises(ValueError, match=r"is not valid: cameras names state, text, as another input of policies is"):
        Spec.from_dict(replace(ARM_SPEC, cameras=("state", "text"), depth=()).to_dict())
    with pytest.raises(ValueError, match=r"^x\.ckpt is damaged or of another kind: .*set"):
        Spec.from_dict({**ARM_SPEC.to_dict(), "cameras": {1}}, "x.ckpt")
