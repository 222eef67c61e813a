"""Frozen text encoders of Hugging Face.

Shapes: B sentences, L tokens of one of them, E width of the encoder.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor, nn

from vla.io.documents import lines_of, mappings, parse_json, read_bounded
from vla.io.errors import UserError
from vla.models.hub import fetch
from vla.models.packaged import PackagedFile
from vla.models.text.ngrams import TextEncoder
from vla.models.text.tensor_cache import TensorCache

log = logging.getLogger(__name__)

FILES = ("config.json", "tokenizer.json", "tokenizer_config.json", "model*.safetensors", "model.safetensors.index.json")
CACHE_BYTES = 64 << 20  # of sentence vectors; 16 000 sentences of 1024 components
LONGEST = 1 << 16  # tokens of a padded text
# What configurations name and transformers reads, although it is no field with a default.
FURTHER = {
    "modernbert": ("global_rope_theta", "local_rope_theta", "rope_scaling", "global_attn_every_n_layers"),
    "deberta-v2": (
        *("share_att_key", "position_buckets", "norm_rel_ebd", "attention_head_size"),
        *("conv_kernel_size", "conv_groups", "conv_act"),
    ),
}
INSERTIONS, INSERTED = 4, 8  # replacements of a normalizer, and characters of one: a text grows by 8^4 at most

# The encoders that may be built: model type → text-only class in transformers. A configuration also comes out of a
# checkpoint, and transformers has hundreds of other classes.
ENCODERS = {
    "albert": "AlbertModel",
    "bert": "BertModel",
    "camembert": "CamembertModel",
    "deberta": "DebertaModel",
    "deberta-v2": "DebertaV2Model",
    "distilbert": "DistilBertModel",
    "electra": "ElectraModel",
    "modernbert": "ModernBertModel",
    "mpnet": "MPNetModel",
    "mt5": "MT5EncoderModel",
    "roberta": "RobertaModel",
    "t5": "T5EncoderModel",
    "umt5": "UMT5EncoderModel",
    "xlm-roberta": "XLMRobertaModel",
}

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
        self._vectors = TensorCache(CACHE_BYTES)

    def __deepcopy__(self, memo: Any) -> SentenceEncoder:
        return self

    @classmethod
    def from_folder(cls, folder: Path) -> SentenceEncoder:
        """Load an encoder from a folder.

        Raises:
            UserError: a file is missing or damaged, or the weights are not safetensors.
        """
        from safetensors import SafetensorError
        from transformers import PreTrainedTokenizerFast

        for needed in ("config.json", "tokenizer.json", "model*.safetensors"):
            if not any(folder.glob(needed)):
                raise UserError(
                    f"{folder} has no {needed.replace('*', '')}, which an encoder needs (weights in other formats may "
                    "run code, and are not read): write it there with save_pretrained of transformers"
                )
        try:
            config = _configuration(read_bounded(folder / "config.json", 1 << 20))
            network, report = _network_class(config).from_pretrained(
                folder,
                config=config,
                use_safetensors=True,
                dtype=torch.float32,
                output_loading_info=True,
            )
            tokenizer = PreTrainedTokenizerFast.from_pretrained(folder)
        except (OSError, RuntimeError, ValueError, SafetensorError) as error:
            raise UserError(f"{folder} cannot be read as an encoder: {lines_of(error)[0]}") from error
        missing = sorted(name for name in report["missing_keys"] if not name.startswith("pooler."))  # not used
        if missing:
            raise UserError(f"the weights in {folder} are those of another network: {missing[0]} is missing")
        return cls(network, _standalone_tokenizer(tokenizer, network.config))

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> SentenceEncoder:
        """Restore an encoder from the result of `state`.

        Raises:
            UserError: it is invalid.
        """
        try:
            weights, config = state["weights"], _configuration(state["config"])
            layers = [name for name, value in vars(config).items() if _exceeds(name, value, len(weights))]
            if layers:
                raise UserError(f"{layers[0]} is {getattr(config, layers[0])}, with {len(weights)} weights")
            network = _network_class(config)(config)
            network.load_state_dict(weights)
            return cls(network, _saved_tokenizer(state["tokenizer"]))
        except Exception as error:  # tokenizers raises a plain Exception for invalid text
            raise UserError(f"the encoder in the checkpoint cannot be read: {str(error)[:200]}") from error

    def state(self) -> dict[str, Any]:
        """Return all that `from_state` needs: config and tokenizer as JSON, and the weights."""
        return {
            "config": self.network.config.to_json_string(use_diff=False),
            "tokenizer": self.tokenizer.to_str(),
            "weights": self.network.state_dict(),
        }

    def embed(self, sentence: str) -> Tensor:
        """Return the sentence vector of a text tower, or else the mean over all tokens, (E,) float32."""
        return self._vectors.get(sentence, lambda: self._embed(sentence))

    @torch.no_grad()
    def _embed(self, sentence: str) -> Tensor:
        ids = torch.tensor([self.tokenizer.encode(sentence).ids or [0]])  # (1, L), also for an empty sentence
        output = self.network(input_ids=ids)
        family = _family(self.network.config)
        return output[TOWERS[family][1]][0] if family in TOWERS else output.last_hidden_state[0].mean(0)


class HuggingFace(TextEncoder):
    """A frozen sentence or text encoder of Hugging Face with a trained projection.

    The vector is that of a text tower such as CLIP's, or else the mean over all tokens. Checkpoints hold the encoder
    with its tokenizer, so that a policy needs no other file.

    Args:
        name: folder with config.json, tokenizer.json and model.safetensors, or name of a model on the hub, or a zip
            archive of such a folder in a Python package; empty if a checkpoint with the encoder is loaded next.
        width: length of the sentence vector.

    Raises:
        UserError: transformers is not installed, the folder, model or package does not exist, or it is not an encoder.
    """

    def __init__(self, name: str | PackagedFile, *, width: int) -> None:
        super().__init__(width)
        _require_transformers()
        self._encoder: SentenceEncoder | None = None
        if name:
            with _folder(name) as (folder, source):
                self._set_encoder(SentenceEncoder.from_folder(folder))
            log.info("text encoder loaded from %s", source)

    @property
    def encoder(self) -> SentenceEncoder:
        """Return the frozen encoder.

        Raises:
            UserError: there was no name, and no checkpoint has been loaded.
        """
        if self._encoder is None:
            raise UserError("model.text.name is empty, and no checkpoint with an encoder has been loaded")
        return self._encoder

    @property
    def length(self) -> int:
        """Return E, the length of the frozen encoder's vectors."""
        norm: Any = self.projection[0]
        return int(norm.normalized_shape[0])

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
        return self.projection(tokens)

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
        raise UserError(
            "a text encoder of Hugging Face needs transformers: install this package with its extra hf, as in "
            "pip install -e '.[hf]'"
        ) from error
    transformers_logging.set_verbosity_error()
    transformers_logging.disable_progress_bar()


@contextmanager
def _folder(name: str | PackagedFile) -> Iterator[tuple[Path, str | Path]]:
    """Yield the folder of an encoder, a temporary one if it comes out of a package, and what to call it."""
    if isinstance(name, PackagedFile) and (folder := name.from_hub(*FILES)):
        yield folder, folder
    elif isinstance(name, PackagedFile):
        with TemporaryDirectory() as unpacked:
            name.unpack(Path(unpacked), FILES)
            yield Path(unpacked), name.source
    elif Path(name).is_dir():
        yield Path(name), name
    else:
        try:
            fetched = fetch(name, *FILES)
        except OSError as error:
            raise UserError(
                f"model.text.name={name} is no folder here, and cannot be fetched from the Hugging Face hub ({error}): "
                "give the folder of a downloaded encoder, or use the one in a Python package, model/text=minilm"
            ) from error
        yield fetched, fetched


def _family(config: Any) -> str:
    return str(config.model_type).removesuffix("_text_model")


def _configuration(text: str | bytes) -> Any:
    """Return the configuration of a text encoder from JSON, the text tower's of an image-text model.

    Names that the kind of encoder does not have by default are ignored. Some would act: transformers downloads and runs
    the code that `attn_implementation` names.

    Raises:
        UserError: it is no configuration of one of `ENCODERS` or `TOWERS`.
    """
    from transformers import AutoConfig

    values = parse_json(text, dict[str, Any], "its configuration")
    kind = values.pop("model_type", None)
    if not isinstance(kind, str) or kind.removesuffix("_text_model") not in (*ENCODERS, *TOWERS):
        raise UserError(f"{str(kind)[:100]} is none of the text encoders {', '.join((*ENCODERS, *TOWERS))}")
    known = {*AutoConfig.for_model(kind).to_dict(), *FURTHER.get(kind, ())}
    config = AutoConfig.for_model(kind, **{name: value for name, value in values.items() if name in known})
    tower = getattr(config, "text_config", None)
    return config if tower is None else _configuration(tower.to_json_string(use_diff=False))


def _exceeds(name: str, value: Any, weights: int) -> bool:
    """Return whether a configuration's value is a number of layers above the number of weights."""
    return "layers" in name and isinstance(value, int) and value > weights


def _network_class(config: Any) -> Any:
    """Return the text-only class of a configuration in transformers."""
    import transformers

    family = _family(config)
    return getattr(transformers, TOWERS[family][0] if family in TOWERS else ENCODERS[family])


def _saved_tokenizer(text: str) -> Any:
    """Restore a tokenizer from its JSON.

    Raises:
        UserError: it pads or grows a text without bound.
        Exception: it is invalid.
    """
    from tokenizers import Tokenizer

    normalizer = parse_json(text, dict[str, Any], "its tokenizer").get("normalizer")
    insertions = [each for each in mappings(normalizer) if each.get("type") in ("Replace", "Prepend")]
    inserted = [str(each.get("content") or each.get("prepend") or "") for each in insertions]
    if len(inserted) > INSERTIONS or any(len(each) > INSERTED for each in inserted):
        raise UserError(f"its tokenizer has more than {INSERTIONS} replacements, or ones of over {INSERTED} characters")
    tokenizer = Tokenizer.from_str(text)
    padding = tokenizer.padding or {}
    if max(padding.get("length") or 0, padding.get("pad_to_multiple_of") or 0) > LONGEST:
        raise UserError(f"its tokenizer pads texts to more than {LONGEST} tokens")
    return tokenizer


def _standalone_tokenizer(tokenizer: Any, config: Any) -> Any:
    """Return the backend of a tokenizer, which needs no transformers, with truncation to the limit of the network."""
    length = min(tokenizer.model_max_length, getattr(config, "max_position_embeddings", tokenizer.model_max_length))
    backend = tokenizer.backend_tokenizer
    backend.no_padding()
    backend.enable_truncation(min(length, 2**31))
    if _family(config).startswith("siglip"):  # trained on padded texts without a mask
        backend.enable_padding(length=length, pad_id=tokenizer.pad_token_id, pad_token=tokenizer.pad_token)
    return backend
