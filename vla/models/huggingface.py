"""Sentences as vectors by an encoder of Hugging Face.

Shapes: B sentences, L tokens of one of them, E length of the encoder's own vectors.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vla.documents import parse_json
from vla.models.hub import fetch
from vla.models.text import TextEncoder

log = logging.getLogger(__name__)

FILES = ("config.json", "tokenizer.json", "tokenizer_config.json", "model*.safetensors", "model.safetensors.index.json")
KEPT = 8192  # sentences whose vectors are remembered: 40 MB where all are as long as instructions may be

# Text halves of models of images and text, which were trained to be read in one place: the class, and where.
TOWERS = {
    "clip": ("CLIPTextModelWithProjection", "text_embeds"),
    "metaclip_2": ("MetaClip2TextModelWithProjection", "text_embeds"),
    "siglip": ("SiglipTextModel", "pooler_output"),
    "siglip2": ("Siglip2TextModel", "pooler_output"),
}


class SentenceEncoder:
    """A network that stays as it is, with its tokenizer; every sentence goes through it once.

    It is no module, so that nothing trains, averages or copies it.

    Args:
        network: gives a feature per token, or a vector per text.
        tokenizer: text to the numbers that the network reads.
    """

    def __init__(self, network: Any, tokenizer: Any) -> None:
        self.network, self.tokenizer = network.eval().requires_grad_(False), tokenizer
        self.embed = lru_cache(maxsize=KEPT)(self._embed)

    def __deepcopy__(self, memo: Any) -> SentenceEncoder:
        return self

    @classmethod
    def read(cls, folder: Path) -> SentenceEncoder:
        """What lies in a folder.

        Raises:
            ValueError: something is missing there or damaged, or the weights are no safetensors.
        """
        from safetensors import SafetensorError
        from transformers import AutoConfig, PreTrainedTokenizerFast

        for needed in ("config.json", "tokenizer.json", "model*.safetensors"):
            if not any(folder.glob(needed)):
                raise ValueError(
                    f"{folder} has no {needed.replace('*', '')}, which an encoder needs (weights in other formats may "
                    "run code, and are not read): write it there with save_pretrained of transformers"
                )
        try:
            # Unless it is told not to trust, transformers asks at the terminal whether to run code that lies there.
            config = AutoConfig.from_pretrained(folder, trust_remote_code=False)
            network, report = _network_class(config).from_pretrained(
                folder,
                config=getattr(config, "text_config", config),
                use_safetensors=True,
                dtype=torch.float32,
                output_loading_info=True,
            )
            tokenizer = PreTrainedTokenizerFast.from_pretrained(folder)
        except (OSError, RuntimeError, ValueError, SafetensorError) as error:
            raise ValueError(f"{folder} cannot be read as an encoder: {str(error).strip().splitlines()[0]}") from error
        lacking = sorted(name for name in report["missing_keys"] if not name.startswith("pooler."))  # which is not read
        if lacking:
            raise ValueError(f"the weights in {folder} are those of another network: {lacking[0]} is missing")
        return cls(network, _prepared(tokenizer, network.config))

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> SentenceEncoder:
        """The encoder that `state` described.

        Raises:
            ValueError: it describes none.
        """
        from tokenizers import Tokenizer
        from transformers import AutoConfig

        try:
            config = AutoConfig.for_model(**parse_json(state["config"], dict[str, Any], "its configuration"))
            network = _network_class(config)(config)
            network.load_state_dict(state["weights"])
            return cls(network, Tokenizer.from_str(state["tokenizer"]))
        except Exception as error:  # tokenizers raises nothing narrower for text that is no tokenizer
            raise ValueError(f"the encoder in the checkpoint cannot be read: {str(error)[:200]}") from error

    def state(self) -> dict[str, Any]:
        """All that it takes to build the encoder again: two texts in JSON, and tensors."""
        return {
            "config": self.network.config.to_json_string(use_diff=False),
            "tokenizer": self.tokenizer.to_str(),
            "weights": self.network.state_dict(),
        }

    @torch.no_grad()
    def _embed(self, sentence: str) -> Tensor:
        """(E,) float32: where a tower is read, or the mean over all tokens."""
        ids = torch.tensor([self.tokenizer.encode(sentence).ids or [0]])  # (1, L), also where nothing is said
        output = self.network(input_ids=ids)
        family = _family(self.network.config)
        vector: Tensor = output[TOWERS[family][1]][0] if family in TOWERS else output.last_hidden_state[0].mean(0)
        return vector


class HuggingFace(TextEncoder):
    """A frozen sentence or text encoder of Hugging Face, and a trained projection of its vectors.

    The vector is what a text tower such as CLIP's gives, or else the mean over all tokens. Checkpoints hold the encoder
    with its tokenizer, so that a policy needs no other file.

    Args:
        name: folder with config.json, tokenizer.json and model.safetensors, or what the model is called on the hub;
            an empty name leaves the encoder to the checkpoint that is loaded.
        width: length of the sentence vector.

    Raises:
        ValueError: transformers is not installed, there is no such folder or model, or it is no encoder.
    """

    def __init__(self, name: str = "", *, width: int) -> None:
        super().__init__(width)
        _require_transformers()
        self._encoder: SentenceEncoder | None = None
        if name:
            folder = _folder(name)
            self._adopt(SentenceEncoder.read(folder))
            log.info("instructions are read by the encoder in %s", folder)

    @property
    def encoder(self) -> SentenceEncoder:
        """The frozen encoder.

        Raises:
            ValueError: there was no name, and no checkpoint has brought one yet.
        """
        if self._encoder is None:
            raise ValueError("model.text.name names no encoder, and no checkpoint has brought one")
        return self._encoder

    def _adopt(self, encoder: SentenceEncoder) -> None:
        if self._encoder is None:
            length = len(encoder.embed("a sentence"))
            self.projection = nn.Sequential(nn.LayerNorm(length), nn.Linear(length, self.width))
        self._encoder = encoder

    def tokenize(self, sentences: list[str]) -> Tensor:
        """(B, E) float32 vectors of B sentences by the frozen encoder."""
        return torch.stack([self.encoder.embed(sentence) for sentence in sentences])

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, width) vectors for the (B, E) of `tokenize`."""
        vector: Tensor = self.projection(tokens)
        return vector

    def get_extra_state(self) -> dict[str, Any]:
        """The frozen encoder, as a part of the module's state."""
        return self.encoder.state()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over the frozen encoder of a checkpoint; the weights of the projection are loaded next."""
        self._adopt(SentenceEncoder.from_state(state))


def _require_transformers() -> None:
    try:
        from transformers.utils import logging as chatter
    except ImportError as error:
        raise ValueError(
            "model/text=huggingface needs transformers: install this package with its extra hf, as in "
            "pip install -e '.[hf]'"
        ) from error
    chatter.set_verbosity_error()
    chatter.disable_progress_bar()


def _folder(name: str) -> Path:
    if Path(name).is_dir():
        return Path(name)
    try:
        return fetch(name, *FILES)
    except OSError as error:
        raise ValueError(
            f"model.text.name={name} is no folder here, and cannot be fetched from the Hugging Face hub ({error}): "
            "give the folder of a downloaded encoder"
        ) from error


def _family(config: Any) -> str:
    return str(config.model_type).removesuffix("_text_model")


def _network_class(config: Any) -> Any:
    """The class of transformers that reads text only.

    Raises:
        ValueError: there is none.
    """
    import transformers

    if _family(config) in TOWERS:
        return getattr(transformers, TOWERS[_family(config)][0])
    for classes in (transformers.MODEL_FOR_TEXT_ENCODING_MAPPING, transformers.MODEL_MAPPING):
        if type(config) in classes:
            return classes[type(config)]
    raise ValueError(f"transformers has no text encoder called {config.model_type}")


def _prepared(tokenizer: Any, config: Any) -> Any:
    """The part of a tokenizer that needs nothing else, cutting texts that are too long for the network."""
    length = min(tokenizer.model_max_length, getattr(config, "max_position_embeddings", tokenizer.model_max_length))
    backend = tokenizer.backend_tokenizer
    backend.no_padding()
    backend.enable_truncation(min(length, 2**31))
    if _family(config).startswith("siglip"):  # which was trained on full length, without a mask
        backend.enable_padding(length=length, pad_id=tokenizer.pad_token_id, pad_token=tokenizer.pad_token)
    return backend
