"""Vision-language-action models: everything between observation and network, and between network and actions.

Flow matching runs from noise at time 1 to actions at time 0, as in K. Black et al., "π0: A Vision-Language-Action Flow
Model for General Robot Control", arXiv 2410.24164.

Shapes: B batch, C cameras, H by W pixels, k action chunk, D action components, A padded action, S padded state, R noisy
copies, P tokens of the prefix.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from vla.io.errors import UserError
from vla.io.types import Natural, NonNegative, Shift, Steps, Text
from vla.models.chunking import after_prefix, require_prefix, with_prefix
from vla.models.layers import Batch, RunningNormalizer, mean_where, newest_index, random_arguments
from vla.models.model import Model, Prediction
from vla.models.tokenizers.tokenizer import MIN_SPAN, ActionTokenizer
from vla.models.vlm.network import FlowNetwork, Prefix
from vla.models.vlm.normalizer import Kind, Normalizer
from vla.models.vlm.packed_linear import pack
from vla.models.vlm.prompt import PADDING, Prompt
from vla.models.vlm.trunk import Trunk, sketch
from vla.spec import Spec

log = logging.getLogger(__name__)

SHAPE = 1.5  # first parameter of the beta distribution of times; the second is 1
MIN_TIME = 0.001  # of training

Place = Literal["corner", "centre"]


class VisionLanguageAction(Model):
    """A pretrained network that sees all cameras, reads the sentence and the state, and transports noise to actions.

    Images, sentence and state are encoded once per plan. Rates of change in the state are left out.

    Args:
        network: factory of the network.
        text: factory of its prompt.
        trunk: folder with pretrained weights, or their name on the hub, hub:OWNER/NAME or hub:OWNER/NAME@REVISION:
            those of the vision-language model alone, or of a whole policy of LeRobot; null: all weights are random.
        cameras: name of a camera in the pretrained policy → camera of the demonstrations, null for none; null: the
            cameras of the demonstrations in their order.
        chunk: k.
        execute: number of the k actions that a policy executes before it predicts again; null: all.
        prefix: see `vla.models.flow.Flow`.
        steps: Euler steps from noise to actions.
        copies: R, number of noisy copies of each chunk in a training batch, which share its prefix.
        normalization: of state and actions.
        statistics: by which they are normalised: those of the demonstrations or of the pretrained policy.
        place: where images of another aspect ratio are placed in the square input of the network.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height].
        auxiliary: loss weight of the head that predicts the simulator's state from the values of the last token of the
            prefix, in training only; 0 omits it.

    Raises:
        UserError: state or actions have too many components, a camera is unknown, the trunk does not fit, the
            vocabulary is too small for words, or `prefix` leaves fewer actions than are executed.
    """

    uses_tokens = False
    continues = True

    text: Prompt
    noise: Tensor

    def __init__(
        self,
        network: Callable[[], FlowNetwork],
        text: Callable[..., Prompt],
        trunk: Text | None,
        cameras: dict[str, str | None] | None,
        chunk: Steps,
        execute: Steps | None,
        prefix: Natural,
        steps: Steps,
        copies: Steps,
        normalization: Kind,
        statistics: Literal["demonstrations", "pretrained"],
        place: Place,
        shift: Shift,
        auxiliary: NonNegative,
        *,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        widths = {"text_width": 1, "width": 1, "auxiliary": 0.0}
        super().__init__(text, chunk=chunk, execute=execute, shift=shift, spec=spec, tokenizer=tokenizer, **widths)
        self.steps, self.copies, self.place, self.statistics, self.prefix = steps, copies, place, statistics, prefix
        require_prefix(prefix, self.execute, chunk)
        origin = None if trunk is None else Trunk(trunk)
        self.cameras = _cameras(cameras, spec, origin)
        if origin is None:
            sketch(network)  # a UserError, before any weight is drawn, if they need more memory than is free
        self.network = origin.build(network) if origin else network()
        if self.network.vocabulary < self.text.words:
            whose = "without a tokenizer" if self.text.name is None else f"for the tokenizer of {self.text.name}"
            raise UserError(
                f"model.network.vocabulary={self.network.vocabulary} is less than the {self.text.words} words of a "
                f"prompt {whose}: raise it, or give another model.text.name"
            )
        self.add_truth_head(self.network.value_width, auxiliary)
        pack(self.network)
        _require_width("state", len(spec.pose), self.network.state_width or len(spec.pose))
        _require_width("action", len(spec.action), self.network.action_width)
        self.state_normalizer = Normalizer(normalization, len(spec.pose))
        self.action_normalizer = Normalizer(normalization, len(spec.action))
        if origin and statistics == "demonstrations" and (difference := origin.other_normalization(normalization)):
            log.warning("%s, unless its weights are to learn another scale", difference)
        if statistics == "pretrained" and origin:
            trunk_statistics = origin.statistics(normalization)
            self.state_normalizer.take(trunk_statistics, "observation.state", trunk)
            self.action_normalizer.take(trunk_statistics, "action", trunk)
        size = (chunk, self.network.action_width)
        noise = torch.randn(size, generator=torch.Generator().manual_seed(0))
        self.register_buffer("noise", noise, persistent=False)

    def fit(self, states: np.ndarray, actions: np.ndarray) -> None:
        """Normalise by the statistics of (N, P) states and (N, D) actions, unless those of the trunk are to be used."""
        if not (self.network.state_width or self.text.state):  # as openpi trains π0.5 on LIBERO
            text = "%s sees the state in the sentence only, and it is not there: model.text.state=true adds it"
            log.warning(text, type(self.network).__name__)
        if self.statistics == "demonstrations":
            allowed = np.array(self.spec.high) - np.array(self.spec.low)
            self.state_normalizer.fit(states[:, self.spec.pose], floor=RunningNormalizer.MIN_STD, constant=1.0)
            self.action_normalizer.fit(actions, floor=MIN_SPAN / 4 * allowed)

    def encode_prefix(self, batch: Batch) -> Prefix:
        """Encode the newest frame and the sentence."""
        images = torch.stack([self.image(batch["rgb"][camera][:, -1]) for camera in self.cameras], 1)
        present = images.new_ones(images.shape[:2], dtype=torch.bool)
        state = self.state_normalizer(batch["state"][:, -1].index_select(-1, self.robot_state.pose))
        tokens = self.text(batch["text"], state)
        width = self.network.state_width
        padded = F.pad(state, (0, width - state.shape[-1])) if width else None
        return self.network.prefix(images, present, tokens.clamp(min=0), tokens != PADDING, padded)

    def image(self, image: Tensor) -> Tensor:
        """Convert (B, H, W, 3) uint8 images to (B, 3, resolution, resolution) float32 in -1 … 1."""
        size = self.network.resolution
        x = resize_with_padding(image.permute(0, 3, 1, 2).float() / 255, size, self.place)
        return 2 * x - 1

    def with_noise(self, batch: Batch) -> Batch:
        """Return a batch with "noise", (R·B, k, A), and "time" and "length" of the given actions, (R·B,) each.

        Outside training they have a fixed seed.
        """
        options, count = random_arguments(self.training, self.noise.device), self.copies * len(batch["state"])
        noise = torch.randn(count, *self.noise.shape, **options)
        uniform = torch.rand(count, **options)
        time = MIN_TIME + (1 - MIN_TIME) * uniform ** (1 / SHAPE)  # uniform ** (2 / 3) ~ Beta(1.5, 1)
        length = torch.randint(self.prefix + 1, (count,), **options).to(self.noise.device)
        return {**batch, "noise": noise.to(self.noise), "time": time.to(self.noise), "length": length}

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the scalar `loss` at the noise and times of the batch, or at random ones, and its parts by name."""
        return super().loss(batch if "time" in batch else self.with_noise(batch))

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return velocity and target, (R·B, k, A) each; with an auxiliary head also truth: (B, 1, S), normalised."""
        copies = len(batch["time"]) // len(batch["state"])
        prefix = self.encode_prefix(batch)
        prefixes = repeat_prefix(prefix, copies)
        action = self.scaled(batch["action"][:, -1]).repeat(copies, 1, 1)
        noise, time = batch["noise"], batch["time"]
        noisy = time[:, None, None] * noise + (1 - time)[:, None, None] * action
        if self.prefix:
            executed = self.scaled(batch["executed"][:, -1]).repeat(copies, 1, 1)
            noisy, progress = with_prefix(noisy, 1 - time, executed, batch["length"])
            time = 1 - progress
        truth = self.predict_truth(last_values(prefix).unsqueeze(1))
        return {"velocity": self.network.velocity(prefixes, noisy, time), "target": noise - action, **truth}

    def scaled(self, action: Tensor) -> Tensor:
        """Normalise (…, D) actions, and pad them to (…, A)."""
        return F.pad(self.action_normalizer(action), (0, self.network.action_width - action.shape[-1]))

    def action_loss(self, output: dict[str, Tensor], batch: Batch) -> dict[str, Tensor]:
        """Return the mean squared error of the velocity of valid actions, without padding.

        If actions attend to later ones and there is no prefix, repeated last actions of unperturbed chunks count too.
        """
        error = (output["velocity"] - output["target"])[..., : len(self.spec.action)].square().mean(-1)
        copies, perturbations = len(error) // len(batch["valid"]), batch["perturbations"][:, -1]
        mask = batch["valid"][:, -1]
        if not self.network.causal and not self.prefix:
            mask = mask | ((perturbations < 0) & (perturbations.amax(1, keepdim=True) == 0))
        mask = mask.repeat(copies, 1)
        if self.prefix:
            mask = after_prefix(perturbations.repeat(copies, 1), batch["length"])
        return {"action_loss": mean_where(error, mask)}

    def predict(self, batch: Batch) -> Prediction:
        """Transport the "noise" of the batch, or else a fixed noise, to actions."""
        prefix = self.encode_prefix(batch)
        noise = batch["noise"] if "noise" in batch else self.noise.expand(len(prefix.present), -1, -1)
        velocity = self.continuing_velocity(lambda x, progress: -self.network.velocity(prefix, x, 1 - progress), batch)
        x = noise
        for step in range(self.steps):
            x = x + velocity(x, x.new_full((len(x),), step / self.steps)) / self.steps
        return Prediction(self.action_normalizer.inverse(x[..., : len(self.spec.action)]))


def last_values(prefix: Prefix) -> Tensor:
    """Return the last layer's values of the last token, before any padding, of every prefix, (B, `value_width`)."""
    indices = newest_index(prefix.present)
    return prefix.values[-1][torch.arange(len(indices), device=indices.device), :, indices].flatten(1)


def resize_with_padding(images: Tensor, size: int, place: Place) -> Tensor:
    """Resize (B, 3, H, W) float images to (B, 3, size, size), bilinear, with black borders for other aspect ratios.

    There is no antialiasing, as in pretraining. Images are placed in the bottom right "corner" or in the "centre".
    """
    height, width = images.shape[2:]
    ratio = max(width / size, height / size)
    rows, columns = int(height / ratio), int(width / ratio)
    x = F.interpolate(images, (rows, columns), mode="bilinear", align_corners=False)
    top, left = (size - rows, size - columns) if place == "corner" else ((size - rows) // 2, (size - columns) // 2)
    return F.pad(x, (left, size - columns - left, top, size - rows - top))


def repeat_prefix(prefix: Prefix, copies: int) -> Prefix:
    """Repeat the rows of a prefix `copies` times."""
    if copies == 1:
        return prefix
    keys, values = (tuple(part.repeat(copies, 1, 1, 1) for part in parts) for parts in (prefix.keys, prefix.values))
    return Prefix(keys, values, prefix.present.repeat(copies, 1))


def _require_width(kind: str, components: int, width: int) -> None:
    if components > width:
        raise UserError(f"the {kind} has {components} components, more than model.network.{kind}_width={width}")


def _cameras(mapping: dict[str, str | None] | None, spec: Spec, trunk: Trunk | None) -> list[str]:
    """Return the cameras of the spec in the order in which the network sees them.

    Raises:
        UserError: one is unknown, or one of the pretrained policy has no counterpart.
    """
    views, names = trunk.cameras if trunk else [], ", ".join(spec.cameras)
    if mapping is None:
        if views and views != [*spec.cameras]:
            raise UserError(
                f"{trunk} sees {', '.join(views)}, and the demonstrations have {names}: say which is which, null for "
                f"none, as in 'model.cameras={{{views[0]}: {spec.cameras[0]}, …}}'"
            )
        return [*spec.cameras]
    if missing := [camera for camera in views if camera not in mapping]:
        raise UserError(f"model.cameras lacks {', '.join(missing)}, which {trunk} sees: map each to a camera or null")
    if views and (unknown := [camera for camera in mapping if camera not in views]):
        raise UserError(f"model.cameras names {', '.join(unknown)}, but {trunk} sees {', '.join(views)}")
    cameras = [camera for camera in mapping.values() if camera is not None]
    if views and views != [*mapping]:
        raise UserError(f"model.cameras names the cameras of {trunk} in another order: it sees {', '.join(views)}")
    if unknown := [camera for camera in cameras if camera not in spec.cameras]:
        raise UserError(f"model.cameras names {', '.join(unknown)}, but the demonstrations have {names}")
    if not cameras:
        raise UserError(f"model.cameras names none of the cameras of the demonstrations, {names}")
    if copies := [camera for camera in cameras if cameras.count(camera) > 1]:
        raise UserError(
            f"model.cameras maps two cameras of the pretrained policy to {copies[0]}: map each to a camera of its own, "
            "or to null if there is none"
        )
    return cameras
