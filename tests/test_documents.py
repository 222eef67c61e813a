"""JSON and YAML files that anybody may have written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from vla.documents import DEEPEST, STRICT, parse_json, parse_yaml, read_json, read_yaml, require_resolved
from vla.types import Range


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


@pytest.mark.parametrize(
    ("text", "kind", "says"),
    [
        ('{"size": 1.5, "names": ["x"], "z": 1}', Header, "size: Input should be a valid integer; z: Unexpected"),
        ("[1]", dict[str, Any], "Input should be an object"),
        ('{"a": NaN}', dict[str, float], "a: Input should be a finite number"),
        ("[2.0, 1.0]", Range, "ascending"),
        ("[" * 100_000, Any, "recursion limit exceeded"),
        ("[1", Any, "Invalid JSON"),
        (b"\xff", Any, "Invalid JSON"),
    ],
)
def test_json_of_another_kind_is_refused_by_name(text: str | bytes, kind: Any, says: str) -> None:
    with pytest.raises(ValueError, match=rf"^store is damaged or of another kind: .*{says}"):
        parse_json(text, kind, "store")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: &b [1]\nc: *b", "has aliases"),
        ("- " * (DEEPEST + 1) + "1", f"deeper than {DEEPEST}"),
        ("a: 2020-01-01", "date is not JSON"),
        ("!!python/object/apply:os.system [ls]", "constructor"),
        ("a: [", "expected"),
        (b"\xff", "invalid"),
    ],
)
def test_yaml_that_is_not_plain_is_refused_by_name(text: str | bytes, says: str) -> None:
    with pytest.raises(ValueError, match=rf"^run .*{says}"):
        parse_yaml(text, Any, "run")


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[0, 0, 0, 0]")
    with pytest.raises(ValueError, match=r"a\.json has 12 bytes, more than the 4"):
        read_json(tmp_path / "a.json", list, largest=4)


def test_a_configuration_out_of_a_file_is_resolved() -> None:
    within: list[Any] = [1, None, {"a": ("$", "{}")}]
    within.append(within)
    require_resolved({"model": within}, "store.json")
    for value in ("a ${b}", {"${b}": 1}, {"a": [(1, {"b": "${c}"})]}):
        with pytest.raises(ValueError, match=r"^store\.json holds the interpolation '.*\$\{.*': only resolved values"):
            require_resolved(value, "store.json")
    with pytest.raises(ValueError) as caught:
        require_resolved("${" + "x" * 10_000, "store.json")
    assert len(str(caught.value)) < 300
