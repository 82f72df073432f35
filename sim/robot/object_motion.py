"""Motion of an object, as options: importing this module loads no physics."""

from dataclasses import dataclass

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class ObjectMotion:
    """Motion of the object: sinusoids in all six axes at once."""

    amplitude_mm: float = within(0, 200, default=75.0)
    """Largest displacement along each axis of the base frame, mm [R]."""
    amplitude_deg: float = within(0, 45, default=25.0)
    """Largest component of the rotation vector about each axis, degrees [R]."""
    period_s: float = within(1, 1000, default=30.0)
    """Period, s [R]."""
    ramp_s: float = within(0.01, 100, default=5.0)
    """Time over which the amplitudes grow from zero, s."""

    def __post_init__(self) -> None:
        check(self)
