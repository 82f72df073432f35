"""Settings of the filter of poses over steps. Nothing heavy is imported here."""

from dataclasses import dataclass

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class FilterSettings:
    """Settings of the filter of poses over steps (learning/pose_filter.py), for networks that estimate deviations."""

    enabled: bool = True
    """Fuse the estimates of successive steps."""
    bend_deg_per_mm: float | None = within(0, 20, default=None)
    """Standard deviation of the object's bends, degrees per mm. Default: 4 on surfaces, 1 along edges."""
    bend_length_mm: float | None = within(0.1, 1e4, default=None)
    """Distance over which the object's bends change, mm. Default: 5 on surfaces, 40 along edges."""
    rest_mm: float = within(0, 5, default=0.03)
    """Standard deviation that every step adds to each position, mm [?]."""
    rest_deg: float = within(0, 45, default=0.1)
    """Standard deviation that every step adds to each angle, degrees [?]."""
    motion_fraction: float = within(0, 1, default=0.3)
    """Standard deviation of the change of a position by a motion of the sensor, as a fraction of that motion, -: the tip may
    touch a steep flank with its side, whose depth changes less than the sensor's height [?]."""
    correlated_estimates: float = within(1, 1000, default=2.0)
    """Number of successive estimates that count as one, because their errors are alike [?]."""
    gate_probability: float = within(0.5, 0.999999, default=0.999)
    """Probability with which a correct estimate passes the gate."""
    max_rejected: int = within(0, 1000, default=3)
    """Maximum number of estimates in a row that the gate rejects; the next one restarts the filter."""

    def __post_init__(self) -> None:
        check(self)
