"""Texts in pictures: whatever language they are in, a font that has their characters is found, or one sentence says
that there is none. matplotlib brings along DejaVu Sans, which has Arabic letters, and STIX, here a font of the system.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from PIL.ImageFont import FreeTypeFont
from toy import SPEC, make_environment

from vla.reports import fonts
from vla.reports.first_batch import draw_samples
from vla.reports.resets import contact_sheet
from vla.reports.style import as_svg, save

STIX = Path(matplotlib.get_data_path(), "fonts/ttf/STIXGeneral.ttf")
IN_STIX = "ᶁᶄ"  # and not in DejaVu Sans
CHINESE, JAPANESE, ARABIC = "拿起红色方块", "赤いブロックを持ち上げて", "التقط المكعب"
SENTENCE = "no font of this machine has some of the characters to be drawn"


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    """matplotlib says nothing, and nothing is known from the test before."""
    fonts.fonts_with.cache_clear()
    fonts._say_missing.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    fonts.fonts_with.cache_clear()


@pytest.fixture
def only_stix(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A system whose other font is damaged."""
    (tmp_path / "Damaged.ttf").write_bytes(b"no font")
    monkeypatch.setattr(fonts, "findSystemFonts", lambda: [str(STIX), str(tmp_path / "Damaged.ttf")])


def batch(instructions: list[str]) -> dict[str, Any]:
    size, count = SPEC.image_size, len(instructions)
    images = {"eye": np.zeros((count, 1, *size, 3), np.uint8)}
    return {"rgb": images, "action": np.zeros((count, 1, 1, 3), np.float32), "instruction": instructions}


def title(text: str, path: Path) -> np.ndarray:
    """The picture of a single text."""
    figure = Figure(figsize=(2, 0.5))
    figure.text(0.1, 0.3, text)
    save(figure, path)
    return np.array(Image.open(path).convert("L"))


@pytest.mark.usefixtures("only_stix")
def test_a_font_is_found_by_the_characters_that_it_has(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert fonts.fonts_with(frozenset(IN_STIX)) == [str(STIX)]
    assert fonts.fonts_with(frozenset("")) == []
    one, other = (title(each, tmp_path / "title.png") for each in IN_STIX)
    assert not np.array_equal(one, other)  # as boxes they would be equal
    plain, accented = fonts.image_fonts(["red", f"{IN_STIX} red"], 13)
    assert isinstance(accented, FreeTypeFont) and isinstance(plain, FreeTypeFont)
    assert accented.getname()[0] == "STIXGeneral" != plain.getname()[0]
    assert not caplog.messages


@pytest.mark.usefixtures("only_stix")
def test_without_a_font_one_sentence_says_so_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    draw_samples(batch([CHINESE, JAPANESE, "red"]), SPEC, tmp_path / "samples.png")
    draw_samples(batch([JAPANESE]), SPEC, tmp_path / "samples.png")
    contact_sheet([0], [replace(make_environment().reset(0), instruction=CHINESE)])
    assert len(caplog.messages) == 1 and caplog.messages[0].startswith(SENTENCE)
    assert caplog.records[0].levelno == logging.WARNING
    assert np.array(Image.open(tmp_path / "samples.png")).std() > 1


@pytest.mark.usefixtures("only_stix")
def test_arabic_needs_no_font_of_the_system(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    draw_samples(batch([ARABIC]), SPEC, tmp_path / "samples.png")
    contact_sheet([0], [replace(make_environment().reset(0), instruction=ARABIC)])
    assert not caplog.messages


@pytest.mark.parametrize("text", [CHINESE, JAPANESE])
def test_instructions_are_drawn_where_the_system_has_a_font(
    text: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    draw_samples(batch([text]), SPEC, tmp_path / "samples.png")
    drawn = [title(each, tmp_path / "title.png") for each in dict.fromkeys(text)]
    distinct = {picture.tobytes() for picture in drawn}
    if fonts._say_missing.cache_info().currsize:
        assert [message.startswith(SENTENCE) for message in caplog.messages] == [True]
    else:
        assert len(distinct) == len(drawn) and not caplog.messages


def test_a_page_leaves_the_fonts_to_the_browser(caplog: pytest.LogCaptureFixture) -> None:
    figure = Figure()
    figure.text(0, 0, CHINESE)
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        assert CHINESE in as_svg(figure)
    assert not caplog.messages
