"""Fonts of this machine for characters that matplotlib's own lacks, as in instructions in Chinese or Japanese."""

from __future__ import annotations

import logging
from functools import cache

from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, findSystemFonts, fontManager, get_font
from matplotlib.text import Text

log = logging.getLogger(__name__)


def use_fonts(figure: Figure) -> None:
    """Let the texts of a figure fall back on fonts of the machine; one sentence says if none has a character."""
    texts = [text for text in figure.findobj(Text) if isinstance(text, Text)]
    families = families_with(frozenset(each for text in texts for each in text.get_text() if ord(each) > 0x24F))
    for text in texts if families else ():
        text.set_fontfamily([*text.get_fontfamily(), *families])


@cache
def families_with(characters: frozenset[str]) -> list[str]:
    """Return the families of as few fonts as have the characters together: matplotlib's own, then the best one."""
    files = (findfont(FontProperties()), *sorted(findSystemFonts(), key=lambda file: ("Regular" not in file, file)))
    fonts, missing, found = {file: _within(file, characters) for file in files if characters}, characters, list[str]()
    while missing and fonts[best := max(fonts, key=lambda file: len(fonts[file] & missing))] & missing:
        fontManager.addfont(best)  # its own list may be older
        found.append(get_font(best).family_name)
        missing -= fonts[best]
    if missing:
        log.warning(
            "no font of this machine has some of the characters to be drawn, so pictures show boxes in their place: "
            "install one, such as the package fonts-noto-cjk for Chinese, Japanese and Korean"
        )
    return found


def _within(file: str, characters: frozenset[str]) -> frozenset[str]:
    """Return which of the characters a font has; none of what cannot be read."""
    try:
        return frozenset(each for each in characters if get_font(file).get_char_index(ord(each)))
    except (OSError, RuntimeError):
        return frozenset()
