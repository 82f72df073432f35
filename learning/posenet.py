"""PoseNet: the convolutional network of the paper, which predicts pose components from a tactile image.

    conv_layers × (3×3 convolution, stride 1, no padding [, batch norm], activation, 2×2 max-pool)
                  or, with strides, (4×4 convolution of stride 2 [, batch norm], activation);
                  with `further`, more 3×3 convolutions that keep the size, each with norm and activation
    dense_layers × (dropout, dense, activation)
    dropout, linear output

Options beyond the paper are off by default.
"""

import torch
from torch import nn

from tactip_twin.learning.configuration import Activation, PoseNetConfig

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "elu": nn.ELU}
"""Activations by name [P]."""


class PoseNet(nn.Module):
    """Network with input (n, 1, size, size), 0 to 1, and output (n, outputs), components over their scales (labels.py)."""

    def __init__(self, config: PoseNetConfig, size: int, outputs: int) -> None:
        """Build the network with random weights from torch's generator.

        Args:
            config: Hyperparameters.
            size: Image width, px.
            outputs: Number of components.

        Raises:
            TactipError: If the convolutions leave no pixels.
        """
        super().__init__()
        last = config.last_size(size)
        activation = ACTIVATIONS[config.activation]
        reduce = 1 if config.pixel_unshuffle else config.downsample
        layers: list[nn.Module] = [_Blur(config.blur_px, reduce)] if config.blur_px or reduce > 1 else []
        channels = 1
        if config.pixel_unshuffle:
            layers.append(nn.PixelUnshuffle(config.downsample))
            channels = config.downsample**2
        for width in config.widths():
            layers += self._layer(config, channels, width)
            channels = width
        self.convolutions = nn.Sequential(*layers)
        dense: list[nn.Module] = []
        inputs = channels * last**2
        for _ in range(config.dense_layers):
            dense += [nn.Dropout(config.dropout), nn.Linear(inputs, config.dense_units), activation()]
            inputs = config.dense_units
        self.dense = nn.Sequential(*dense, nn.Dropout(config.dropout), nn.Linear(inputs, outputs))
        self._l1, self._l2 = config.l1, config.l2

    def _layer(self, config: PoseNetConfig, channels: int, width: int) -> list[nn.Module]:
        """Return the modules of one convolution layer, from `channels` to `width` filters."""

        def finish() -> list[nn.Module]:
            """Return the norm, if any, and the activation."""
            norm: list[nn.Module] = [nn.BatchNorm2d(width)] if config.batch_norm else []
            if config.group_norm:
                groups = max(1, width // config.group_norm)
                norm = [nn.GroupNorm(groups if width % groups == 0 else 1, width)]
            return [*norm, ACTIVATIONS[config.activation]()]

        if config.downsampling == "stride":
            layers = [nn.Conv2d(channels, width, 4, stride=2), *finish()]
        elif config.batch_norm or config.group_norm:
            layers = [nn.Conv2d(channels, width, 3), *finish(), nn.MaxPool2d(2)]
        else:  # the activations are monotonic, so pooling first gives the same result at a lower cost
            layers = [nn.Conv2d(channels, width, 3), nn.MaxPool2d(2), *finish()]
        for _ in range(config.extra_convs):
            layers += [nn.Conv2d(width, width, 3, padding=1), *finish()]
        return layers

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Predict components over their scales, (n, outputs) float32, from images (n, 1, size, size)."""
        features = self.convolutions(images).flatten(1).float()
        # Half precision suffices for features but not for the pose: eight bits of 5 mm are 0.02 mm.
        with torch.autocast(features.device.type, enabled=False):
            return self.dense(features)

    def penalty(self) -> torch.Tensor:
        """Return the L1 and L2 terms of the loss, a scalar, over the weights of the dense and output layers only [P]."""
        weights = [layer.weight.float() for layer in self.dense if isinstance(layer, nn.Linear)]
        first, *rest = (self._l1 * w.abs().sum() + self._l2 * w.square().sum() for w in weights)
        return sum(rest, first)


class _Blur(nn.Module):
    """Gaussian blur and averaging over squares in one convolution with fixed weights."""

    kernel: torch.Tensor

    def __init__(self, sigma: float, reduce: int) -> None:
        """Build the kernel. sigma: standard deviation, px; 0 for no blur. reduce: width of the squares, px."""
        super().__init__()
        radius = int(3 * sigma + 0.5)
        line = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2) if radius else torch.ones(1)
        box = torch.ones(1, 1, reduce) / reduce
        line = nn.functional.conv1d((line / line.sum())[None, None], box, padding=reduce - 1)[0, 0]
        self.radius, self.downsample = radius, reduce
        self.register_buffer("kernel", torch.outer(line, line)[None, None], persistent=False)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return the blurred and averaged images."""
        return nn.functional.conv2d(images, self.kernel.to(images.dtype), padding=self.radius, stride=self.downsample)


def parameter_count(net: nn.Module) -> int:
    """Return the number of trainable parameters of a network."""
    return sum(p.numel() for p in net.parameters())
