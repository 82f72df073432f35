"""A contact sampled from the ranges of a data set, and the simulator of such contacts."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.contact.curved_surface import MAX_CURVATURE_PER_M, curved_surface, sample_curvatures
from tactip_twin.sim.contact.limits import MAX_TILT_RAD, exceeds_max_tilt
from tactip_twin.sim.contact.retries import RetryingSimulator
from tactip_twin.sim.contact.rough_surface import sample_rough_surface
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.pressed_object import PressPlaces
from tactip_twin.sim.dataset.sampling import generator
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class ContactSample:
    """A contact sampled from the ranges of a set."""

    pose: np.ndarray
    """(6,) m and rad."""
    shear: np.ndarray
    """(6,) m and rad."""
    solid: SignedDistanceMesh | None
    """Curved surface or object of this contact; None where the set's surface or edge is straight."""
    design: Design
    """Tip with the mechanics of this contact."""
    rng: np.random.Generator
    """Generator of the rest of the contact."""


_MAX_MOTIONS = 1000
"""Number of motions sampled before ranges are rejected: at the corners of ±25 degrees every other one is too steep."""


def sample_motion(configuration: Configuration, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose and a shear (6,), m and rad: the first sample that is not too steep to simulate.

    Raises TactipError where there is none among _MAX_MOTIONS.
    """
    for _ in range(_MAX_MOTIONS):
        pose, shear = configuration.pose.sample(rng), configuration.shear.sample(rng)
        if not exceeds_max_tilt(pose, shear):
            return pose, shear
    raise TactipError(
        f"all of {_MAX_MOTIONS} poses and shears sampled from the ranges tilt by more than {np.degrees(MAX_TILT_RAD):g} "
        "degrees: narrow the ranges of roll and pitch"
    )


def sample_contact(configuration: Configuration, number: int, places: PressPlaces | None = None) -> ContactSample:
    """Return the sample of contact `number`. Poses and shears do not depend on what else varies.

    Args:
        configuration: Configuration of the set.
        number: Number of the contact.
        places: Places on the object, if the set has one.
    """
    c = configuration
    rng = generator(c.seed, c.task, c.split, number)
    pose, shear = sample_motion(c, rng)
    solid = _sample_surface(c, rng) if places is None else places.sample(rng)
    design = c.design if c.mechanics_randomization.is_identity else c.mechanics_randomization.sample(c.design, rng)
    return ContactSample(pose, shear, solid, design, rng)


def _sample_surface(configuration: Configuration, rng: np.random.Generator) -> SignedDistanceMesh | None:
    """Return the surface of a contact; None where it is flat."""
    c = configuration
    # Without rough surfaces no number is sampled for them, so sets made before that option keep their bytes.
    if c.rough_fraction and rng.uniform() < c.rough_fraction:
        return sample_rough_surface(rng, *c.curvature_per_m)
    if not c.is_curved:
        return None
    return sample_curvatures(rng, *c.curvature_per_m, c.varying_curvature_fraction).solid()


def simulator_for(configuration: Configuration, design: Design) -> RetryingSimulator:
    """Return a simulator of the contacts of a set.

    Args:
        configuration: Configuration of the set. If its surface is curved or an object, the solid of each contact must be
            assigned to the simulator's stimulus.
        design: The set's design, or one with other mechanics.
    """
    c = configuration
    if c.object is not None or c.rough_fraction:
        stimulus = SolidStimulus(curved_surface(0.0, 0.0, 0.0))
    else:
        stimulus = curved_stimulus() if c.is_curved else c.task
    return RetryingSimulator(design, stimulus, c.fidelity, c.bounds)


def curved_stimulus() -> SolidStimulus:
    """Return the stimulus of contacts on curved surfaces, whose solid is to be replaced by that of each contact."""
    return SolidStimulus(curved_surface(0.0, 0.0, 0.0), min_radius_m=1 / MAX_CURVATURE_PER_M)
