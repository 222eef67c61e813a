"""JSON and YAML files that anybody may have written."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from vla.io.documents import MAX_DEPTH, STRICT, parse_json, read_json, read_resolved, read_yaml, resolve_config
from vla.io.errors import UserError
from vla.io.types import NonNegativeRange


@dataclass
class Header:
    """A file as the tests have it."""

    __pydantic_config__ = STRICT

    size: int
    names: tuple[str, ...]


def test_a_file_is_read_as_its_type(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"size": 1, "names": ["x"]}')
    (tmp_path / "a.yaml").write_text("size: 1\nnames: [x]\n")
    assert read_json(tmp_path / "a.json", Header) == read_yaml(tmp_path / "a.yaml", Header) == Header(1, ("x",))


def test_a_pipe_a_device_or_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "endless").symlink_to("/dev/zero")
    for name in ("pipe", "endless"):
        with pytest.raises(UserError, match=rf"{name} is a folder, a pipe or a device, not a file"):
            read_json(tmp_path / name, Header)
    (tmp_path / "a.json").write_text("[0, 0, 0, 0]")
    with pytest.raises(UserError, match=r"a\.json has 12 bytes, more than the 4"):
        read_json(tmp_path / "a.json", list, max_bytes=4)


@pytest.mark.parametrize(
    ("text", "kind", "says"),
    [
        ('{"size": 1.5, "names": ["x"], "z": 1}', Header, "size: Input should be a valid integer; z: Unexpected"),
        ("[1]", dict[str, Any], "Input should be an object"),
        ('{"a": NaN}', dict[str, float], "a: Input should be a finite number"),
        ("[2.0, 1.0]", NonNegativeRange, "ascending"),
        ("[" * 100_000, Any, "recursion limit exceeded"),
        ("[1", Any, "Invalid JSON"),
        (b"\xff", Any, "Invalid JSON"),
    ],
)
def test_json_of_another_kind_is_refused_by_name(text: str | bytes, kind: Any, says: str) -> None:
    with pytest.raises(UserError, match=rf"^store is damaged or of another kind: .*{says}"):
        parse_json(text, kind, "store")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: &b [1]\nc: *b", "with aliases"),
        ("- " * (MAX_DEPTH + 1) + "1", f"deeper than {MAX_DEPTH}"),
        ("a: 2020-01-01", "date is not JSON"),
        ("!!python/object/apply:os.system [ls]", "constructor"),
        ("a: [", "expected"),
        ("a: 2020-99-99", "month must be in 1..12"),
        (b"\xff", "invalid"),
        ("a: 1" + ":1" * 500_000, "with aliases or numbers of 100 digits"),  # which take minutes
    ],
)
def test_yaml_that_is_not_plain_is_refused_by_name(tmp_path: Path, text: str | bytes, says: str) -> None:
    (tmp_path / "run.yaml").write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(UserError, match=rf"/run\.yaml is no plain YAML: .*{says}"):
        read_yaml(tmp_path / "run.yaml", Any)


def test_a_configuration_out_of_a_file_is_plain_and_resolved() -> None:
    value = {"model": [1, None, {"a": ("$", "{}")}]}
    assert repr(resolve_config(value, "store.json")) == repr({"model": [1, None, {"a": ["$", "{}"]}]})  # without tuples
    for value in ("a ${b}", {"${b}": 1}, {"a": [(1, {"b": "${c}"})]}, "${" + "x" * 10_000):
        with pytest.raises(UserError, match=r"^store\.json holds the reference '.*\$\{.*': only resolved") as caught:
            resolve_config(value, "store.json")
        assert len(str(caught.value)) < 300
    for unusual in ({"a": object()}, [b"x"], {1}):
        with pytest.raises(UserError, match="which is no plain data"):
            resolve_config(unusual, "store.json")
    for key in (5, True, math.nan, None, 1j):
        with pytest.raises(UserError, match=f"^store.json holds the key {key}, which is no text$"):
            resolve_config({"a": {key: 1}}, "store.json")


def test_half_a_character_is_refused_before_anything_is_made_of_it(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"learner": ["\\ud800"]}')
    with pytest.raises(UserError, match=r"config\.json is damaged or of another kind: .*surrogates not allowed"):
        read_resolved(tmp_path / "config.json")
