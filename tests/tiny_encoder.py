"""Encoders of Hugging Face as they are published, but tiny and knowing nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import transformers
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "lift", "put", "the", "red", "blue", "block", "on", "pad")
LONGEST = 16  # tokens of a text


def write_encoder(folder: Path, network: Any = None) -> Path:
    """The folder, with `network`, or a small BERT, and a tokenizer of a few words in it."""
    torch.manual_seed(0)
    (network or transformers.BertModel(transformers.BertConfig(**sizes()))).save_pretrained(folder)
    tokenizer = Tokenizer(models.WordLevel({word: number for number, word in enumerate(WORDS)}, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", 2), ("[SEP]", 3)]
    )
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="[PAD]", unk_token="[UNK]", model_max_length=LONGEST
    ).save_pretrained(folder)
    return folder


def numbers(text: str) -> torch.Tensor:
    """(1, L) what the tokenizer makes of lower-case words that it knows."""
    return torch.tensor([[2, *map(WORDS.index, text.split()), 3]])


def sizes() -> dict[str, Any]:
    """The sizes of a small network, by the names that most configurations give them."""
    return {
        "vocab_size": len(WORDS),
        "hidden_size": 16,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "intermediate_size": 32,
        "max_position_embeddings": LONGEST,
    }
