"""PoseNet: the convolutional network of the paper, from a tactile image to the components of a pose.

    conv_layers × (3×3 convolution, stride 1, no padding [, batch norm], activation, 2×2 max-pool)
                  or, by strides, (4×4 convolution of stride 2 [, batch norm], activation)
                  and, further, more 3×3 convolutions that keep the size, each with norm and activation
    dense_layers × (dropout, dense, activation)
    dropout, linear output

The paper's own setting is the default of every field that it does not have.
"""

import torch
from torch import nn

ACTIVATIONS = {"relu": nn.ReLU, "elu": nn.ELU}
"""Activations by name [P]."""


class PoseNet(nn.Module):
    """The network. Input (n, 1, size, size), 0 to 1; output (n, outputs), components over their scales (labels.py)."""

    def __init__(self, config, size, outputs):
        """config: PoseNetConfig. size: int, px. outputs: int. Raises TactipError where no pixels are left."""
        super().__init__()
        last = config.last_size(size)
        activation = ACTIVATIONS[config.activation]
        reduce = 1 if config.fold else config.reduce
        layers = [_Blur(config.blur_px, reduce)] if config.blur_px or reduce > 1 else []
        layers, before = ([*layers, nn.PixelUnshuffle(config.reduce)], config.reduce**2) if config.fold else (layers, 1)
        for width in config.widths():
            layers += self._layer(config, before, width)
            before = width
        self.convolutions = nn.Sequential(*layers)
        layers, before = [], before * last**2
        for _ in range(config.dense_layers):
            layers += [nn.Dropout(config.dropout), nn.Linear(before, config.units), activation()]
            before = config.units
        self.dense = nn.Sequential(*layers, nn.Dropout(config.dropout), nn.Linear(before, outputs))
        self._l1, self._l2 = config.l1, config.l2

    def _layer(self, config, before, width):
        """The modules of one convolution layer, from `before` to `width` filters."""

        def finish():
            norm = [nn.BatchNorm2d(width)] if config.batch_norm else []
            if config.group_norm:
                groups = max(1, width // config.group_norm)
                norm = [nn.GroupNorm(groups if width % groups == 0 else 1, width)]
            return [*norm, ACTIVATIONS[config.activation]()]

        if config.halving == "stride":
            layers = [nn.Conv2d(before, width, 4, stride=2), *finish()]
        elif config.batch_norm or config.group_norm:
            layers = [nn.Conv2d(before, width, 3), *finish(), nn.MaxPool2d(2)]
        else:  # the activations rise throughout: to pool first gives the same, for less
            layers = [nn.Conv2d(before, width, 3), nn.MaxPool2d(2), *finish()]
        for _ in range(config.further):
            layers += [nn.Conv2d(width, width, 3, padding=1), *finish()]
        return layers

    def forward(self, images):
        """Components over their scales, (n, outputs) float32, of images (n, 1, size, size)."""
        features = self.convolutions(images).flatten(1).float()
        # Half precision is good enough for features, and not for the pose: its eight bits are 0.02 mm of 5.
        with torch.autocast(features.device.type, enabled=False):
            return self.dense(features)

    def penalty(self):
        """What L1 and L2 add to the loss: a scalar tensor, of the weights of dense and output layers alone [P]."""
        weights = [layer.weight.float() for layer in self.dense if isinstance(layer, nn.Linear)]
        return sum(self._l1 * w.abs().sum() + self._l2 * w.square().sum() for w in weights)


class _Blur(nn.Module):
    """A Gaussian blur and a mean over squares, in one step; not learned."""

    def __init__(self, sigma, reduce):
        """sigma: float, px; 0 for none. reduce: int, px, width of the squares."""
        super().__init__()
        reach = int(3 * sigma + 0.5)
        line = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / sigma) ** 2) if reach else torch.ones(1)
        box = torch.ones(1, 1, reduce) / reduce
        line = nn.functional.conv1d((line / line.sum())[None, None], box, padding=reduce - 1)[0, 0]
        self.reach, self.reduce = reach, reduce
        self.register_buffer("kernel", torch.outer(line, line)[None, None], persistent=False)

    def forward(self, images):
        return nn.functional.conv2d(images, self.kernel.to(images.dtype), padding=self.reach, stride=self.reduce)


def parameter_count(net):
    """Trained numbers (int) of a network."""
    return sum(p.numel() for p in net.parameters())
