"""Contexts: a window of observations as tokens, which the head of a model attends to.

Shapes: B batch, T frames, n tokens per frame, N tokens of the context, E width of a token, C features of a camera.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import Inherited, Natural, Steps, Width
from vla.models.kinematics import RobotState
from vla.models.layers import Batch, RunningNormalizer, mlp, newest_index, pixels
from vla.models.vision.image_tokenizer import ImageEncoder, Keypoints, TokenLearner
from vla.spec import Spec


class EncodedContext(NamedTuple):
    """The context of B windows."""

    tokens: Tensor  # (B, N, E)
    summary: Tensor  # (B, E) one token that summarises the window, among `tokens` or computed from them
    padding: Tensor | None = None  # (B, N) bool, true for tokens of absent frames; None: there are none
    state: Tensor | None = None  # (B, R) normalised state of the robot, for heads that need it; None: it is not used


class Context(nn.Module, ABC):
    """Cameras, robot state and instruction of a window → tokens that a head attends to.

    A policy calls `encode` once per observation and caches the result; `forward` computes the context once per plan,
    and the head then decodes any number of steps. A pretrained trunk can be added as a subclass: it returns its last
    hidden states and their padding, ignores `image`, reads the instruction as token ids from a text encoder whose
    `forward` returns its argument, and is frozen, or trained at its own learning rate, under the name `context`.

    Args:
        image: factory of image encoders, called with `text_width`.
        text_width: length of the instruction vector.
        width: E.
        spec: observation and action spaces.
    """

    history = 1  # T
    length: int  # N
    state_width = 0  # R; 0: the robot state is not given to the head

    def __init__(self, *, image: Callable[..., ImageEncoder], text_width: int, width: int, spec: Spec) -> None:
        super().__init__()
        self.make_encoder = partial(image, text_width=text_width)
        self.text_width, self.width, self.spec = text_width, width, spec

    def encode(self, batch: Batch, text: Tensor) -> Tensor | None:
        """Return tokens of each frame, (B, T, n, E), that depend on the frame and the instruction alone.

        They take the place of images and states in the batch of `forward`, as "tokens". None: nothing can be cached.

        Args:
            batch: as in `Model`; "text" is not used.
            text: (B, text_width) instruction.
        """
        return None

    @abstractmethod
    def forward(self, batch: Batch, text: Tensor) -> EncodedContext:
        """Return the context at the newest present frame; later padding has no effect. Arguments as in `encode`."""


class KeypointFeatures(nn.Module):
    """Keypoints of every camera, each with its own image encoder, and the robot state, of the newest frame.

    Args:
        keypoints: number of keypoints per camera.
        proprioception: use the robot state.
        make_encoder: returns an image encoder.
        spec: observation and action spaces.
    """

    def __init__(
        self, keypoints: int, proprioception: bool, make_encoder: Callable[[], ImageEncoder], spec: Spec
    ) -> None:
        super().__init__()
        self.cameras = spec.cameras
        encoders = [make_encoder() for _ in spec.cameras]
        self.images = nn.ModuleList(encoders)
        heads = [Keypoints(encoder.channels, keypoints) for encoder in encoders]
        self.keypoints = nn.ModuleList(heads)
        self.image_widths = [keypoints * head.width for head in heads]  # C of each camera
        self.proprioception = Proprioception(spec) if proprioception else None
        self.state_widths = [self.proprioception.width] if self.proprioception else []

    def forward(self, batch: Batch, text: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Return (B, C) of every camera, and the (B, R) robot state if it is used, given (B, text_width) text."""
        images = []
        for camera, encoder, keypoints in zip(self.cameras, self.images, self.keypoints, strict=True):
            images.append(keypoints(encoder(pixels(batch["rgb"][camera][:, -1:]), text)).flatten(1))
        return images, [self.proprioception(batch)[:, -1]] if self.proprioception else []


class Proprioception(nn.Module):
    """The robot state, normalised by running statistics."""

    def __init__(self, spec: Spec) -> None:
        super().__init__()
        self.robot_state = RobotState(spec)
        self.width = self.robot_state.width  # R
        self.normalizer = RunningNormalizer(self.width)

    def forward(self, batch: Batch) -> Tensor:
        """Return (B, T, R)."""
        return self.normalizer(self.robot_state(batch), batch["present"])


class KeypointContext(Context):
    """One token that fuses all features, one per camera for its keypoints, one for the robot state, one for the text.

    Args:
        keypoints: number of keypoints per camera.
        proprioception: use the robot state.
    """

    def __init__(self, keypoints: Width, proprioception: bool, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        self.features = KeypointFeatures(keypoints, proprioception, self.make_encoder, self.spec)
        width, widths = self.width, [*self.features.image_widths, *self.features.state_widths, self.text_width]
        self.length, self.state_width = 1 + len(widths), sum(self.features.state_widths)
        self.tokens = nn.ModuleList(nn.Linear(features, width) for features in widths)
        self.fuse = nn.Sequential(mlp(sum(widths), 2 * width), nn.Linear(2 * width, width))

    def forward(self, batch: Batch, text: Tensor) -> EncodedContext:
        """Return the context of the newest frame."""
        images, state = self.features(batch, text)
        features = [*images, *state, text]
        summary = self.fuse(torch.cat(features, -1))
        tokens = [linear(feature) for linear, feature in zip(self.tokens, features, strict=True)]
        return EncodedContext(torch.stack([summary, *tokens], 1), summary, state=state[0] if self.state_width else None)


class TokenContext(Context):
    """n tokens per frame: for every camera those of TokenLearner and one of keypoints, and one for the robot state.

    The frames are followed by a token of the instruction and one that an MLP computes from the newest frame and the
    instruction. Without the latter, with attention alone, training takes several times as long.

    Args:
        history: T.
        learned_tokens: tokens per camera and frame.
        keypoints: number of keypoints in an additional token per camera; 0 omits the token.
        proprioception: add a token of the robot state.
        frames_alone: omit the fusion, for a model that calls `encode` but not `forward`.
    """

    def __init__(
        self,
        history: Steps,
        learned_tokens: Natural,
        keypoints: Natural,
        proprioception: bool,
        *,
        frames_alone: bool = False,
        **inherited: Inherited,
    ) -> None:
        super().__init__(**inherited)
        self.history, cameras, width = history, self.spec.cameras, self.width
        self.per_frame = len(cameras) * (learned_tokens + (keypoints > 0)) + proprioception  # n
        if not self.per_frame:
            raise UserError("a frame needs a token: raise model.context.learned_tokens, or model.context.keypoints")
        self.image = self.make_encoder()  # the cameras share it
        self.token_learners = nn.ModuleList(TokenLearner(self.image.channels, learned_tokens) for _ in cameras)
        self.image_tokens = nn.Linear(self.image.channels, width)
        self.keypoints: nn.ModuleList | None = None
        if keypoints:
            heads = [Keypoints(self.image.channels, keypoints) for _ in cameras]
            self.keypoints = nn.ModuleList(heads)
            self.keypoint_tokens = nn.ModuleList(nn.Linear(keypoints * head.width, width) for head in heads)
        self.proprioception = Proprioception(self.spec) if proprioception else None
        if self.proprioception:
            self.proprioception_token = nn.Linear(self.proprioception.width, width)
        self.fusion = None if frames_alone else _Fusion(history, self.per_frame, self.text_width, width)
        self.length = history * self.per_frame + 2

    def encode(self, batch: Batch, text: Tensor) -> Tensor:
        """Return (B, T, n, E) tokens of the frames."""
        cameras, frames = len(self.spec.cameras), batch["present"].shape[1]
        # One pass of the encoder for all cameras.
        images = pixels(torch.cat([batch["rgb"][camera] for camera in self.spec.cameras]))
        maps = self.image(images, text.repeat(cameras, 1).repeat_interleave(frames, 0))  # (cameras·B·T, C, h, w)
        tokens = []
        for index, features in enumerate(maps.chunk(cameras)):  # (B·T, C, h, w) each
            image_tokens = self.image_tokens(self.token_learners[index](features))
            tokens.append(image_tokens.unflatten(0, (-1, frames)))  # (B, T, learned_tokens, E)
            if self.keypoints is not None:
                positions = self.keypoint_tokens[index](self.keypoints[index](features).flatten(1))
                tokens.append(positions.view(-1, frames, 1, positions.shape[-1]))
        if self.proprioception is not None:
            tokens.append(self.proprioception_token(self.proprioception(batch)).unsqueeze(2))
        return torch.cat(tokens, 2)

    def forward(self, batch: Batch, text: Tensor) -> EncodedContext:
        """Return the context of up to `history` frames; positions are aligned at the newest one, which comes last."""
        frames = batch["tokens"] if "tokens" in batch else self.encode(batch, text)
        frames, present = roll_newest_last(frames, batch["present"])
        padding = ~present.repeat_interleave(self.per_frame, 1)
        assert self.fusion is not None, "omitted only for models that do not call this"
        tokens = self.fusion(frames, text)
        return EncodedContext(tokens, tokens[:, -1], F.pad(padding, (0, 2)))


class _Fusion(nn.Module):
    """Tokens of frames → the same with positions, the instruction, and an MLP of the newest frame and the instruction.

    Args:
        history, per_frame: T and n.
        text_width: length of the instruction vector.
        width: E.
    """

    def __init__(self, history: int, per_frame: int, text_width: int, width: int) -> None:
        super().__init__()
        self.positions = nn.Embedding(history * per_frame, width)
        nn.init.normal_(self.positions.weight, std=0.05)
        self.instruction = nn.Linear(text_width, width)
        input_layers = [nn.Linear((per_frame + 1) * width, 2 * width), nn.ReLU()]
        output_layers = [nn.Linear(2 * width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)]
        self.mlp = nn.Sequential(*input_layers, *output_layers)
        self.norm = nn.LayerNorm(width)

    def forward(self, frames: Tensor, text: Tensor) -> Tensor:
        """Map (B, T, n, E) frames, the newest last, and (B, text_width) text to (B, T·n + 2, E)."""
        frame_tokens = frames.flatten(1, 2)
        frame_tokens = frame_tokens + self.positions.weight[-frame_tokens.shape[1] :]
        instruction = self.instruction(text).unsqueeze(1)
        summary = self.mlp(torch.cat([frames[:, -1], instruction], 1).flatten(1)).unsqueeze(1)
        return self.norm(torch.cat([frame_tokens, instruction, summary], 1))


def roll_newest_last(frames: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Roll (B, T, n, E) frames and their (B, T) mask until the newest present frame is last: 1, 2, - → -, 1, 2."""
    length = present.shape[1]
    places = (torch.arange(length, device=present.device) + newest_index(present)[:, None] + 1) % length  # (B, T)
    return frames.gather(1, places[:, :, None, None].expand_as(frames)), present.gather(1, places)
