"""PoseNet: the convolutional network of the paper, from a tactile image to the components of a pose.

    conv_layers × (3×3 convolution, stride 1, no padding [, batch norm], activation, 2×2 max-pool)
                  or, by strides, (4×4 convolution of stride 2 [, batch norm], activation)
                  and, further, more 3×3 convolutions that keep the size, each with norm and activation
    dense_layers × (dropout, dense, activation)
    dropout, linear output

The paper's own setting is the default of every field that it does not have.
"""

from dataclasses import asdict, dataclass

import torch
from torch import nn

from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import lookup

ACTIVATIONS = {"relu": nn.ReLU, "elu": nn.ELU}
"""Activations by name [P]."""


@dataclass(frozen=True)
class PoseNetConfig:
    """Everything that is chosen of a network and its training by the paper's search. Defaults: its best for the surface."""

    conv_layers: int = within(1, 8, default=5)
    """N_conv, convolutions; 1 to 5 [P]."""
    filters: int = within(1, 1024, default=512)
    """N_filters, of the first convolution; 2, 4, … 512 [P]."""
    widening: float = within(0.5, 4, default=1.0)
    """Filters of each convolution over those of the one before; 1 [P]."""
    most_filters: int = within(1, 1024, default=1024)
    """... up to so many."""
    blur_px: float = within(0, 4, default=0.0)
    """Standard deviation of a blur of the image before all else, px; none [P]. Pooling keeps the place of a grey slope to
    a part of a pixel, and that of a step only to a pixel."""
    reduce: int = within(1, 8, default=1)
    """The image is then averaged over squares of so many px; 1 [P]. At 2, a blurred image keeps what it tells, and costs a
    quarter."""
    fold: bool = False
    """The pixels of those squares become channels instead: none is lost, and only the first convolution costs more."""
    dense_layers: int = within(1, 5, default=1)
    """N_dense, dense layers; 1 to 5 [P]."""
    units: int = within(1, 4096, default=16)
    """N_units, of each dense layer; 2, 4, … 512 [P]."""
    activation: str = "relu"
    """relu or elu [P]."""
    batch_norm: bool = False
    """Batch normalisation after each convolution [P]."""
    group_norm: int = within(0, 1024, default=0)
    """Group normalisation in its place, over so many filters each; none [P]. A batch's mean is another at every step, which
    features that are to tell a hundredth of a millimetre notice."""
    halving: str = "pool"
    """How a convolution layer halves its image: pool, 2×2 max-pooling [P], or stride, a convolution of stride 2. The largest
    of four does not tell where a pin is to a part of a pixel; a stride does, and costs less."""
    further: int = within(0, 4, default=0)
    """Convolutions that follow in each layer, of the same width; none [P]."""
    dropout: float = within(0, 0.9, default=0.001)
    """Share of the inputs of each dense layer that is left out in training; 0 to 0.5 [P]."""
    l1: float = within(0, 1, default=0.001)
    """Weight of the sum of absolute weights of dense and output layers in the loss; 1e-4 to 1e-1 [P]."""
    l2: float = within(0, 1, default=0.064)
    """Weight of the sum of their squares; 1e-4 to 1e-1 [P]."""
    batch_size: int = within(1, 4096, default=32)
    """Images a step of training; 16, 32, 64 or 128 [P]."""

    def __post_init__(self):
        check(self)
        lookup("activation", self.activation, ACTIVATIONS)
        require(not (self.batch_norm and self.group_norm), "group_norm", self.group_norm, "0 with batch norm")
        lookup("halving", self.halving, dict.fromkeys(("pool", "stride")))
        require(not (self.fold and self.reduce == 1), "reduce", self.reduce, "above 1 with fold")

    def shape(self):
        """What two networks must share (dict) for one to take the other's weights: all but how it is trained."""
        return {k: v for k, v in asdict(self).items() if k not in ("dropout", "l1", "l2", "batch_size")}

    def widths(self):
        """Filters (list of int) of each convolution."""
        wide = (self.filters * self.widening**k for k in range(self.conv_layers))
        return [max(1, min(round(w), self.most_filters)) for w in wide]

    def last_size(self, size):
        """Width (int), px, that the convolutions leave of an image of `size` px. Raises TactipError if nothing is left."""
        left = size // self.reduce
        for layer in range(1, self.conv_layers + 1):
            left = (left - 2) // 2
            require(
                left >= 1,
                "conv_layers",
                self.conv_layers,
                f"at most {layer - 1}: an image of {size} px has no pixels left after convolution and pooling {layer}",
            )
        return left


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
