"""What is said in training, and what only in evaluation."""

from __future__ import annotations

import itertools
import re
from typing import Any

import numpy as np
import pytest
from composing import composed
from conftest import CONF, make_tabletop
from hydra.utils import instantiate

from vla.config.build import build
from vla.config.compose import axes
from vla.config.experiment import Experiment, to_plain
from vla.io.documents import read_yaml
from vla.spec import FIRST_SEED
from vla.tasks.tabletop.language import Grammar, HeldOutKind, Silence
from vla.tasks.tabletop.randomize.episode import paraphrase
from vla.tasks.tabletop.scene import COLOURS, PADS

GRAMMAR = Grammar(
    phrasings=["{put} the {block} block there", "the {block} block, please"],
    words={"put": ["put", "place"]},
    held_out_phrasings=["there goes the {block} block"],
    held_out_words={"put": ["set"]},
    held_out_colours=["red"],
)


def instructions(held_out: HeldOutKind | None) -> set[str]:
    return {GRAMMAR.say({"block": "blue"}, held_out, np.random.RandomState(seed)) for seed in range(50)}


def test_training_uses_every_phrasing_and_word_that_is_not_held_out() -> None:
    expected = {"put the blue block there", "place the blue block there", "the blue block, please"}
    assert instructions(None) == instructions("combinations") == expected


def test_a_held_out_instruction_has_one_kind_of_novelty() -> None:
    assert instructions("words") == {"set the blue block there"}
    assert instructions("phrasings") == {"there goes the blue block"}
    assert GRAMMAR.held_out_kinds == ("words", "phrasings", "combinations")


def test_a_held_out_part_that_training_uses_is_refused() -> None:
    with pytest.raises(ValueError, match=r"what training also uses: \['put'\]"):
        Grammar(["{put} {block}"], {"put": ["put"]}, ["{block}"], {"put": ["put"]}, [])
    with pytest.raises(ValueError, match="held_out_words has no slot of the phrasings"):
        Grammar(["take {block}"], {}, ["{put} {block}"], {"put": ["set"]}, [])


def test_other_words_replace_all_that_is_named_or_nothing_is_said() -> None:
    words = {"the pad": "the disc", "the red block": "the crimson cube", "the red": "the other"}
    said = paraphrase("put the red block on the pad", words, ["red"])
    assert said == "put the crimson cube on the disc"
    for instruction in ("put the red cup on the pad, the red one", "lift the redder block"):
        with pytest.raises(
            ValueError, match=r"task\.randomize\.phrasing\.words must replace everything .* in '(put|lift) "
        ):
            paraphrase(instruction, {"the pad": "the disc"}, ["red"])


def test_a_word_that_the_goal_fills_is_refused() -> None:
    with pytest.raises(ValueError, match=r"task\.goal\.language has words for pad, slots that goals fill"):
        build(to_plain(composed("task/goal=place", "+task.goal.language.words.pad=[pad,disc]").task), "task")


def heard() -> set[str]:
    """Every word of a training instruction, of any goal."""
    said = {*COLOURS, *PADS}
    for path in (CONF / "task/goal").glob("*.yaml"):
        language = read_yaml(path, dict[str, Any]).get("language", {})
        said |= {*language.get("phrasings", ()), *itertools.chain(*language.get("words", {}).values())}
    return {word for each in said for word in re.findall(r"\w+", re.sub(r"{\w+}", "", each))}


UNSEEN = axes()["task/randomize/phrasing"]["unseen_names"]["words"]
GRAMMATICAL = {"the", "one", "that", "looks", "like", "a", "an"}


def test_no_word_that_names_something_unseen_is_in_any_training_instruction() -> None:
    new = {word for others in UNSEEN.values() for other in others for word in other.split()} - GRAMMATICAL
    assert {"crimson", "scarlet", "navy", "emerald", "golden", "cube", "brick", "disc", "spot", "tomato"} <= new
    assert {"red", "block", "pad", "black", "put"} <= heard() and not new & heard()
    named = [name for others in UNSEEN.values() for name in others]
    assert len(named) == len(set(named))
    things = [*(f"{colour} block" for colour in COLOURS), "pad", *(f"{pad} pad" for pad in PADS)]
    assert {*UNSEEN} == {f"the {thing}" for thing in things}


def test_an_instruction_with_unseen_names_is_the_plain_one_with_other_names() -> None:
    node = Experiment.from_config(composed("evaluate=unseen_names")).evaluate.changes["unseen_names"]["randomize"][
        "phrasing"
    ]
    environment = make_tabletop("task/goal=mixed", "task/randomize=none")
    task = environment.simulation
    axes = {"plain": task.randomize, "renamed": {**task.randomize, "phrasing": instantiate(node)}}

    def reset(seed: int, name: str) -> dict[str, Any]:
        task.randomize = axes[name]
        environment.reset(seed)
        return environment.draws

    with environment.blind():
        for seed in range(FIRST_SEED, FIRST_SEED + 30):
            plain_names, renamed = reset(seed, "plain"), reset(seed, "renamed")
            assert renamed["named"] == plain_names["named"] and renamed["language"]["held_out"] == "names"
            said = plain_names["language"]["instruction"]
            phrases = [phrase for phrase in UNSEEN if phrase in said]
            possible = set()
            for others in itertools.product(*(UNSEEN[phrase] for phrase in phrases)):
                other = said
                for phrase, name in zip(phrases, others, strict=True):
                    other = other.replace(phrase, name)
                possible.add(other)
            assert renamed["language"]["instruction"] in possible
        assert reset(0, "renamed")["language"] == reset(0, "plain")["language"]  # in training it changes nothing
    environment.close()


def draws(goal: str, level: str, first: int, count: int) -> list[dict[str, Any]]:
    environment = make_tabletop(f"task/goal={goal}", f"task/randomize={level}")
    drawn = []
    with environment.blind():
        for seed in range(first, first + count):
            environment.reset(seed)
            drawn.append(environment.draws)
    environment.close()
    return drawn


def test_wide_evaluation_says_only_what_training_never_says() -> None:
    training = {draw["language"]["instruction"] for draw in draws("pick_place", "wide", 0, 150)}
    evaluation = [draw["language"] for draw in draws("pick_place", "wide", FIRST_SEED, 60)]
    assert not training & {language["instruction"] for language in evaluation}
    assert {language["held_out"] for language in evaluation} == {"words", "phrasings"}
    assert {draw["language"]["held_out"] for draw in draws("pick_place", "default", FIRST_SEED, 5)} == {"none"}


def test_in_a_mixture_some_colours_are_named_with_some_goals_in_evaluation_only() -> None:
    held_out = {"Lift": "yellow", "PickPlace": "blue", "Stack": "green", "Push": "red"}
    training = draws("mixed", "wide", 0, 150)
    assert {draw["named"]["goal"] for draw in training} == {*held_out, "PickPlaceTwo"}
    assert all(draw["named"]["colour"] != held_out.get(draw["named"]["goal"]) for draw in training)
    new = [draw for draw in draws("mixed", "wide", FIRST_SEED, 100) if draw["language"]["held_out"] == "combinations"]
    assert new and all(draw["named"]["colour"] == held_out[draw["named"]["goal"]] for draw in new)


def test_the_same_scene_is_asked_for_another_block() -> None:
    one = make_tabletop("task/randomize=wide")
    other = make_tabletop("task/randomize=wide", "task/randomize/naming=swapped")
    for seed in range(FIRST_SEED, FIRST_SEED + 10):
        first, second = one.reset(seed), other.reset(seed)
        np.testing.assert_array_equal(first.rgb["front"], second.rgb["front"])
        named = [environment.draws["named"]["colour"] for environment in (one, other)]
        assert named[0] != named[1]
        assert all(colour in seen.instruction for colour, seen in zip(named, (first, second), strict=True))
    one.close()
    other.close()


def test_another_block_is_asked_for_with_something_new_and_one_thing_only() -> None:
    swapped = make_tabletop(
        *("task/goal=mixed", "task.goal.impossible=0.0625", "task.goal.silent=0.0625"),
        *("task/randomize=wide", "task/randomize/naming=swapped"),
    )
    found = set()
    for seed in range(FIRST_SEED, FIRST_SEED + 60):
        with swapped.blind():
            swapped.reset(seed)
        (request,) = swapped.simulation.requests
        grammar = request.goal.language
        if request.goal.absent or not request.instruction:
            continue
        colour = swapped.simulation.compiled.block_names[request.referents.blocks[0]]
        assert (request.held_out == "combinations") == (colour in grammar.held_out_colours)
        found.add(request.held_out)
    assert found == {"combinations", "phrasings", "words"}


def test_another_block_that_training_names_has_no_held_out_colour() -> None:
    swapped = make_tabletop("task/goal=mixed", "task/randomize=wide", "task/randomize/naming=swapped")
    with swapped.blind():
        for seed in range(60):
            swapped.reset(seed)
            (request,) = swapped.simulation.requests
            colour = swapped.simulation.compiled.block_names[request.referents.blocks[0]]
            assert request.held_out == "none" and colour not in request.goal.language.held_out_colours


def test_held_out_colours_leave_one_to_name() -> None:
    all_but_one = "task.goal.language.held_out_colours=[green,blue,yellow]"
    environment = make_tabletop(all_but_one, "task.randomize.distractors.count=[1,1]")
    with environment.blind(), pytest.raises(ValueError, match="all blocks of a scene have such a colour"):
        for seed in range(20):
            environment.reset(seed)


def test_the_standard_benchmark_also_asks_for_nothing_and_for_what_cannot_be_done() -> None:
    alone = make_tabletop("task/randomize=wide")
    standard = make_tabletop("experiment=standard", "task.goal.impossible=0.3", "task.goal.silent=0.2")
    training = {draw["language"]["instruction"] for draw in draws("pick_place", "wide", 0, 50)}
    kinds: dict[str, int] = {}
    with alone.blind(), standard.blind():
        for seed in range(FIRST_SEED, FIRST_SEED + 30):
            one, other = alone.reset(seed), standard.reset(seed)
            kinds[standard.task] = kinds.get(standard.task, 0) + 1
            assert (one.state == other.state).all() and alone.draws["placement"] == standard.draws["placement"]
            if standard.task == "pick_place":
                assert alone.draws == standard.draws
            elif standard.task == "stay":
                compiled = standard.simulation.compiled
                assert not any(colour in other.instruction for colour in compiled.block_names[: compiled.present])
                assert any(colour in other.instruction for colour in COLOURS)
                assert standard.draws["language"]["held_out"] in ("words", "phrasings")
                assert other.instruction not in training
            else:
                assert other.instruction == "" and standard.task == "wait"
    assert set(kinds) == {"pick_place", "stay", "wait"}
    alone.close()
    standard.close()


def test_what_cannot_be_done_is_said_as_the_goal_says_it() -> None:
    grammar = GRAMMAR.rename({"block": "absent"})
    assert grammar.phrasings == ("{put} the {absent} block there", "the {absent} block, please")
    assert grammar.held_out_phrasings == ("there goes the {absent} block",) and grammar.slots == {"absent"}
    assert (grammar.words, grammar.held_out_colours) == (GRAMMAR.words, GRAMMAR.held_out_colours)
    assert Silence().say({"block": "red"}, None, np.random.RandomState(0)) == "" and Silence().held_out_kinds == ()
