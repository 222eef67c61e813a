"""What the card of a store says, in a terminal, as text and as a picture."""

from __future__ import annotations

import io
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from figures import bars, heights, texts
from matplotlib.figure import Figure
from rich.console import Console
from toy_episodes import EPISODES, add

from vla.data.derivation import derive_store
from vla.data.episodes import EpisodeStore
from vla.data.verification import verify_store
from vla.reports import dataset_card
from vla.reports.dataset_card import store_table, write_card

DRAWS: list[dict[str, Any]] = [
    {"light": {"tint": [0.1 * seed, 0.2, 0.3], "on": seed > 1}, "names": ["red", f"$|[{seed}]"], "far": 0.5, "n": seed}
    | {"pad": [0.1 * seed, -0.2], "blocks": [[0.1, 0.2], [0.3, 0.1 * seed]], "four": [1.0, 2.0, 3.0, float(seed)]}
    | ({"nothing": None, "some": [0.5] * seed} if seed < 2 else {"nested": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.1 * seed]]})
    for seed in range(5)
]


def described(store: EpisodeStore) -> tuple[str, str]:
    findings, console = verify_store(store), Console(width=120, record=True, file=io.StringIO())
    console.print(store_table(findings))
    return console.export_text(), write_card(findings).read_text(encoding="utf-8")


def test_the_card_tells_what_is_there(tmp_path: Path, figures: list[Figure]) -> None:
    table, text = described(add(tmp_path / "store", EPISODES))
    steps = sum(len(episode.actions) for episode in EPISODES if episode.success)
    time = f"{steps / 600:.1f} min at 10 Hz"
    for words in ("4 intact, of 5 seeds tried: 0 to 4", f"{steps}, from", time, "80.0 %", "1 timeout", "front, wrist"):
        assert words in table and words in text
    low, high = (ends for ends in zip(*(e.draws["point"] for e in EPISODES if e.success), strict=True))
    numbers = [*low, *high]
    assert text.startswith("# store\n") and f"point | {min(numbers):.4g} … {max(numbers):.4g}" in text
    assert "gripper | 1 | 1 | 1 | 1 | 0" in text and "uint8 16 x 16 x 3 per step" in text
    assert '"size": 1.0' in text
    found = {axes.get_title(): axes for axes in figures[0].axes}
    assert bars(found["outcomes of all seeds"]) == [4, 1]
    assert {" 4  success", " 1  timeout"} <= texts(found["outcomes of all seeds"])
    assert sum(heights(found["length of episodes [steps]"])) == 4
    for component in ("x [m]", "y [m]", "gripper"):
        assert sum(heights(found[component])) == steps
    sheet = [axes for axes in figures[0].axes if axes.images]
    assert len(sheet) == 4 and len(np.unique(sheet[0].images[0].get_array())) > 10


def test_the_card_is_the_same_wherever_the_store_is(tmp_path: Path) -> None:
    first = add(tmp_path / "store", EPISODES).folder
    described(EpisodeStore(first))
    second = Path(shutil.copytree(first, tmp_path / "elsewhere" / "store"))
    before = {name: (second / name).read_bytes() for name in ("card.md", "card.png")}
    described(EpisodeStore(second))
    assert {name: (second / name).read_bytes() for name in before} == before
    assert not list(second.glob("*.partial"))


def test_anything_that_can_be_drawn_can_be_shown(tmp_path: Path, figures: list[Figure]) -> None:
    episodes = [replace(episode, draws=draws) for episode, draws in zip(EPISODES, DRAWS, strict=True)]
    _, text = described(add(tmp_path / "five", episodes))
    assert "light.tint | 0 … 0.4" in text and r"names | $\|[0], $\|[1], $\|[2], $\|[4], red" in text
    described(add(tmp_path / "one", episodes[:1]))
    five, one = ({axes.get_title(): axes for axes in figure.axes if not axes.images} for figure in figures)
    assert {*five} - {*one} == {"light.tint", "light.on", "names", "n", "pad", "blocks", "four", "nested", "some"}
    assert all(axes.has_data() for panel in (five, one) for axes in panel.values())


def test_a_component_that_differs_by_rounding_alone_has_a_panel(tmp_path: Path, figures: list[Figure]) -> None:
    actions = EPISODES[0].actions.copy()
    actions[:, 0] = 1.5707964
    actions[::2, 0] = 1.5707965
    _, text = described(add(tmp_path / "still", [replace(EPISODES[0], actions=actions)]))
    assert text and figures


def test_a_store_that_was_put_together_says_of_what(tmp_path: Path) -> None:
    store = add(tmp_path / "store", EPISODES)
    derive_store([store], tmp_path / "chosen", {"seed": [1, 2]})
    _, text = described(EpisodeStore(tmp_path / "chosen"))
    assert "Chosen by `inspect.where={'seed': [1, 2]}`." in text and "2 seeds, 1, 2:" in text


def test_of_very_many_draws_some_are_shown(tmp_path: Path, figures: list[Figure], monkeypatch: Any) -> None:
    monkeypatch.setattr(dataset_card, "MAX_DRAW_PANELS", 3)
    draws = [{f"d{number}": float(seed * (number + 1)) for number in range(9)} for seed in range(5)]
    described(add(tmp_path, [replace(each, draws=drawn) for each, drawn in zip(EPISODES, draws, strict=True)]))
    assert {axes.get_title() for axes in figures[0].axes} >= {"d0", "d1", "d2"}
    assert "d3" not in {axes.get_title() for axes in figures[0].axes}
