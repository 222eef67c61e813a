"""Frames as a few tokens each, for models that look at several.

Shapes: B batch, T frames, N tokens per frame, E width of a token.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from vla.models.action_tokenizer import ActionTokenizer
from vla.models.image_tokenizer import ImageEncoder, Keypoints, RandomShift, TokenLearner
from vla.models.model import Batch, Model, Standardize, pixels
from vla.models.text import TextEncoder
from vla.spec import Spec
from vla.types import Natural, NonNegative, Pixels, Shift, Steps


class FrameModel(Model):
    """A model that reads N tokens of every frame: learned ones and keypoints of every camera, and proprioception.

    Args:
        image: makes the image encoder, called with `text_width`; the cameras share it.
        text: makes the text encoder, called with `width`.
        history: T.
        image_size: images are resized to this height and width [px]; None leaves them as they are.
        learned_tokens: tokens per camera and frame.
        keypoints: add, per camera, a token made of this many keypoints.
        proprioception: add a token for joints and gripper.
        chunk: k, the actions predicted for a frame.
        auxiliary: weight of the head that predicts the simulator's truth, in training only; 0 leaves it out.
        text_width: length of the sentence vector.
        width: E.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height]; one
            offset for all frames of a window.
        spec: what a step looks like.
        tokenizer: how actions and tokens belong together.
    """

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        text: Callable[..., TextEncoder],
        history: Steps,
        image_size: Pixels | None,
        learned_tokens: Natural,
        keypoints: Natural,
        proprioception: bool,
        chunk: Steps,
        auxiliary: NonNegative,
        text_width: int,
        width: int,
        shift: Shift,
        spec: Spec,
        tokenizer: ActionTokenizer,
    ) -> None:
        super().__init__(
            history=history,
            chunk=chunk,
            text=text(width=text_width),
            auxiliary=auxiliary,
            truth_width=width,
            spec=spec,
            tokenizer=tokenizer,
        )
        self.image_size = image_size
        self.tokens = len(spec.cameras) * (learned_tokens + (keypoints > 0)) + proprioception  # N
        self.shift = RandomShift(*shift)
        self.image = image(text_width=text_width)
        self.token_learners = nn.ModuleList(TokenLearner(self.image.channels, learned_tokens) for _ in spec.cameras)
        self.image_tokens = nn.Linear(self.image.channels, width)
        self.keypoints: nn.ModuleList | None = None
        if keypoints:
            readers = [Keypoints(self.image.channels, keypoints) for _ in spec.cameras]
            self.keypoints = nn.ModuleList(readers)
            self.keypoint_tokens = nn.ModuleList(nn.Linear(keypoints * reader.width, width) for reader in readers)
        self.proprioception: Standardize | None = None
        if proprioception:
            self.proprioception = Standardize(self.posture_width)
            self.proprioception_token = nn.Linear(self.posture_width, width)

    def encode(self, batch: Batch) -> Tensor:
        """The (B, T, N, E) tokens of the frames, which depend on nothing but the frame and the instruction."""
        text = self.text(batch["text"])  # (B, text_width)
        frames = batch["present"].shape[1]
        repeated = text.repeat_interleave(frames, 0)  # (B·T, text_width)
        tokens = []
        for index, camera in enumerate(self.spec.cameras):
            images = pixels(self.shift(batch["rgb"][camera]), self.image_size)
            features = self.image(images, repeated)  # (B·T, C, h, w)
            learned = self.image_tokens(self.token_learners[index](features))
            tokens.append(learned.unflatten(0, (-1, frames)))  # (B, T, learned_tokens, E)
            if self.keypoints is not None:
                positions = self.keypoint_tokens[index](self.keypoints[index](features).flatten(1))
                tokens.append(positions.view(-1, frames, 1, positions.shape[-1]))
        if self.proprioception is not None:
            standard = self.proprioception(self.posture(batch), batch["present"])
            tokens.append(self.proprioception_token(standard).unsqueeze(2))
        return torch.cat(tokens, 2)
