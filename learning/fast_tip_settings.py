"""Settings of the training of a learned tip. Light to import, for the command line."""

from dataclasses import dataclass

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class FastTipSettings:
    """Settings of the training of a learned tip."""

    contacts: int = within(0, 10**8, default=0)
    """Number of contacts to learn from, the first of the sets; 0: all."""
    modes: int = within(1, 500, default=100)
    """Number of modes of the skin's deformation; 100 alone leave 0.013 mm on edges [M]."""
    width: int = within(8, 2048, default=256)
    """Units per layer [?]."""
    layers: int = within(1, 10, default=3)
    """Number of residual layers [?]."""
    members: int = within(2, 10, default=2)
    """Number of networks in the ensemble, whose spread decides whether a prediction is trusted [?]."""
    steps: int = within(1, 1000000, default=12000)
    """Number of training steps of each network [?]."""
    batch: int = within(1, 65536, default=512)
    """Contacts per step, each turned and mirrored at random."""
    learning_rate: float = within(1e-6, 1, default=3e-3)
    """Highest learning rate of a one-cycle schedule."""
    weight_decay: float = within(0, 1, default=1e-4)
    """Weight decay of AdamW."""
    trusted_fraction: float = within(0, 1, default=0.98)
    """Fraction of the validation contacts whose spread is below the limit of trust [?]."""
    seed: int = within(0, 2**31, default=0)
    """Seed of the initial weights and batches."""

    def __post_init__(self) -> None:
        check(self)
