"""Base class of models that encode every frame of a history as a few tokens.

Shapes: B batch, T frames, N tokens per frame, E width of a token.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import Inherited, Natural, Pixels, Shift, Steps
from vla.models.model import Batch, Model, RunningNormalizer, pixels
from vla.models.vision.image_tokenizer import ImageEncoder, Keypoints, RandomShift, TokenLearner


class FrameModel(Model):
    """A model over N tokens per frame: TokenLearner and keypoint tokens of every camera, and proprioception.

    Args:
        image: factory of the image encoder, called with `text_width`; the cameras share it.
        history: T.
        image_size: images are resized to this height and width [px]; null keeps their size.
        learned_tokens: tokens per camera and frame.
        keypoints: number of keypoints in an additional token per camera; 0 omits the token.
        proprioception: add a token of the robot state.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height]; one
            offset for all frames of a window.
    """

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        history: Steps,
        image_size: Pixels | None,
        learned_tokens: Natural,
        keypoints: Natural,
        proprioception: bool,
        shift: Shift,
        **inherited: Inherited,
    ) -> None:
        super().__init__(**inherited)
        cameras, width = self.spec.cameras, self.width
        self.history, self.image_size = history, image_size
        self.tokens = len(cameras) * (learned_tokens + (keypoints > 0)) + proprioception  # N
        if not self.tokens:
            raise UserError(
                "a frame needs a token: raise model.learned_tokens or model.keypoints, or set model.proprioception=true"
            )
        self.shift = RandomShift(*shift)
        self.image = image(text_width=self.text.width)
        self.token_learners = nn.ModuleList(TokenLearner(self.image.channels, learned_tokens) for _ in cameras)
        self.image_tokens = nn.Linear(self.image.channels, width)
        self.keypoints: nn.ModuleList | None = None
        if keypoints:
            keypoint_heads = [Keypoints(self.image.channels, keypoints) for _ in cameras]
            self.keypoints = nn.ModuleList(keypoint_heads)
            self.keypoint_tokens = nn.ModuleList(nn.Linear(keypoints * head.width, width) for head in keypoint_heads)
        self.proprioception: RunningNormalizer | None = None
        if proprioception:
            self.proprioception = RunningNormalizer(self.robot_state_width)
            self.proprioception_token = nn.Linear(self.robot_state_width, width)

    def augment(self, batch: Batch) -> Batch:
        """Shift the images of every window."""
        return {**batch, "rgb": self.shift(batch["rgb"])}

    def encode(self, batch: Batch) -> Tensor:
        """Return (B, T, N, E) tokens; those of a frame depend only on that frame and the instruction."""
        cameras, frames = self.spec.cameras, batch["present"].shape[1]
        text = self.text(batch["text"]).repeat(len(cameras), 1).repeat_interleave(frames, 0)
        images = torch.cat([batch["rgb"][camera] for camera in cameras])  # one pass of the encoder for all cameras
        every = self.image(pixels(images, self.image_size), text)  # (cameras·B·T, C, h, w)
        tokens = []
        for index, features in enumerate(every.chunk(len(cameras))):  # (B·T, C, h, w) each
            learned = self.image_tokens(self.token_learners[index](features))
            tokens.append(learned.unflatten(0, (-1, frames)))  # (B, T, learned_tokens, E)
            if self.keypoints is not None:
                positions = self.keypoint_tokens[index](self.keypoints[index](features).flatten(1))
                tokens.append(positions.view(-1, frames, 1, positions.shape[-1]))
        if self.proprioception is not None:
            robot_state = self.proprioception(self.robot_state(batch), batch["present"])
            tokens.append(self.proprioception_token(robot_state).unsqueeze(2))
        return torch.cat(tokens, 2)
