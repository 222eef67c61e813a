"""Self-contained HTML pages: their templates, tables and the cells of tables."""

from __future__ import annotations

import os
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vla.config.differences import ABSENT
from vla.io.files import write_text
from vla.reports.conditions import SecondaryRows, comparison_texts, secondary_head, secondary_names, secondary_texts
from vla.reports.style import BLUE, GREEN, GREY, RED, Interval
from vla.rollouts.comparison import Comparison
from vla.runs.folder import PAGE, RECORDING

LONG = 100  # characters of a config value above which it is folded
EMBEDDED = {".png": "png", ".webp": "webp"}  # suffix of a picture → type
DIFFERENCE = ("difference [points]", "p", "p Holm", "verdict")  # heads of `difference`


@dataclass(frozen=True)
class PageTable:
    """A table of a page; cells are texts, or markup of the functions below."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    note: str = ""

    @cached_property
    def numeric(self) -> list[bool]:
        """Whether a column has numbers only, and is aligned at the right."""
        return [all(map(_is_number, cells)) and any(cells) for cells in zip(*self.rows, strict=True)]


def _is_number(cell: str) -> bool:
    number = r"[+-]?\d[\d.,/e+ -]*"
    return not cell or cell == ABSENT or re.fullmatch(rf"({number}|<b>{number}</b>)( <span.*)?", cell) is not None


def rate(interval: Interval) -> Markup:
    """Format a success rate with its interval, in percent and as a gauge."""
    middle, low, high = map(percent, interval)
    return Markup('{}&nbsp;<span class="soft nowrap">({}-{})</span>{}').format(middle, low, high, gauge(interval))


def gauge(interval: Interval) -> Markup:
    """Draw a success rate within its interval."""
    middle, low, high = interval
    shares = map(percent, (low, high - low, middle))
    bars = '<div class="gauge"><i style="left:{}%;width:{}%"></i><b style="left:{}%"></b></div>'
    return Markup(bars).format(*shares)


def percent(share: float) -> str:
    """Format a share in percent."""
    return f"{100 * share:.1f}"


def difference(found: Comparison | None) -> list[str]:
    """Format a difference in success, as four cells; empty ones without a comparison."""
    if found is None:
        return [""] * len(DIFFERENCE)
    points, interval, p, together, verdict = comparison_texts(found)
    return [beside(points, interval), p, together, verdict]


def beside(text: str, aside: str, decided: bool = False) -> Markup:
    """Format a text with a remark in brackets, bold if it is decided."""
    return Markup("<b>{}</b>" if decided else "{}").format(text) + Markup(' <span class="soft">({})</span>').format(
        aside
    )


def links(addresses: Mapping[str, str]) -> Markup:
    """Format text → address."""
    return Markup(" ").join(Markup('<a href="{}">{}</a>').format(address, name) for name, address in addresses.items())


def links_to(run: Path, page: Path) -> dict[str, str]:
    """Return name → address, relative to the folder `page`, of a run's page and recording."""
    return {
        name: quote(os.path.relpath(run / name, page).replace(os.sep, "/"))
        for name in (PAGE, RECORDING)
        if (run / name).is_file()
    }


def code(text: str) -> Markup:
    """Format a key or a command."""
    return Markup("<code>{}</code>").format(text)


def named(name: str, colour: str) -> Markup:
    """Format the name of a run behind the colour of its curves, if they have one."""
    line = Markup('<i style="background:{}"></i>').format(colour) if colour else ""
    return Markup('<div class="name">{}<span>{}</span></div>').format(line, name)


def value(content: Any) -> Markup:
    """Format a config value on one line of YAML, folded if it is long; empty if it is absent."""
    if content == ABSENT:
        return Markup()
    text = yaml.safe_dump(content, default_flow_style=True, width=10**6, allow_unicode=True, sort_keys=False).strip()
    text = text.removesuffix("...").strip()
    if len(text) <= LONG:
        return code(text)
    return Markup("<details><summary><code>{}…</code></summary><code>{}</code></details>").format(text[:60], text)


def secondary(rows: SecondaryRows, heads: Sequence[str], title: str) -> PageTable:
    """Tabulate differences in milestones and motion; `heads` are those of the words that begin a row."""
    names = secondary_names(rows)
    cells = [
        [
            *map(in_words, words),
            *(beside(*secondary_texts(each, metrics[each])) if each in metrics else "" for each in names),
        ]
        for words, metrics in rows.items()
        if metrics
    ]
    note = (
        "Milestones in all episodes, and medians of the differences in motion where both succeeded, with their 95 % "
        "confidence intervals. Less is faster, shorter, or smoother. Those in bold are decided: p Holm of at most "
        "0.05, adjusted for all in the table."
    )
    return PageTable([*heads, *map(secondary_head, names)], cells, title, note)


def in_words(name: str) -> str:
    """Return the name of a condition, an outcome or a milestone with spaces."""
    return name.replace("_", " ")


def duration(seconds: float) -> str:
    """Format a duration [s]."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def embedded(picture: Path) -> str:
    """Encode a picture as a data URL."""
    return f"data:image/{EMBEDDED[picture.suffix]};base64,{b64encode(picture.read_bytes()).decode()}"


def render(path: Path, template: str, **content: Any) -> Path:
    """Write a page atomically, and return its path."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(embedded=embedded, svg=Markup, in_words=in_words, percent=percent, gauge=gauge)
    environment.globals.update({"green": GREEN, "red": RED, "blue": BLUE, "grey": GREY})  # type: ignore[arg-type]
    page = environment.get_template(template).render(written=f"{datetime.now():%Y-%m-%d %H:%M}", **content)
    write_text(path, page)
    return path
