"""Frozen text encoders of Hugging Face.

Shapes: B sentences, L tokens of one of them, E width of the encoder.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vla.io.documents import parse_json
from vla.models.text.ngrams import TextEncoder
from vla.models.vision.hub import fetch

log = logging.getLogger(__name__)

FILES = ("config.json", "tokenizer.json", "tokenizer_config.json", "model*.safetensors", "model.safetensors.index.json")
CACHE_SIZE = 8192  # sentences; at most 40 MB

# Text towers of image-text models with a trained sentence vector: class and output.
TOWERS = {
    "clip": ("CLIPTextModelWithProjection", "text_embeds"),
    "metaclip_2": ("MetaClip2TextModelWithProjection", "text_embeds"),
    "siglip": ("SiglipTextModel", "pooler_output"),
    "siglip2": ("Siglip2TextModel", "pooler_output"),
}


class SentenceEncoder:
    """A frozen network with its tokenizer and a cache of sentence vectors.

    It is not a module, so that it is not trained, averaged or copied.

    Args:
        network: returns a feature per token, or a vector per text.
        tokenizer: text → token ids.
    """

    def __init__(self, network: Any, tokenizer: Any) -> None:
        self.network, self.tokenizer = network.eval().requires_grad_(False), tokenizer
        self.embed = lru_cache(maxsize=CACHE_SIZE)(self._embed)

    def __deepcopy__(self, memo: Any) -> SentenceEncoder:
        return self

    @classmethod
    def from_folder(cls, folder: Path) -> SentenceEncoder:
        """Load an encoder from a folder.

        Raises:
            ValueError: a file is missing or damaged, or the weights are not safetensors.
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
            # By default transformers asks at the terminal whether to run code from the folder.
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
        missing = sorted(name for name in report["missing_keys"] if not name.startswith("pooler."))  # not used
        if missing:
            raise ValueError(f"the weights in {folder} are those of another network: {missing[0]} is missing")
        return cls(network, _standalone_tokenizer(tokenizer, network.config))

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> SentenceEncoder:
        """Restore an encoder from the result of `state`.

        Raises:
            ValueError: it is invalid.
        """
        from tokenizers import Tokenizer
        from transformers import AutoConfig

        try:
            config = AutoConfig.for_model(**parse_json(state["config"], dict[str, Any], "its configuration"))
            network = _network_class(config)(config)
            network.load_state_dict(state["weights"])
            return cls(network, Tokenizer.from_str(state["tokenizer"]))
        except Exception as error:  # tokenizers raises a plain Exception for invalid text
            raise ValueError(f"the encoder in the checkpoint cannot be read: {str(error)[:200]}") from error

    def state(self) -> dict[str, Any]:
        """Return all that `from_state` needs: config and tokenizer as JSON, and the weights."""
        return {
            "config": self.network.config.to_json_string(use_diff=False),
            "tokenizer": self.tokenizer.to_str(),
            "weights": self.network.state_dict(),
        }

    @torch.no_grad()
    def _embed(self, sentence: str) -> Tensor:
        """Return the sentence vector of a text tower, or else the mean over all tokens, (E,) float32."""
        ids = torch.tensor([self.tokenizer.encode(sentence).ids or [0]])  # (1, L), also for an empty sentence
        output = self.network(input_ids=ids)
        family = _family(self.network.config)
        vector: Tensor = output[TOWERS[family][1]][0] if family in TOWERS else output.last_hidden_state[0].mean(0)
        return vector


class HuggingFace(TextEncoder):
    """A frozen sentence or text encoder of Hugging Face with a trained projection.

    The vector is that of a text tower such as CLIP's, or else the mean over all tokens. Checkpoints hold the encoder
    with its tokenizer, so that a policy needs no other file.

    Args:
        name: folder with config.json, tokenizer.json and model.safetensors, or name of a model on the hub; empty if a
            checkpoint with the encoder is loaded next.
        width: length of the sentence vector.

    Raises:
        ValueError: transformers is not installed, the folder or model does not exist, or it is not an encoder.
    """

    def __init__(self, name: str, *, width: int) -> None:
        super().__init__(width)
        _require_transformers()
        self._encoder: SentenceEncoder | None = None
        if name:
            folder = _folder(name)
            self._set_encoder(SentenceEncoder.from_folder(folder))
            log.info("text encoder loaded from %s", folder)

    @property
    def encoder(self) -> SentenceEncoder:
        """Return the frozen encoder.

        Raises:
            ValueError: there was no name, and no checkpoint has been loaded.
        """
        if self._encoder is None:
            raise ValueError("model.text.name is empty, and no checkpoint with an encoder has been loaded")
        return self._encoder

    def _set_encoder(self, encoder: SentenceEncoder) -> None:
        if self._encoder is None:
            length = len(encoder.embed("a sentence"))
            self.projection = nn.Sequential(nn.LayerNorm(length), nn.Linear(length, self.width))
        self._encoder = encoder

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Encode B sentences with the frozen encoder, (B, E) float32."""
        return torch.stack([self.encoder.embed(sentence) for sentence in sentences])

    def forward(self, tokens: Tensor) -> Tensor:
        """Project the (B, E) output of `tokenize` to (B, width)."""
        vector: Tensor = self.projection(tokens)
        return vector

    def get_extra_state(self) -> dict[str, Any]:
        """Return the frozen encoder as part of the module's state."""
        return self.encoder.state()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the frozen encoder; the weights of the projection are loaded afterwards."""
        self._set_encoder(SentenceEncoder.from_state(state))


def _require_transformers() -> None:
    try:
        from transformers.utils import logging as transformers_logging
    except ImportError as error:
        raise ValueError(
            "model/text=huggingface needs transformers: install this package with its extra hf, as in "
            "pip install -e '.[hf]'"
        ) from error
    transformers_logging.set_verbosity_error()
    transformers_logging.disable_progress_bar()


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
    """Return the text-only class of a model family in transformers.

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


def _standalone_tokenizer(tokenizer: Any, config: Any) -> Any:
    """Return the backend of a tokenizer, which needs no transformers, with truncation to the limit of the network."""
    length = min(tokenizer.model_max_length, getattr(config, "max_position_embeddings", tokenizer.model_max_length))
    backend = tokenizer.backend_tokenizer
    backend.no_padding()
    backend.enable_truncation(min(length, 2**31))
    if _family(config).startswith("siglip"):  # trained on padded texts without a mask
        backend.enable_padding(length=length, pad_id=tokenizer.pad_token_id, pad_token=tokenizer.pad_token)
    return backend
