"""Tables of results, for a terminal, as Markdown and on a page, and the formatting of their cells."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import yaml
from markupsafe import Markup
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table as RichTable

from vla.config.differences import ABSENT
from vla.rollouts.comparison import Comparison
from vla.rollouts.results import Rate

LONG = 200  # characters of a config value that are shown
NUMBER = re.compile(r"([+-]?\d[\d.,/e+ -]*( \(.*\))?|-|)")
DIFFERENCE = ("difference [points]", "p", "p Holm", "verdict")  # heads of `difference`


@dataclass(frozen=True)
class Table:
    """Table of texts, and of `links` where only a page shows them."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    note: str = ""
    details: Sequence[str] = ()  # heads of columns for which a terminal is too narrow

    @cached_property
    def numeric(self) -> list[bool]:
        """Whether a column has numbers only, and is aligned at the right."""
        return [all(map(NUMBER.fullmatch, cells)) and any(cells) for cells in zip(*self.rows, strict=True)]

    def __rich__(self) -> RichTable:
        """Return the table for a terminal of 80 columns."""
        columns = [column for column, head in enumerate(self.heads) if head not in self.details]
        style: dict[str, Any] = {"box": SIMPLE_HEAD, "collapse_padding": True, "pad_edge": False}
        table = RichTable(title=escape(self.title), caption=escape(self.note), **style)
        for column in columns:
            table.add_column(escape(self.heads[column]))
        for row in self.rows:
            table.add_row(*(escape(row[column]) for column in columns))
        return table

    def markdown(self) -> str:
        """Return the table without title and note; pipes and line breaks in cells are escaped."""
        lines = [self.heads, ["---"] * len(self.heads), *self.rows]
        cells = [[cell.replace("|", "\\|").replace("\n", "<br>") for cell in line] for line in lines]
        return "".join(f"| {' | '.join(line)} |\n" for line in cells)


def rate(interval: Rate) -> str:
    """Return a success rate with its interval, in percent."""
    return "{} ({}-{})".format(*map(percent, interval))


def percent(share: float) -> str:
    """Return a share in percent."""
    return f"{100 * share:.1f}"


def difference(comparison: Comparison | None) -> list[str]:
    """Return a difference in success as the cells of `DIFFERENCE`; empty ones without a comparison."""
    if comparison is None:
        return [""] * len(DIFFERENCE)
    middle, low, high = (
        f"{100 * share:+.1f}" for share in (comparison.difference, comparison.ci_low, comparison.ci_high)
    )
    p_holm = "" if comparison.p_holm is None else f"{comparison.p_holm:.2g}"
    return [f"{middle} ({low} to {high})", f"{comparison.p:.2g}", p_holm, comparison.verdict]


def links(addresses: Mapping[str, str]) -> Markup:
    """Return links, text → address."""
    return Markup(" ").join(Markup('<a href="{}">{}</a>').format(address, text) for text, address in addresses.items())


def config_value(content: Any) -> str:
    """Return a config value on one line of YAML, cut if it is long."""
    text = yaml.safe_dump(content, default_flow_style=True, width=10**6, allow_unicode=True, sort_keys=False)
    text = text.strip().removesuffix("...").strip()
    return content if content == ABSENT else text if len(text) <= LONG else f"{text[:LONG]}…"


def in_words(name: str) -> str:
    """Return the name of a condition, an outcome or a milestone with spaces."""
    return name.replace("_", " ")


def unit_suffix(unit: str) -> str:
    """Format a unit for the title of a plot, as " [m]"; "" for none."""
    return "" if unit == "1" else f" [{unit}]"


def duration(seconds: float) -> str:
    """Return a duration [s] in words."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
