"""Texts in pictures: whatever language they are in, a font that has their characters is found, or one sentence says
that there is none. matplotlib brings along DejaVu Sans, which has Arabic letters, and STIX, here a font of the system.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from PIL import Image

from vla.reports import pictures as fonts
from vla.reports.pictures import save, svgs

STIX = Path(matplotlib.get_data_path(), "fonts/ttf/STIXGeneral.ttf")
IN_STIX = "ᶁᶄ"  # and not in DejaVu Sans
CHINESE, JAPANESE, ARABIC = "拿起红色方块", "赤いブロックを持ち上げて", "التقط المكعب"
SENTENCE = "no font of this machine has some of the characters to be drawn"


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    """matplotlib says nothing, and nothing is known from the test before."""
    fonts.families_with.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    fonts.families_with.cache_clear()


@pytest.fixture
def only_stix(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A system whose other font is damaged."""
    (tmp_path / "Damaged.ttf").write_bytes(b"no font")
    monkeypatch.setattr(fonts, "findSystemFonts", lambda: [str(STIX), str(tmp_path / "Damaged.ttf")])


def drawn(text: str, path: Path) -> np.ndarray:
    """The picture of a single text."""
    save(path, {text: lambda axes: axes.axis("off")}, 1, (2, 0.5))
    return np.array(Image.open(path).convert("L"))


@pytest.mark.usefixtures("only_stix")
def test_a_font_is_found_by_the_characters_that_it_has(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    one, other = (drawn(each, tmp_path / "title.png") for each in IN_STIX)
    assert not np.array_equal(one, other)  # as boxes they would be equal
    drawn(f"{ARABIC} größer", tmp_path / "title.png")
    assert fonts.families_with(frozenset(ARABIC)) == ["DejaVu Sans"] and not caplog.messages


@pytest.mark.usefixtures("only_stix")
def test_without_a_font_one_sentence_says_so_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(2):
        drawn(CHINESE, tmp_path / "title.png")
    assert len(caplog.messages) == 1 and caplog.messages[0].startswith(SENTENCE)
    assert caplog.records[0].levelno == logging.WARNING


def test_instructions_are_drawn_where_the_system_has_a_font(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pictures = [drawn(each, tmp_path / "title.png").tobytes() for each in JAPANESE]
    assert caplog.messages or len({*pictures}) == len({*JAPANESE})
    caplog.clear()
    assert f">{CHINESE}<" in svgs({"": lambda axes: axes.text(0, 0, CHINESE)})[""]  # left to the fonts of the browser
    assert not caplog.messages
