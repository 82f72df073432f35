"""Settings of the training of a sliding tip. Light to import, for the command line."""

from dataclasses import dataclass

from tactip_twin.tactip_model.bounds import check, require, within


@dataclass(frozen=True)
class SlidingTipSettings:
    """Settings of the training of a sliding tip."""

    modes: int = within(1, 500, default=100)
    """Number of modes of the skin's deformation that are predicted."""
    state_modes: int = within(1, 500, default=60)
    """Number of modes of the state before, the largest, that the networks see [?]."""
    overlap_modes: int = within(1, 200, default=24)
    """Number of modes of the overlap of tip and object; 24 leave 0.02 mm of it [M]."""
    width: int = within(8, 2048, default=256)
    """Units per layer [?]."""
    layers: int = within(1, 10, default=3)
    """Number of residual layers [?]."""
    members: int = within(2, 10, default=2)
    """Number of networks in the ensemble, whose spread decides whether a prediction is trusted [?]."""
    steps: int = within(1, 1000000, default=20000)
    """Number of training steps of each network [?]."""
    batch: int = within(1, 65536, default=256)
    """Slides per training step, each turned and mirrored at random."""
    rollout: int = within(1, 20, default=3)
    """Number of steps in a row that are predicted in the last part of the training, each from the one before."""
    rollout_fraction: float = within(0, 1, default=0.25)
    """Fraction of the training steps, the last ones, that predict so; the others predict single steps [?]."""
    noise: float = within(0, 1, default=0.02)
    """Standard deviation of the noise on the state before, relative to each coefficient: errors that a sequence of
    predictions makes [?]."""
    learning_rate: float = within(1e-6, 1, default=2e-3)
    """Highest learning rate of a one-cycle schedule."""
    weight_decay: float = within(0, 1, default=1e-4)
    """Weight decay of AdamW."""
    trusted_fraction: float = within(0, 1, default=0.98)
    """Fraction of the steps of the validation set whose spread is below the limit of trust [?]."""
    seed: int = within(0, 2**31, default=0)
    """Seed of the initial weights and batches."""

    def __post_init__(self) -> None:
        check(self)
        require(self.state_modes <= self.modes, "state_modes", self.state_modes, f"at most modes, {self.modes}")
