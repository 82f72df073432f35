"""Configurations of networks, trainings and searches, and the recipes that combine them.

Nothing heavy is imported here, because the command line is made from these classes.
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

from tactip_twin.tactip_model.bounds import check, require, within
from tactip_twin.tactip_model.errors import lookup

Activation = Literal["relu", "elu"]
"""Names of the activations [P]."""

Downsampling = Literal["pool", "stride"]
"""Names of the methods of halving an image in a convolution layer."""

ScheduleName = Literal["paper", "cosine"]
"""Names of the learning-rate schedules (training.SCHEDULES)."""

Precision = Literal["auto", "float32", "bfloat16"]
"""Names of the precisions of the convolutions (device.is_half)."""

DeviceName = Literal["auto", "cpu", "cuda"]
"""Names of the devices (device.device_named)."""

OpticsName = Literal["lens", "real", "rim", "steady", "lens-clean", "real-clean", "rim-clean", "steady-clean"]
"""Names of the ranges of optics (optics_ranges.OPTICS)."""

RecipeName = Literal["laptop", "paper"]
"""Names of the recipes (RECIPES)."""


def check_choice(kind: str, value: object, choices: Any) -> None:
    """Check that a value is one of the choices of a Literal type.

    Args:
        kind: Name of the choice, for the message.
        value: The value.
        choices: The Literal type.

    Raises:
        TactipError: If it is none of them; the message lists them.
    """
    lookup(kind, value, dict.fromkeys(get_args(choices)))


@dataclass(frozen=True)
class PoseNetConfig:
    """Hyperparameters of a network and its training that the paper's search chooses. Defaults: its best for the surface."""

    conv_layers: int = within(1, 8, default=5)
    """N_conv, convolutions; 1 to 5 [P]."""
    filters: int = within(1, 1024, default=512)
    """N_filters, of the first convolution; 2, 4, … 512 [P]."""
    filter_growth: float = within(0.5, 4, default=1.0)
    """Filters of each convolution over those of the one before; 1 [P]."""
    max_filters: int = within(1, 1024, default=1024)
    """... up to so many."""
    blur_px: float = within(0, 4, default=0.0)
    """Standard deviation of a blur of the image before all else, px; none [P]. Pooling keeps the place of a grey slope to
    a part of a pixel, and that of a step only to a pixel."""
    downsample: int = within(1, 8, default=1)
    """The image is then averaged over squares of so many px; 1 [P]. At 2, a blurred image keeps what it tells, and costs a
    quarter."""
    pixel_unshuffle: bool = False
    """The pixels of those squares become channels instead: none is lost, and only the first convolution costs more."""
    dense_layers: int = within(1, 5, default=1)
    """N_dense, dense layers; 1 to 5 [P]."""
    dense_units: int = within(1, 4096, default=16)
    """N_units, of each dense layer; 2, 4, … 512 [P]."""
    activation: Activation = "relu"
    """relu or elu [P]."""
    batch_norm: bool = False
    """Batch normalisation after each convolution [P]."""
    group_norm: int = within(0, 1024, default=0)
    """Group normalisation in its place, over so many filters each; none [P]. A batch's mean is another at every step, which
    features that are to tell a hundredth of a millimetre notice."""
    downsampling: Downsampling = "pool"
    """How a convolution layer halves its image: pool, 2×2 max-pooling [P], or stride, a convolution of stride 2. The largest
    of four does not tell where a pin is to a part of a pixel; a stride does, and costs less."""
    extra_convs: int = within(0, 4, default=0)
    """Convolutions that follow in each layer, of the same width; none [P]."""
    dropout: float = within(0, 0.9, default=0.001)
    """Share of the inputs of each dense layer that is left out in training; 0 to 0.5 [P]."""
    l1: float = within(0, 1, default=0.001)
    """Weight of the sum of absolute weights of dense and output layers in the loss; 1e-4 to 1e-1 [P]."""
    l2: float = within(0, 1, default=0.064)
    """Weight of the sum of their squares; 1e-4 to 1e-1 [P]."""
    batch_size: int = within(1, 4096, default=32)
    """Images a step of training; 16, 32, 64 or 128 [P]."""

    def __post_init__(self) -> None:
        check(self)
        check_choice("activation", self.activation, Activation)
        require(not (self.batch_norm and self.group_norm), "group_norm", self.group_norm, "0 with batch norm")
        check_choice("downsampling", self.downsampling, Downsampling)
        require(
            not (self.pixel_unshuffle and self.downsample == 1),
            "downsample",
            self.downsample,
            "above 1 with pixel_unshuffle",
        )

    def shape(self) -> dict[str, Any]:
        """Return the fields that determine the weights' shapes, i.e. all except those that affect training only."""
        return {k: v for k, v in asdict(self).items() if k not in ("dropout", "l1", "l2", "batch_size")}

    def widths(self) -> list[int]:
        """Return the number of filters of each convolution layer."""
        unlimited = (self.filters * self.filter_growth**k for k in range(self.conv_layers))
        return [max(1, min(round(w), self.max_filters)) for w in unlimited]

    def last_size(self, size: int) -> int:
        """Return the width, px, of the last convolution layer's output for images of `size` px.

        Raises:
            TactipError: If no pixels remain.
        """
        remaining = size // self.downsample
        for layer in range(1, self.conv_layers + 1):
            remaining = (remaining - 2) // 2
            require(
                remaining >= 1,
                "conv_layers",
                self.conv_layers,
                f"at most {layer - 1}: an image of {size} px has no pixels left after convolution and pooling {layer}",
            )
        return remaining


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training. Defaults are the paper's."""

    seed: int = within(0, 2**31, default=0)
    """Seed of weights, order and dropout."""
    epochs: int = within(1, 100000, default=500)
    """Most epochs; the paper names no limit."""
    min_steps: int = within(0, 10**8, default=0)
    """Steps for which a small set is gone through more often than `epochs`; none [P]."""
    patience: int = within(1, 100000, default=10)
    """Epochs without a lower validation error after which training ends [P]."""
    learning_rate: float = within(1e-7, 1, default=1e-4)
    """Learning rate of Adam [P]."""
    muon_learning_rate: float = within(0, 1, default=0.0)
    """Learning rate of Muon (muon.py), which then takes the weights between layers; 0 for Adam alone [P]."""
    learning_rate_decay: float = within(0, 1, default=1e-6)
    """Its decay a step [P], of the schedule `paper`."""
    schedule: ScheduleName = "paper"
    """paper, or cosine: to zero over all epochs."""
    precision: Precision = "auto"
    """Of the convolutions: float32, bfloat16, or auto: bfloat16 on a GPU, and on a CPU that multiplies matrices of it (AMX),
    where that is twice as fast."""
    augmented_fraction: float = within(0, 1, default=0.0)
    """Share of the images that are drawn anew at every step, from their pins under varied optics (augmentation.py); the rest
    are the plain images of the set [P]."""
    augmentation_strength: float = within(0, 4, default=1.0)
    """How far the optics are varied for that, of the ranges `varied`; 0.2 of `lens` is little more than which pixels a pin
    falls on."""
    optics_ranges: OpticsName = "lens"
    """What is varied: lens, real, rim or steady (optics_ranges.py), each also without noise: lens-clean and so on."""

    def __post_init__(self) -> None:
        check(self)
        check_choice("schedule", self.schedule, ScheduleName)
        check_choice("optics_ranges", self.optics_ranges, OpticsName)
        check_choice("precision", self.precision, Precision)


@dataclass(frozen=True)
class SearchSpace:
    """Limits of the networks that a search tries; the paper's by default. Filters and units are powers of two from 2 on."""

    max_conv_layers: int = within(1, 8, default=5)
    """Most convolutions [P]."""
    max_filters: int = within(2, 1024, default=512)
    """Most filters [P]; a CPU hardly trains more than 64."""
    max_dense_layers: int = within(1, 5, default=5)
    """Most dense layers [P]."""
    max_dense_units: int = within(2, 4096, default=512)
    """Most units [P]."""
    blur_px: float = within(0, 4, default=0.0)
    """Of every network (PoseNetConfig.blur_px); none [P]."""
    downsample: int = within(1, 8, default=1)
    """Of every network (PoseNetConfig.reduce); 1 [P]. At 2 convolutions multiply a quarter, and 4 of them are the most."""

    def __post_init__(self) -> None:
        check(self)

    def check_image_size(self, size: int) -> None:
        """Check that every network of the space can take images of `size` px.

        Raises:
            TactipError: If the convolutions of one leave no pixels.
        """
        PoseNetConfig(conv_layers=self.max_conv_layers, downsample=self.downsample).last_size(size)


@dataclass(frozen=True)
class TuneSettings:
    """Settings of a search. Defaults are the paper's."""

    trials: int = within(1, 100000, default=300)
    """Trainings in all [P]."""
    random_trials: int = within(1, 100000, default=50)
    """The first so many at random [P]."""
    seed: int = within(0, 2**31, default=0)
    """Seed of the suggestions; every training has the seed of `training`."""
    prune: bool = False
    """End a trial that, after as many epochs, is worse than half of those before it; the paper did not."""
    min_epochs: int = within(1, 1000, default=5)
    """... but not before so many epochs."""
    space: SearchSpace = field(default_factory=SearchSpace)
    """Networks that may be tried."""
    training: TrainSettings = field(default_factory=TrainSettings)
    """How each is trained."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Recipe:
    """A network and how it is trained."""

    network: PoseNetConfig
    """The network."""
    settings: TrainSettings
    """Settings of its training."""


_PAPER = {
    "surface": PoseNetConfig(),
    "edge": PoseNetConfig(filters=256, dense_layers=2, dense_units=512, dropout=0.203, l1=1e-4, l2=3e-4, batch_size=16),
}
"""The paper's best networks. Where its text and Table 2 differ, these are from the table [P]."""

_LAPTOP = PoseNetConfig(
    conv_layers=4,
    filters=32,
    filter_growth=2.0,
    max_filters=128,
    downsample=2,
    pixel_unshuffle=True,
    downsampling="stride",
    extra_convs=1,
    dense_layers=3,
    dense_units=256,
    activation="elu",
    group_norm=16,
    dropout=0.0,
    l1=0.0,
    l2=0.0,
    batch_size=32,
)

_LAPTOP_TRAINING = TrainSettings(
    epochs=36,
    min_steps=8000,
    patience=100000,
    learning_rate=1.4e-3,
    muon_learning_rate=0.014,
    schedule="cosine",
    augmented_fraction=0.4,
    augmentation_strength=0.2,
)

RECIPES: dict[RecipeName, dict[str, Recipe]] = {
    "laptop": {
        "surface": Recipe(_LAPTOP, _LAPTOP_TRAINING),
        "edge": Recipe(_LAPTOP, replace(_LAPTOP_TRAINING, epochs=26, augmented_fraction=0.5)),
    },
    "paper": {task: Recipe(network, TrainSettings()) for task, network in _PAPER.items()},
}
"""Recipes by name and task. `laptop` is made for two cores: its convolutions need about 300 times fewer multiplications per
image than the paper's for the surface. `tactip bench learning` compares the two."""
