"""Settings of transfer experiments. Light to import, for the command line."""

from dataclasses import dataclass
from typing import Literal, get_args

from tactip_twin.learning.configuration import OpticsName, RecipeName
from tactip_twin.sim.labels import FidelityName
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup

AUTO = "auto"
"""Name for optics chosen by the set, for a fidelity chosen by the task and the tip, for initial weights chosen by
the sensor, and for mechanics chosen by what its frames show."""

NONE = "none"
"""Name for random initial weights."""

GAP = "gap.png"
"""Figure of the sim-to-real gap."""

Mechanics = Literal["auto", "none", "estimated", "real"]
"""Names of the randomizations of mechanics (mechanics_randomization.MECHANICS_RANDOMIZATIONS), or `auto`, a choice by the
set."""

OpticsChoice = Literal["auto", OpticsName]
"""Names of the ranges of optics (optics_ranges.OPTICS), or `auto`, a choice by the set."""

FidelityChoice = Literal["auto", "fast", FidelityName]
"""Names of the fidelities (fidelity.FIDELITIES); `fast`, contacts of standard that a learned tip predicts; or `auto`, fast
where it knows the tip."""

PseudoKind = Literal["nominal-127", "nominal-331"]
"""Names of the presets that a pseudo-real sensor may be similar to."""


@dataclass(frozen=True)
class TransferSettings:
    """Settings of the experiments."""

    design: str = ""
    """Design of the real sensor: a preset or a design file. Default: fitted to the set's neutral image."""
    contacts: int | None = within(10, 10**7, default=None)
    """Number of simulated contacts to train on. Default: 700 on a surface, each of which gives eight samples by symmetry, or
    2000 on an edge."""
    drawn_contacts: int = within(0, 10**6, default=4000)
    """Number of contacts per epoch that the learned tip draws anew beside the simulated ones, where it knows the sensor
    (effect: docs/transfer.md, docs/hidden_sensors.md)."""
    val_contacts: int = within(10, 10**6, default=500)
    """Number of simulated contacts to validate on."""
    real_train_frames: int | None = within(20, 10**6, default=None)
    """Number of real frames to train on, in experiments that use real labels; all others are for testing. Default: 1500,
    or three fifths of a smaller set."""
    shots: tuple[int, ...] = (10, 50, 100, 500)
    """Numbers of real frames to correct by, at least 10."""
    randomize_mechanics: Mechanics = AUTO
    """Randomization of the mechanics (sim/dataset/mechanics_randomization.py). estimated: a little, around materials that
    explain the pins of frames best, whatever their labels; auto: estimated where these explain the pins much better than
    usual ones, else real."""
    optics_ranges: OpticsChoice = AUTO
    """Ranges of the randomized optics (learning/optics_ranges.py). auto: steady if light at the rim shows how the camera
    moved since the neutral image, else real."""
    augmented_fraction: float = within(0, 1, default=0.6)
    """Fraction of the training images that are rendered with randomized optics."""
    fidelity: FidelityChoice = AUTO
    """Fidelity of the contact simulation. fast: predict the contacts of standard by the shipped learned tip of any
    materials, several times as fast; auto: fast for tips that it knows, standard for others."""
    recipe: RecipeName = "laptop"
    """Network and training: laptop or paper (learning/configuration.py)."""
    steps: int | None = within(1, 10**8, default=None)
    """Number of training steps, rounded up to whole epochs. Default: 1500 from initial weights, 3000 from random ones
    (effect: docs/transfer.md); of the recipe paper, its own."""
    init_from: str = AUTO
    """Initial weights of the training on simulated contacts: a shipped network, the folder of a training, or none for random
    weights. auto: the shipped network for as many pins, which on edges knows any materials; none on surfaces of 331 pins."""
    gap_frames: int = within(8, 10**5, default=150)
    """Number of real frames to compare with simulated ones."""
    seed: int = within(0, 2**31, default=0)
    """Seed of sets, trainings and the split of the real frames."""

    def __post_init__(self) -> None:
        check(self)
        lookup("randomize_mechanics", self.randomize_mechanics, dict.fromkeys(get_args(Mechanics)))
        lookup("optics_ranges", self.optics_ranges, dict.fromkeys(get_args(OpticsChoice)))
        lookup("fidelity", self.fidelity, dict.fromkeys(get_args(FidelityChoice)))
        lookup("recipe", self.recipe, dict.fromkeys(get_args(RecipeName)))
