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

OpticsName = Literal[
    "lens",
    "lens-jitter",
    "lens-salt",
    "real",
    "rim",
    "steady",
    "lens-clean",
    "lens-jitter-clean",
    "lens-salt-clean",
    "real-clean",
    "rim-clean",
    "steady-clean",
]
"""Names of the ranges of optics (optics_ranges.OPTICS)."""

MAX_DOWNSAMPLE = 8
"""Maximum downsampling of a network's input."""

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
    """Hyperparameters of a network and its training that the paper's search chooses. The defaults are its best for the
    surface."""

    conv_layers: int = within(1, 8, default=5)
    """Number of convolution layers; 1 to 5 [P]."""
    filters: int = within(1, 1024, default=512)
    """Number of filters of the first convolution; 2, 4, … 512 [P]."""
    filter_growth: float = within(0.5, 4, default=1.0)
    """Ratio of the numbers of filters of successive convolutions; 1 [P]."""
    max_filters: int = within(1, 1024, default=1024)
    """Maximum number of filters per convolution."""
    blur_px: float = within(0, 4, default=0.0)
    """Standard deviation of a Gaussian blur of the input, px; 0 [P]. On blurred images pooling keeps positions to a
    fraction of a pixel."""
    downsample: int = within(1, MAX_DOWNSAMPLE, default=1)
    """Downsample the input by averaging N×N pixels; 1 [P]. With 2, convolutions cost a quarter."""
    pixel_unshuffle: bool = False
    """Move each N×N block of the downsampling into channels instead of averaging it."""
    dense_layers: int = within(1, 5, default=1)
    """Number of dense layers; 1 to 5 [P]."""
    dense_units: int = within(1, 4096, default=16)
    """Number of units per dense layer; 2, 4, … 512 [P]."""
    activation: Activation = "relu"
    """Activation function: relu or elu [P]."""
    batch_norm: bool = False
    """Batch normalization after each convolution [P]."""
    group_norm: int = within(0, 1024, default=0)
    """Number of filters per group of a group normalization after each convolution, instead of batch normalization; 0 for
    none [P]."""
    downsampling: Downsampling = "pool"
    """Downsampling in each convolution layer: pool (2×2 max-pooling [P]) or stride (a convolution of stride 2, which is
    cheaper and keeps positions to a fraction of a pixel)."""
    extra_convs: int = within(0, 4, default=0)
    """Number of further convolutions in each layer; 0 [P]."""
    dropout: float = within(0, 0.9, default=0.001)
    """Dropout rate of the inputs of each dense layer; 0 to 0.5 [P]."""
    l1: float = within(0, 1, default=0.001)
    """Weight of the L1 penalty on dense and output layers; 1e-4 to 1e-1 [P]."""
    l2: float = within(0, 1, default=0.064)
    """Weight of the L2 penalty on dense and output layers; 1e-4 to 1e-1 [P]."""
    batch_size: int = within(1, 4096, default=32)
    """Number of images per training step; 16, 32, 64 or 128 [P]."""
    deviations: bool = False
    """Estimate a standard deviation for each component; not in the paper."""
    quantities: bool = False
    """Estimate shear, force, slip and contact beside the pose (learning/quantities.py); not in the paper."""

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
            TactipError: If no pixels remain, or the width cannot be divided into blocks of pixels.
        """
        if self.pixel_unshuffle:
            allowed = f"a divisor of the images' width, {size} px, with pixel_unshuffle"
            require(size % self.downsample == 0, "downsample", self.downsample, allowed)
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
    """Settings of a training. The defaults are the paper's."""

    seed: int = within(0, 2**31, default=0)
    """Seed of weights, order and dropout."""
    epochs: int = within(1, 100000, default=500)
    """Maximum number of epochs, or more if these have fewer than `min_steps` steps; the paper names no limit."""
    min_steps: int = within(0, 10**8, default=0)
    """Number of training steps for which small sets are repeated, beyond `epochs` epochs if need be; 0 [P]."""
    patience: int = within(1, 100000, default=10)
    """Number of epochs without a lower validation error after which training ends [P]."""
    learning_rate: float = within(1e-7, 1, default=1e-4)
    """Learning rate of Adam [P]."""
    muon_learning_rate: float = within(0, 1, default=0.0)
    """Learning rate of Muon (learning/muon.py) for the inner weights; 0 trains all weights by Adam [P]."""
    learning_rate_decay: float = within(0, 1, default=1e-6)
    """Decay of the learning rate per step with the schedule `paper` [P]."""
    schedule: ScheduleName = "paper"
    """Learning-rate schedule: paper, or cosine to zero over all epochs."""
    precision: Precision = "auto"
    """Precision of the convolutions. auto: bfloat16 where it is faster (on a GPU, and on a CPU with AMX), else
    float32."""
    augmented_fraction: float = within(0, 1, default=0.0)
    """Fraction of the images that are rendered again at every step with randomized optics (learning/augmentation.py); 0 uses
    only the images of the set [P]."""
    augmentation_strength: float = within(0, 4, default=1.0)
    """Factor on the ranges of `optics_ranges`."""
    optics_ranges: OpticsName = "lens"
    """Ranges of the randomized optics (learning/optics_ranges.py); `-clean` leaves image noise out."""
    validation_renderings: int = within(0, 100, default=0)
    """Number of renderings with randomized optics by which each validation image is replaced. For sensors whose camera is
    known within these ranges only: standard deviations then include what this makes uncertain. 0 uses the images of the
    set [P]."""
    drawn_contacts: int = within(0, 10**6, default=0)
    """Number of images per epoch that learned tips draw anew, beside those of the set and in its ranges, so none is
    learned by heart: single contacts, or sliding paths if the set has them; 0 [P]."""
    drawn_epochs: int = within(1, 1000, default=1)
    """Number of epochs after which they are drawn anew. On a GPU, drawing them takes longer than an epoch."""
    undeformed_fraction: float = within(0, 0.5, default=0.0)
    """Fraction of the training images that show the undeformed tip, for networks that estimate contact: few contacts of a
    set are as light. They are rendered, so the set needs pins; 0 [P]."""
    beta: float = within(0, 1, default=0.5)
    """Exponent of the standard deviations as weights of the negative log likelihood, where they are estimated
    (learning/outputs.py); 0 weighs all errors alike, 1 as a mean squared error does."""

    def __post_init__(self) -> None:
        check(self)
        check_choice("schedule", self.schedule, ScheduleName)
        check_choice("optics_ranges", self.optics_ranges, OpticsName)
        check_choice("precision", self.precision, Precision)


@dataclass(frozen=True)
class SearchSpace:
    """Limits of the networks that a search tries; the defaults are the paper's. Filters and units are powers of two from
    2 on."""

    max_conv_layers: int = within(1, 8, default=5)
    """Maximum number of convolution layers [P]."""
    max_filters: int = within(2, 1024, default=512)
    """Maximum number of filters per convolution [P]; 64 is a practical limit on a CPU."""
    max_dense_layers: int = within(1, 5, default=5)
    """Maximum number of dense layers [P]."""
    max_dense_units: int = within(2, 4096, default=512)
    """Maximum number of units per dense layer [P]."""
    blur_px: float = within(0, 4, default=0.0)
    """Blur of every network's input (as --network.blur-px of `tactip train`), px; 0 [P]."""
    downsample: int = within(1, MAX_DOWNSAMPLE, default=1)
    """Downsampling of every network's input (as --network.downsample of `tactip train`); 1 [P]. With 2, at most 4
    convolution layers fit an image of 128 px."""

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
    """Settings of a search. The defaults are the paper's."""

    trials: int = within(1, 100000, default=300)
    """Number of trials, one training each [P]."""
    random_trials: int = within(1, 100000, default=50)
    """Number of random trials before the search follows its results [P]."""
    seed: int = within(0, 2**31, default=0)
    """Seed of the search; every training uses the seed of `training`."""
    prune: bool = False
    """End a trial early if half of the earlier trials were better after the same number of epochs; the paper does not."""
    min_epochs: int = within(1, 1000, default=5)
    """Minimum number of epochs before a trial is pruned."""
    space: SearchSpace = field(default_factory=SearchSpace)
    """Networks that may be tried."""
    training: TrainSettings = field(default_factory=TrainSettings)
    """Settings of each training."""

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
    deviations=True,
    quantities=True,
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
    undeformed_fraction=0.05,
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
