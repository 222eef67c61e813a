"""Frozen text encoders of Hugging Face.

Shapes: B sentences, L tokens of one of them, E width of the encoder.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZipFile

import torch
import transformers
from torch import Tensor, nn

from vla.io.documents import lines_of, mappings, read_json
from vla.io.errors import UserError
from vla.io.files import require_file
from vla.models.hub import fetch
from vla.models.packaged import PackagedFile
from vla.models.text.ngrams import TextEncoder

log = logging.getLogger(__name__)

WEIGHTS = "model*.safetensors"
ADAPTER = "adapter_config.json"  # of an adapter that transformers would load, but whose SHA-256 would not be checked
FILES = ("config.json", "tokenizer.json", "tokenizer_config.json", WEIGHTS, "model.safetensors.index.json")
CACHE_SIZE = 1 << 13  # sentence vectors, 4 kB of 1024 components each

# Models that contain more than a text encoder → class of that part, and its output that is a sentence vector, if any.
TEXT_PARTS = {
    "clip": ("CLIPTextModelWithProjection", "text_embeds"),
    "metaclip_2": ("MetaClip2TextModelWithProjection", "text_embeds"),
    "siglip": ("SiglipTextModel", "pooler_output"),
    "siglip2": ("Siglip2TextModel", "pooler_output"),
    "t5": ("T5EncoderModel", None),
    "mt5": ("MT5EncoderModel", None),
    "umt5": ("UMT5EncoderModel", None),
}


class _SentenceEncoder:
    """A frozen network with its tokenizer and a cache of sentence vectors.

    It is no module, so it is neither trained nor averaged nor copied.

    Args:
        folder: with config.json, tokenizer.json and model.safetensors.

    Raises:
        UserError: a file is missing or damaged, or the weights are not safetensors, as other formats may run code.
    """

    def __init__(self, folder: Path) -> None:
        self._vectors: dict[str, Tensor] = {}  # per encoder: a shared cache would keep its network in memory
        try:
            self.network, self._output = _network(folder)
            self._tokenizer = _tokenizer(folder, self.network.config)
            self.embed("a sentence")
        except Exception as error:  # transformers, tokenizers and safetensors have no error in common
            reason = lines_of(error)[0][:300]  # some list all models
            raise UserError(f"{folder} is no text encoder as save_pretrained writes them: {reason}") from error
        digest = hashlib.sha256()
        for path in sorted(folder.glob(WEIGHTS)):
            require_file(path)
            digest.update(path.read_bytes())
        self.sha256 = digest.hexdigest()  # of the weights

    def __deepcopy__(self, memo: Any) -> _SentenceEncoder:
        return self

    def embed(self, sentence: str) -> Tensor:
        """Return the vector of a sentence, (E,) float32: the network's own if it has one, else the mean over tokens."""
        vector = self._vectors.get(sentence)
        if vector is None:
            if len(self._vectors) >= CACHE_SIZE:
                self._vectors.clear()
            vector = self._vectors[sentence] = self._embed(sentence)
        return vector

    @torch.no_grad()
    def _embed(self, sentence: str) -> Tensor:
        ids = torch.tensor([self._tokenizer.encode(sentence).ids or [0]])  # (1, L), also for an empty sentence
        output = self.network(input_ids=ids)
        return output.last_hidden_state[0].mean(0) if self._output is None else output[self._output][0]


class HuggingFace(TextEncoder):
    """A frozen sentence or text encoder of Hugging Face with a trained projection.

    A policy saves only the projection; it identifies the encoder by its name and the SHA-256 of its weights.

    Args:
        name: folder of the encoder, or its name on the hub, OWNER/NAME or OWNER/NAME@REVISION, or a zip archive of such
            a folder in a Python package.
        width: length of the sentence vector.

    Raises:
        UserError: the folder, model or package does not exist, or it is not an encoder.
    """

    def __init__(self, name: str | PackagedFile, *, width: int) -> None:
        super().__init__(width)
        transformers.logging.set_verbosity_error()
        transformers.logging.disable_progress_bar()
        self._name = name.source if isinstance(name, PackagedFile) else name
        with _folder(name) as folder:
            self.encoder = _SentenceEncoder(folder)
            self._revision = folder.name if folder.parent.name == "snapshots" else None  # in the hub's cache
        length = len(self.encoder.embed("a sentence"))
        self.projection = nn.Sequential(nn.LayerNorm(length), nn.Linear(length, width))
        log.info("text encoder loaded from %s", self._name)

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Encode B sentences with the frozen encoder, (B, E) float32."""
        return torch.stack([self.encoder.embed(sentence) for sentence in sentences])

    def forward(self, tokens: Tensor) -> Tensor:
        """Project the (B, E) output of `tokenize` to (B, width)."""
        return self.projection(tokens)

    def get_extra_state(self) -> dict[str, Any]:
        """Return what identifies the frozen encoder."""
        return {"sha256": self.encoder.sha256, "revision": self._revision}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Raise a UserError if the frozen encoder differs from the one in training."""
        digest = state.get("sha256") if isinstance(state, dict) else self.encoder.sha256  # sharded models load none
        if digest != self.encoder.sha256:
            revision = f", revision {state.get('revision')}" if state.get("revision") else ""
            raise UserError(
                f"{self._name} is another text encoder than in training: its weights have the SHA-256 "
                f"{self.encoder.sha256[:8]}…, get those with {str(digest)[:8]}…{revision}"
            )


@contextmanager
def _folder(name: str | PackagedFile) -> Iterator[Path]:
    """Yield the folder of an encoder, a temporary one if it comes out of a package."""
    if isinstance(name, PackagedFile):
        path = name.locate(*FILES)
        if path.is_dir():
            yield path
            return
        with TemporaryDirectory() as folder, ZipFile(path) as archive:
            archive.extractall(folder)
            yield Path(folder)
    elif Path(name).is_dir():
        yield Path(name)
    else:
        advice = (
            "nor is it a folder here: set model.text.name, for a trained policy in its config.json, to the folder of a "
            "download, or train with model/text=minilm, which is in a Python package"
        )
        yield fetch(name, *FILES, advice=advice)


def _network(folder: Path) -> tuple[Any, str | None]:
    """Return the text encoder in a folder, and the name of its output that is a trained sentence vector, if any."""
    values = read_json(folder / "config.json", dict[str, Any])
    if (folder / ADAPTER).exists():
        raise UserError(f"it has an adapter, {ADAPTER}: merge that into its weights")
    for part in mappings(values):  # without the keys by which transformers downloads and runs code
        for key in [key for key in part if key in ("auto_map", "quantization_config") or "implementation" in key]:
            del part[key]
    config = transformers.AutoConfig.for_model(values.pop("model_type", None), **values)
    config = getattr(config, "text_config", config)
    kind, output = TEXT_PARTS.get(config.model_type.removesuffix("_text_model"), ("AutoModel", None))
    network, report = getattr(transformers, kind).from_pretrained(
        folder, config=config, use_safetensors=True, dtype=torch.float32, output_loading_info=True
    )
    missing_weights = sorted(name for name in report["missing_keys"] if not name.startswith("pooler."))  # not used
    if missing_weights:
        raise UserError(f"its weights are those of another network, {missing_weights[0]} is missing")
    return network.eval().requires_grad_(False), output


def _tokenizer(folder: Path, config: Any) -> Any:
    """Return the tokenizer in a folder, which truncates texts to the maximum length of the network."""
    tokenizer = transformers.PreTrainedTokenizerFast.from_pretrained(folder)
    length = min(tokenizer.model_max_length, getattr(config, "max_position_embeddings", tokenizer.model_max_length))
    backend = tokenizer.backend_tokenizer
    backend.no_padding()
    backend.enable_truncation(min(length, 2**31))
    if config.model_type.startswith("siglip"):  # trained on padded texts without a mask
        backend.enable_padding(length=length, pad_id=tokenizer.pad_token_id, pad_token=tokenizer.pad_token)
    return backend
