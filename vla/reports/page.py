"""Self-contained HTML pages: a title and parts, which are tables and sections."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vla.io.documents import read_bounded
from vla.io.errors import UserError, counted
from vla.io.files import write_text
from vla.reports.tables import DIFFERENCE, Table, in_words
from vla.rollouts.moving_picture import MAX_BYTES
from vla.rollouts.results import Result

WILSON = "Wilson's; those of several trainings account for correlation within trainings and within scenes"
EXACT_TEST_NOTE = (
    "of McNemar's exact test on episodes with the same seeds, and of Fisher's on others, with Newcombe's intervals"
)
EARLY_STOPPING_NOTE = "by betting, valid at any time, where playing stopped once the result was clear, and otherwise"
RATES = "Rates have 95 % confidence intervals ({})."
COMPARISON_NOTE = (
    "p is {}; p Holm is adjusted for all comparisons in the table, so that "
    "at most 5 % of tables have a false difference. The verdict is better or worse if p Holm is at most 0.05, else not "
    "worse by N points if the interval, which is not adjusted, excludes a loss of N percentage points, else open."
)


@dataclass(frozen=True)
class Section:
    """Part of a page, left out if it is empty."""

    title: str
    note: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)  # name → text or markup
    panels: Mapping[str, Markup] = field(default_factory=dict)  # title → SVG
    lines: Mapping[str, str] = field(default_factory=dict)  # name → colour in the panels
    rollouts: Sequence[tuple[Result, Path]] = ()
    picture: Path | None = None

    @property
    def rows(self) -> bool:
        """Whether there is anything to show; named like the rows of a `Table`."""
        return bool(self.facts or self.panels or self.rollouts or (self.picture and self.picture.is_file()))


def render(path: Path, title: str, parts: Sequence[Table | Section], anytime: bool = False, **content: Any) -> Path:
    """Write a page of the parts that are not empty, atomically, and return its path.

    For a run, `content` has `subtitle`, `warning`, the large `rate`, and `of`, a line that explains the rate.
    With `anytime` the results are valid whatever the reason to stop playing.
    """
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(embedded=_embedded, in_words=in_words, counted=counted)
    parts = [part for part in parts if part.rows]
    compares = any(isinstance(part, Table) and {*DIFFERENCE} <= {*part.heads} for part in parts)
    notes = f"{RATES} {COMPARISON_NOTE}" if compares else RATES
    content = dict.fromkeys(("subtitle", "warning", "rate", "of"), "") | content
    text = environment.get_template("page.html").render(
        title=title,
        parts=parts,
        written=f"{datetime.now():%Y-%m-%d %H:%M}",
        notes=notes.format(
            *(f"{EARLY_STOPPING_NOTE} {note}" if anytime else note for note in (WILSON, EXACT_TEST_NOTE))
        ),
        **content,
    )
    write_text(path, text)
    return path


def _embedded(picture: Path) -> str:
    """Return a picture as a data URL; raise a UserError for other files, which symbolic links could put into a page."""
    content = read_bounded(picture, MAX_BYTES)
    if not content.startswith((b"RIFF", b"\x89PNG")):
        raise UserError(f"{picture} is no picture: remove it")
    return f"data:image/{picture.suffix[1:]};base64,{b64encode(content).decode()}"
