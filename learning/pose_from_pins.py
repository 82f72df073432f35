"""Pose and shear from the positions of pins, by maximum likelihood through the learned tip.

No network is trained: the learned tip (sim/fast_tip/) predicts the pins of a pose and a shear, and Levenberg-Marquardt steps
look for those whose pins are nearest to the given ones. It is a yardstick for networks: what remains is what pins cannot
tell, or what the learned tip has wrong.
"""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.sim.pose import from_mm_deg

_STEP_MM_DEG = np.array([0.05] * 3 + [0.25] * 3)
"""Differences for the derivatives of the pins, mm and degrees: larger than what the tip's networks do not resolve [?]."""

_PRIOR_WEIGHT = 0.3
"""Weight of the prior: a normal distribution with the middle and the variance of the ranges would have 1 [?]."""

_DAMPING = 0.3
"""Initial damping of a step, as a fraction of the diagonal [?]."""


@dataclass(frozen=True)
class MostLikely:
    """Most likely poses and shears of n contacts."""

    poses: np.ndarray
    """(n, 6) mm and degrees."""
    shears: np.ndarray
    """(n, 6) mm and degrees."""
    deviations: np.ndarray
    """(n, 12) standard deviations of poses and shears, mm and degrees; 0 where the ranges fix a component."""
    residuals_mm: np.ndarray
    """(n,) root mean square distance of the pins from the predicted ones, in plan view."""


class PinModel:
    """Pins in plan view as a function of pose and shear within ranges."""

    def __init__(self, tip: FastTip, decoder: PinDecoder, pose: Ranges, shear: Ranges) -> None:
        """Take the learned tip, the pins of a design, and the ranges in which poses and shears lie."""
        self._tip, self._decoder = tip, decoder
        bounds = np.concatenate([pose.bounds(), shear.bounds()])
        self.free = np.ptp(bounds, axis=1) > 0
        """(12,) bool: components that are not fixed."""
        self.low, self.high = bounds[self.free].T
        self._fixed = bounds[:, 0]
        self._steps = np.tile(_STEP_MM_DEG, 2)[self.free]

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Return all components (n, 12) of free ones (n, k), mm and degrees."""
        out = np.tile(self._fixed, (len(values), 1))
        out[:, self.free] = values
        return out

    def pins_mm(self, values: np.ndarray) -> np.ndarray:
        """Return the pins in plan view (n, 2 p), mm, for free components (n, k), mm and degrees."""
        both = from_mm_deg(self.whole(values).reshape(-1, 2, 6))
        tips = self._tip.predict(self._decoder, both[:, 0], both[:, 1]).pin_tips
        return 1e3 * tips[..., :2].reshape(len(values), -1)

    def jacobians(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, 2 p, k) of the pins, mm per mm and mm per degree, by central differences."""
        ends = [[self.pins_mm(values + sign * step) for sign in (1, -1)] for step in np.diag(self._steps)]
        return np.stack([(a - b) / (2 * s) for (a, b), s in zip(ends, self._steps, strict=True)], -1)

    def information(self, jacobians: np.ndarray, noise_mm: float, prior_weight: float = 1.0) -> np.ndarray:
        """Return the information matrices (n, k, k) of pins with noise (standard deviation of each coordinate) and a prior.

        The prior has the variance of uniform distributions over the ranges. Their inverse is the Cramér-Rao bound.
        """
        prior = np.diag(12 * prior_weight / (self.high - self.low) ** 2)
        return jacobians.transpose(0, 2, 1) @ jacobians / noise_mm**2 + prior


def most_likely(model: PinModel, pins_mm: np.ndarray, start: np.ndarray, noise_mm: float, steps: int = 12) -> MostLikely:
    """Return the most likely poses and shears for pins.

    Args:
        model: Model of the pins.
        pins_mm: (n, p, 2) pin tips in plan view, sensor frame, mm.
        start: (n, 12) poses and shears from which to start, mm and degrees.
        noise_mm: Standard deviation of each coordinate of a pin, mm, with what the learned tip has wrong.
        steps: Number of steps.
    """
    wanted = pins_mm.reshape(len(pins_mm), -1)
    values = np.clip(start[:, model.free], model.low, model.high)
    middle, prior = 0.5 * (model.low + model.high), 12 * _PRIOR_WEIGHT / (model.high - model.low) ** 2

    def cost(of: np.ndarray, pins: np.ndarray) -> np.ndarray:
        """Return minus twice the logarithm of the posterior, (n,), without its constant."""
        return ((pins - wanted) ** 2).sum(1) / noise_mm**2 + (prior * (of - middle) ** 2).sum(1)

    pins = model.pins_mm(values)
    costs, damping = cost(values, pins), np.full(len(values), _DAMPING)
    for _ in range(steps):
        J = model.jacobians(values)
        A = model.information(J, noise_mm, _PRIOR_WEIGHT)
        gradient = np.einsum("nij,ni->nj", J, wanted - pins) / noise_mm**2 - prior * (values - middle)
        damped = A + damping[:, None, None] * np.einsum("njj,jk->njk", A, np.eye(A.shape[1]))
        moved = np.clip(values + np.linalg.solve(damped, gradient[..., None])[..., 0], model.low, model.high)
        their_pins = model.pins_mm(moved)
        their_costs = cost(moved, their_pins)
        better = their_costs < costs
        values, pins = np.where(better[:, None], moved, values), np.where(better[:, None], their_pins, pins)
        costs, damping = np.where(better, their_costs, costs), np.where(better, 0.2 * damping, 5 * damping)
    information = model.information(model.jacobians(values), noise_mm, _PRIOR_WEIGHT)
    deviations = np.zeros((len(values), 12))
    deviations[:, model.free] = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
    whole = model.whole(values)
    residuals = np.sqrt(2 * ((pins - wanted) ** 2).mean(1))
    return MostLikely(whole[:, :6], whole[:, 6:], deviations, residuals)
