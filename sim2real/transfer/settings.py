"""Settings of transfer experiments. Light to import, for the command line."""

from dataclasses import dataclass
from typing import Literal, get_args

from tactip_twin.learning.configuration import OpticsName, RecipeName
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup

AUTO = "auto"
"""Name of the optics that are chosen by the set."""

GAP = "gap.png"
"""Figure of the sim-to-real gap."""

Mechanics = Literal["none", "real"]
"""Names of the randomizations of mechanics (mechanics_randomization.MECHANICS_RANDOMIZATIONS)."""

OpticsChoice = Literal["auto", OpticsName]
"""Names of the ranges of optics (optics_ranges.OPTICS), or the choice by the set."""

FidelityName = Literal["draft", "standard", "reference"]
"""Names of the fidelities (fidelity.FIDELITIES)."""

PseudoKind = Literal["nominal-127", "nominal-331"]
"""Names of the presets that a pseudo-real sensor may be near."""


@dataclass(frozen=True)
class TransferSettings:
    """How the experiments are made."""

    design: str = ""
    """Design of the real sensor: a preset or a design file; fitted to the set's neutral image if empty."""
    contacts: int = within(10, 10**7, default=2000)
    """Simulated contacts to learn from; each is a sample for every symmetry of its task."""
    val_contacts: int = within(10, 10**6, default=500)
    """Simulated contacts by which a training is stopped."""
    real_train_frames: int | None = within(20, 10**6, default=None)
    """Real frames that may be learned from, where an experiment has labels; all others are what is tested on. 1500, or three
    fifths of a smaller set, if not given."""
    shots: tuple[int, ...] = (10, 50, 100, 500)
    """Real frames that a network is fine-tuned with."""
    randomize_mechanics: Mechanics = "real"
    """none or real: sim/dataset/mechanics_randomization.py."""
    optics_ranges: OpticsChoice = AUTO
    """auto, or one of varied.py: lens, real, rim, steady; auto is steady where light at the rim has told how the camera
    changed since the neutral image, and real elsewhere."""
    augmented_fraction: float = within(0, 1, default=0.6)
    """Share of the images that are drawn under varied optics."""
    fidelity: FidelityName = "standard"
    """draft, standard or reference."""
    recipe: RecipeName = "laptop"
    """Network and training: networks.py."""
    min_steps: int | None = None
    """Steps of a training, at least; as many as the recipe has if none are given."""
    init_from: str = ""
    """A shipped network, or the folder of a training, that training on simulated contacts begins with; none if empty."""
    gap_frames: int = within(8, 10**5, default=150)
    """Real frames that are held against simulated ones, to see the gap."""
    fine_tuning_steps: int = within(1, 10**6, default=800)
    """Steps of a fine-tuning."""
    seed: int = within(0, 2**31, default=0)
    """Seed of sets, trainings and the split of the real frames."""

    def __post_init__(self) -> None:
        check(self)
        lookup("randomize_mechanics", self.randomize_mechanics, dict.fromkeys(get_args(Mechanics)))
        lookup("optics_ranges", self.optics_ranges, dict.fromkeys(get_args(OpticsChoice)))
        lookup("fidelity", self.fidelity, dict.fromkeys(get_args(FidelityName)))
        lookup("recipe", self.recipe, dict.fromkeys(get_args(RecipeName)))
