"""Pose and shear from the positions of pins, by maximum likelihood through the learned tip.

No network is trained: the learned tip (sim/fast_tip/) predicts the pins of a pose and a shear, and Levenberg-Marquardt steps
look for those whose pins are nearest to the given ones. It is a yardstick for networks (what remains is what pins cannot
tell, or what the learned tip has wrong), and it reads frames of a sensor for which there is no network yet.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.neutral_image import reference_pixels
from tactip_twin.tactip_model.optics import Lens

_STEP_MM_DEG = np.array([0.05] * 3 + [0.25] * 3)
"""Differences for the derivatives of the pins, mm and degrees: larger than what the tip's networks do not resolve [?]."""

_PRIOR_WEIGHT = 0.3
"""Weight of the prior: a normal distribution with the middle and the variance of the ranges would have 1 [?]."""

DAMPING = 0.3
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
    residuals: np.ndarray
    """(n,) root mean square distance of the pins from the predicted ones, in the unit of the model's positions."""


class PinModel:
    """Positions of pins as a function of pose and shear within ranges: in plan view, mm, or in the image, px of 256."""

    def __init__(
        self,
        tip: FastTip,
        decoder: PinDecoder,
        pose: Ranges,
        shear: Ranges,
        lens: Lens | None = None,
        materials: np.ndarray | None = None,
    ) -> None:
        """Prepare a model.

        Args:
            tip: The learned tip.
            decoder: Pins of the design.
            pose: Ranges in which poses lie.
            shear: Ranges in which shears lie.
            lens: Lens of the design for positions in the image; None for plan view.
            materials: Inputs of a tip that knows any materials (FastTip.coefficients).
        """
        self._tip, self._decoder, self._lens, self.materials = tip, decoder, lens, materials
        bounds = np.concatenate([pose.bounds(), shear.bounds()])
        self.free = np.ptp(bounds, axis=1) > 0
        """(12,) bool: components that are not fixed."""
        self.low, self.high = bounds[self.free].T
        self._fixed = bounds[:, 0]
        self._steps = np.tile(_STEP_MM_DEG, 2)[self.free]

    @property
    def material_ranges(self) -> np.ndarray:
        """Ranges (6, 2) of the materials that the tip knows. Raises ValueError if it knows those of one design only."""
        if self._tip.materials is None:
            raise ValueError("the learned tip knows the materials of one design only")
        return self._tip.materials

    def with_materials(self, materials: np.ndarray) -> "PinModel":
        """Return the model of a tip with other materials, inputs (6,) of FastTip.coefficients."""
        other = copy.copy(self)
        other.materials = materials
        return other

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Return all components (n, 12) of free ones (n, k), mm and degrees."""
        out = np.tile(self._fixed, (len(values), 1))
        out[:, self.free] = values
        return out

    def positions(self, values: np.ndarray) -> np.ndarray:
        """Return the pins' positions (n, 2 p), mm or px, for free components (n, k), mm and degrees."""
        both = from_mm_deg(self.whole(values).reshape(-1, 2, 6))
        coefficients, _ = self._tip.coefficients(both[:, 0], both[:, 1], self.materials)
        tips = self._decoder.tips(coefficients)
        if self._lens is None:
            return 1e3 * tips[..., :2].reshape(len(values), -1)
        return reference_pixels(self._lens.project(tips), self._lens.width).reshape(len(values), -1)

    def jacobians(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, 2 p, k) of the positions, per mm and per degree, by central differences."""
        ends = [[self.positions(values + sign * step) for sign in (1, -1)] for step in np.diag(self._steps)]
        return np.stack([(a - b) / (2 * s) for (a, b), s in zip(ends, self._steps, strict=True)], -1)

    def nearest_of(
        self,
        pins: np.ndarray,
        count: int,
        rng: np.random.Generator,
        within: Mapping[int, tuple[float, float]] | None = None,
    ) -> np.ndarray:
        """Return for each of n frames the nearest of random contacts in the ranges, (n, 12), mm and degrees.

        Args:
            pins: (n, p, 2) positions, mm or px; NaN where a pin is not detected.
            count: Number of random contacts.
            rng: Generator of the contacts.
            within: Narrower ranges of some of the twelve components, mm and degrees.
        """
        low, high = (self.whole(end[None])[0] for end in (self.low, self.high))
        for component, ends in (within or {}).items():
            low[component], high[component] = ends
        values = (low + (high - low) * rng.random((count, 12)))[:, self.free]
        bank, wanted = self.positions(values), pins.reshape(len(pins), -1)
        known = np.isfinite(wanted)
        # Sums of squared differences of the known coordinates, without the term that all contacts share.
        far = bank**2 @ known.T - 2 * bank @ np.where(known, wanted, 0.0).T
        return self.whole(values[far.argmin(0)])

    def information(self, jacobians: np.ndarray, noise: float, prior_weight: float = 1.0) -> np.ndarray:
        """Return the information matrices (n, k, k) of pins with noise (standard deviation of each coordinate) and a prior.

        The prior has the variance of uniform distributions over the ranges. Their inverse is the Cramér-Rao bound.
        """
        prior = np.diag(12 * prior_weight / (self.high - self.low) ** 2)
        return jacobians.transpose(0, 2, 1) @ jacobians / noise**2 + prior


class Misfit:
    """How far the pins of contacts are from given ones, and how unlikely that is."""

    def __init__(self, model: PinModel, pins: np.ndarray, noise: float, outlier: float = np.inf) -> None:
        """Take what is given.

        Args:
            model: Model of the pins, whose ranges are the prior of poses and shears.
            pins: (n, p, 2) positions of pin tips, mm or px as the model's; NaN where one is not detected.
            noise: Standard deviation of each coordinate of a pin, in the same unit, with what the learned tip has wrong.
            outlier: Distance, in the same unit, beyond which a pin hardly counts (Cauchy's cost): as one that is confused
                with its neighbour.
        """
        self._shape, self._noise, self._outlier = pins.shape, noise, outlier
        self._wanted = pins.reshape(len(pins), -1)
        self.known = np.isfinite(self._wanted)
        """(n, 2 p) bool: coordinates of pins that are detected."""
        self.middle, self.prior = 0.5 * (model.low + model.high), 12 * _PRIOR_WEIGHT / (model.high - model.low) ** 2
        """Mean and inverse variance (k,) of the prior of the free components."""

    def away(self, there: np.ndarray) -> np.ndarray:
        """Return how far the given pins are from some (n, 2 p); 0 where one is not detected."""
        return np.where(self.known, self._wanted - there, 0.0)

    def _squares(self, there: np.ndarray) -> np.ndarray:
        """Return the squared distance of each pin (n, p)."""
        return (self.away(there) ** 2).reshape(self._shape).sum(-1)

    def weights(self, there: np.ndarray) -> np.ndarray:
        """Return the square root of the weight of each coordinate (n, 2 p); 0 where a pin is not detected."""
        return self.known * np.repeat(1 / np.sqrt(1 + self._squares(there) / self._outlier**2), 2, axis=1)

    def cost(self, values: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Return minus twice the logarithm of the posterior (n,), without its constant, of free components (n, k) whose pins
        are (n, 2 p)."""
        far = self._squares(there)
        if np.isfinite(self._outlier):
            far = self._outlier**2 * np.log1p(far / self._outlier**2)
        return far.sum(1) / self._noise**2 + (self.prior * (values - self.middle) ** 2).sum(1)


def most_likely(
    model: PinModel, pins: np.ndarray, start: np.ndarray, noise: float, steps: int = 12, outlier: float = np.inf
) -> MostLikely:
    """Return the most likely poses and shears for pins.

    Args:
        model: Model of the pins.
        pins: As of Misfit.
        start: (n, 12) poses and shears from which to start, mm and degrees.
        noise: As of Misfit.
        steps: Number of steps.
        outlier: As of Misfit.
    """
    misfit = Misfit(model, pins, noise, outlier)
    values = np.clip(start[:, model.free], model.low, model.high)

    def slopes(of: np.ndarray, there: np.ndarray) -> np.ndarray:
        return misfit.weights(there)[..., None] * model.jacobians(of)

    here = model.positions(values)
    costs, damping = misfit.cost(values, here), np.full(len(values), DAMPING)
    for _ in range(steps):
        J = slopes(values, here)
        A = model.information(J, noise, _PRIOR_WEIGHT)
        pull = np.einsum("nij,ni->nj", J, misfit.weights(here) * misfit.away(here)) / noise**2
        gradient = pull - misfit.prior * (values - misfit.middle)
        damped = A + damping[:, None, None] * np.einsum("njj,jk->njk", A, np.eye(A.shape[1]))
        moved = np.clip(values + np.linalg.solve(damped, gradient[..., None])[..., 0], model.low, model.high)
        there = model.positions(moved)
        their_costs = misfit.cost(moved, there)
        better = their_costs < costs
        values, here = np.where(better[:, None], moved, values), np.where(better[:, None], there, here)
        costs, damping = np.where(better, their_costs, costs), np.where(better, 0.2 * damping, 5 * damping)
    information = model.information(slopes(values, here), noise, _PRIOR_WEIGHT)
    deviations = np.zeros((len(values), 12))
    deviations[:, model.free] = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
    whole = model.whole(values)
    residuals = np.sqrt(2 * (misfit.away(here) ** 2).sum(1) / misfit.known.sum(1))
    return MostLikely(whole[:, :6], whole[:, 6:], deviations, residuals)
