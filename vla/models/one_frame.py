"""Base class of models that see the newest frame only.

Shapes: B batch, C features of a camera.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from vla.io.types import Inherited, Shift, Width
from vla.models.model import Batch, Model, RunningNormalizer, pixels
from vla.models.vision.image_tokenizer import ImageEncoder, Keypoints, RandomShift


class OneFrameModel(Model):
    """A model of keypoints in the images, the robot state and the instruction, with an image encoder per camera.

    Args:
        image: factory of the image encoder, called with `text_width` once per camera.
        keypoints: keypoints per camera.
        shift: largest random shift of the training images, vertical and horizontal [1/256 of the image height].
        proprioception: use the robot state.
    """

    def __init__(
        self,
        image: Callable[..., ImageEncoder],
        keypoints: Width,
        shift: Shift,
        proprioception: bool = True,  # not in the config of older checkpoints
        **inherited: Inherited,
    ) -> None:
        super().__init__(**inherited)
        self.shift = RandomShift(*shift)
        encoders = [image(text_width=self.text.width) for _ in self.spec.cameras]
        self.images = nn.ModuleList(encoders)
        keypoint_heads = [Keypoints(encoder.channels, keypoints) for encoder in encoders]
        self.keypoints = nn.ModuleList(keypoint_heads)
        self.image_widths = [keypoints * head.width for head in keypoint_heads]  # C of each camera
        self.proprioception = RunningNormalizer(self.robot_state_width) if proprioception else None
        self.state_widths = [self.robot_state_width] if proprioception else []

    def augment(self, batch: Batch) -> Batch:
        """Shift the images of every window."""
        return {**batch, "rgb": self.shift(batch["rgb"])}

    def image_features(self, batch: Batch, text: Tensor) -> list[Tensor]:
        """Return the (B, C) keypoint features of every camera, given the (B, text_width) instruction."""
        features = []
        for camera, encoder, keypoints in zip(self.spec.cameras, self.images, self.keypoints, strict=True):
            features.append(keypoints(encoder(pixels(batch["rgb"][camera][:, -1:]), text)).flatten(1))
        return features

    def state_features(self, batch: Batch) -> list[Tensor]:
        """Return the (B, robot_state_width) normalised robot state, or nothing without proprioception."""
        if self.proprioception is None:
            return []
        return [self.proprioception(self.robot_state(batch)[:, -1:], batch["present"][:, -1:]).squeeze(1)]
