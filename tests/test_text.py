"""Sentences as vectors."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from composing import composed
from conftest import CONF
from defaults import defaults_of
from hydra.utils import instantiate
from omegaconf import OmegaConf

from vla.config.compose import axes
from vla.io.errors import UserError
from vla.models.text.colours import to_basic_terms
from vla.models.text.ngrams import NGrams
from vla.tasks.tabletop.scene import COLOURS

SENTENCES = ["Lift the red block", "put the small green block onto the blue pad", ""]


def test_tokens_are_filled_up_and_the_filling_changes_nothing() -> None:
    encoder = NGrams(width=8, **defaults_of("model/text/ngrams", dropout=0.0))
    together = encoder.tokenize(SENTENCES)
    alone = encoder.tokenize(SENTENCES[:1])
    assert together.dtype == torch.int64 and together.shape[0] == 3 and alone.shape[1] < together.shape[1]
    assert torch.allclose(encoder(together)[0], encoder(alone)[0], atol=1e-6)
    assert encoder(together).shape == (3, 8) and torch.isfinite(encoder(together)).all()


def test_tokens_are_the_same_everywhere_and_always_whatever_the_case_but_not_the_order() -> None:
    encoder = NGrams(width=8, **defaults_of("model/text/ngrams", dropout=0.0))
    plain, loud, swapped = encoder.tokenize(["red on blue", "Red on BLUE!", "blue on red"])
    assert torch.equal(plain, loud)
    assert set(plain.tolist()) != set(swapped.tolist())
    known = [1696, 1333, 3775, 777, 1693, 1191, 1135, 2078, 2083, 1766, 3758, 4090, 3394, 154, 2182]
    assert plain.tolist() == known


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("put the crimson cube on the disc", "put the red cube on the disc"),
        ("put the navy blue brick on the sky blue pad", "put the blue brick on the blue pad"),
        ("the jade brick", "the green brick"),
        ("the brick on the emerald rose", "the red on the green rose"),
        ("put the red block on the blue block", "put the red block on the blue block"),
        ("", ""),
    ],
)
def test_names_of_colours_mean_basic_terms(said: str, meant: str) -> None:
    knowing, plain = (
        NGrams(width=8, **defaults_of("model/text/ngrams", basic_colours=known)) for known in (True, False)
    )
    assert torch.equal(knowing.tokenize([said]), plain.tokenize([meant]))
    assert (said == meant) == torch.equal(plain.tokenize([said]), plain.tokenize([meant]))


def test_every_name_of_a_block_that_training_never_has_means_its_colour() -> None:
    names = axes()["task/randomize/phrasing"]["unseen_names"]["words"]
    for colour in COLOURS:
        for name in names[f"the {colour} block"]:
            assert colour in to_basic_terms(name.split()), name


SAID = {"block": "red", "other": "blue", "pad": "black", "rest": "white"}


@pytest.mark.parametrize(
    ("goal", "pair"),
    [("stack", ("block", "other")), ("pick_place_two", ("block", "other")), ("pick_place_two", ("pad", "rest"))],
)
def test_which_block_belongs_where_can_be_told_from_every_phrasing(goal: str, pair: tuple[str, str]) -> None:
    encoder = instantiate(OmegaConf.load(CONF / "model/text/ngrams.yaml"))(width=8)
    language = OmegaConf.load(CONF / "task/goal" / f"{goal}.yaml").language
    verbs = {slot: words[0] for slot, words in language.words.items()}
    swapped = {**SAID, pair[0]: SAID[pair[1]], pair[1]: SAID[pair[0]]}
    for phrasing in (*language.phrasings, *language.held_out_phrasings):
        sentences = [phrasing.format(**verbs, **said) for said in (SAID, swapped)]
        one, other = encoder.tokenize(sentences).tolist()
        assert sentences[0] != sentences[1] and sorted(one) != sorted(other), sentences


def test_n_grams_of_many_goals_say_which_block_belongs_on_which_pad() -> None:
    """In a weighted sum of them, too, which cannot tell what has the same n-grams in both orders together."""
    cfg = composed("experiment=multitask")
    encoder = instantiate(cfg.model.text)(width=8)

    def n_grams(phrasing: str, said: dict[str, str]) -> list[int]:
        turned = dict(block=said["other"], other=said["block"], pad=said["rest"], rest=said["pad"])
        rows = encoder.tokenize([phrasing.format(put="put", **words) for words in (said, turned)])
        return sorted(rows.flatten().tolist())

    for phrasing in cfg.task.goal.goals.pick_place_two.language.phrasings:
        assert n_grams(phrasing, SAID) != n_grams(phrasing, {**SAID, "pad": SAID["rest"], "rest": SAID["pad"]})


def test_related_words_share_tokens_which_all_have_a_vector() -> None:
    rows = NGrams(width=8, **defaults_of("model/text/ngrams", dropout=0.0)).tokenize(["blocks", "block", "pyramid"])
    blocks, block, pyramid = (set(row.tolist()) - {0} for row in rows)
    assert len(block & blocks) >= 3 and not block & pyramid
    assert NGrams(width=4, **defaults_of("model/text/ngrams", vocabulary=2, dropout=0.0)).tokenize(SENTENCES).max() == 1


def test_unknown_words_hardly_change_what_training_made_of_the_known_ones() -> None:
    encoder = NGrams(width=64, **defaults_of("model/text/ngrams", dropout=0.0))
    known, new = encoder.tokenize(["put the red block on the pad", "convey the red block on the pad"])
    with torch.no_grad():
        encoder.embedding.weight[known] *= 10  # as training does
        one, other = encoder(known[None]), encoder(new[None])
    assert torch.cosine_similarity(one, other).item() > 0.8


def make_known_words(sentences: list[str], **changes: Any) -> NGrams:
    """An encoder that has heard some sentences in training."""
    options = {"dropout": 0.0, "word_dropout": 0.0, **changes}
    encoder = NGrams(width=8, **defaults_of("model/text/known_words", **options))
    encoder(encoder.tokenize(sentences))
    return encoder.eval()


def test_words_that_training_never_has_are_left_out() -> None:
    encoder = make_known_words(["Put the red block on the pad", "lift it"])

    def vector(sentence: str) -> torch.Tensor:
        return encoder(encoder.tokenize(["any longer sentence of seven words altogether", sentence]))[1]

    torch.testing.assert_close(vector("put the red brick on the round pad"), vector("put the red on the pad!"))
    assert not torch.allclose(vector("put the red on the pad"), vector("put the red block on the pad"))
    torch.testing.assert_close(vector("crimson brick"), vector(""))
    assert not torch.allclose(vector("block red"), vector("red block"))


def test_without_training_all_words_are_read() -> None:
    encoder = NGrams(width=8, **defaults_of("model/text/known_words")).eval()
    red, blue = encoder(encoder.tokenize(["lift the red block", "lift the blue block"]))
    assert not torch.equal(red, blue)


def test_known_words_are_part_of_a_policy_and_take_names_of_colours_for_basic_terms_if_asked() -> None:
    encoder, other = make_known_words(["lift the red block"]), make_known_words(["push it"])
    tokens = encoder.tokenize(["lift the new block", "push it"])
    assert not torch.equal(encoder(tokens), other(tokens))
    other.load_state_dict(encoder.state_dict())
    assert torch.equal(encoder(tokens), other(tokens))
    knowing = make_known_words(["the red block"], basic_colours=True)
    assert torch.equal(knowing.tokenize(["the crimson block"]), encoder.tokenize(["the red block"]))
    assert not torch.equal(encoder.tokenize(["the crimson block"]), encoder.tokenize(["the red block"]))


def test_synonyms_are_one_word() -> None:
    encoder = NGrams(width=8, **defaults_of("model/text/synonyms"))
    plain, other = encoder.tokenize(
        ["Pick up the red block and place it on the pad", "grab red block and set it onto pad"]
    )
    assert torch.equal(plain, other)
    there, elsewhere = encoder.tokenize(["pick up the pad", "pick up the putter"])
    assert not torch.equal(there, elsewhere)
    capitals = NGrams(width=8, **defaults_of("model/text/ngrams", synonyms={"Pick up": ["Grab"]}))
    assert torch.equal(*capitals.tokenize(["pick up the block", "grab the block"]))
    with pytest.raises(UserError, match=r"model\.text\.synonyms has 'put' more than once"):
        NGrams(width=8, **defaults_of("model/text/ngrams", synonyms={"place": ["put"], "put": ["set"]}))


@pytest.mark.parametrize(
    ("option", "kind"), [("ngrams", "dropout"), ("known_words", "dropout"), ("known_words", "word_dropout")]
)
def test_sentences_go_without_a_share_of_their_parts_in_training_only(option: str, kind: str) -> None:
    rates = {"dropout": 0.0, **({"word_dropout": 0.0} if option == "known_words" else {}), kind: 0.5}
    encoder = NGrams(width=8, **defaults_of(f"model/text/{option}", **rates))
    tokens = encoder.tokenize(SENTENCES[1:2])
    assert not torch.equal(encoder(tokens), encoder(tokens))
    encoder.eval()
    assert torch.equal(encoder(tokens), encoder(tokens))
