"""Pitch and materials of a tip from the pins of contacts whose poses nobody knows, by maximum likelihood through a learned
tip.

Each contact has a pose and a shear of its own; the tip is the same in all. Gauss-Newton steps eliminate each contact's own
components first, as bundle adjustment does (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6). A
neutral image cannot tell the pitch of the pins from the lens, but pressed pins can: those that are closer together lie
farther from the clamped rim of the skin, so the outer ones move more. For each pitch, the lens shows the pins where the
neutral image has them.

The camera's height and the pins' length are not estimated, although both can be on simulated sensors: the height within 0.8
mm on surfaces. But the depth was not read better by it on average (0.06, 0.14, 0.07 and 0.08 mm off on surface-a, -b, -c
and -e of docs/hidden_sensors.md became 0.09, 0.09, 0.07 and 0.11 mm), and on the published 331-pin set, height and length
took up what else the twin has wrong (0.125 mm became 0.168 mm). Nor is the gel's compressibility estimated, which pins
hardly tell from the depth.
"""

from functools import lru_cache

import numpy as np

from tactip_twin.learning.pose_from_pins import DAMPING, Misfit, PinModel
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.sim.fast_tip.materials import INPUTS, material_inputs
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.neutral_image import widest_spacing, with_spacing
from tactip_twin.tactip_model.optics import Lens

_MATERIAL_STEP, _PITCH_STEP = 0.02, 0.01
"""Differences for the derivatives of the pins, as a fraction of the materials' ranges, and of the pitch [?]."""

_PITCH_RANGE, _PITCH_DEVIATION = 0.25, 0.1
"""Largest change of the design's pitch, and standard deviation of its prior, in logarithms [?]."""


class TipModels:
    """Models of the pins, px of 256, of tips that differ from a design by their pitch and materials.

    A tip is an array (7,): inputs of FastTip.coefficients, then the logarithm of the pitch over the design's.
    """

    def __init__(self, tip: FastTip, design: Design, pose: Ranges, shear: Ranges) -> None:
        """Prepare the models.

        Args:
            tip: Learned tip of any materials.
            design: The design.
            pose: Ranges in which poses lie.
            shear: Ranges in which shears lie.

        Raises:
            ValueError: The learned tip knows the materials of one design only.
        """
        if tip.materials is None:
            raise ValueError("the learned tip knows the materials of one design only")
        self._tip, self._design, self._ranges = tip, design, (pose, shear)
        low, high = tip.materials.T.copy()
        # The gel's compressibility remains the design's.
        gel = INPUTS.index("log_compressibility")
        low[gel] = high[gel] = np.clip(material_inputs(design.materials)[gel], low[gel], high[gel])
        varies = np.append(high > low, True)
        widths = np.where(varies[:-1], high - low, 1.0)
        widest = float(np.log(widest_spacing(design))) - 1.01 * _PITCH_STEP
        self.low = np.array([*low, -_PITCH_RANGE])
        """(7,) lowest values."""
        self.high = np.array([*high, min(_PITCH_RANGE, widest)])
        """(7,) highest values."""
        self.steps = np.where(varies, [*(_MATERIAL_STEP * widths), _PITCH_STEP], 0.0)
        """(7,) differences for derivatives; 0 for what is fixed."""
        self.middle = np.array([*(low + high) / 2, min(0.0, widest)])
        """(7,) mean of the prior."""
        # A uniform distribution over a range has a twelfth of its square as variance.
        self.prior = np.array([*12 / widths**2, _PITCH_DEVIATION**-2])
        """(7,) inverse variance of the prior."""
        # Steps of the materials ask for one pitch again and again.
        self._with_pitch = lru_cache(8)(self._model_of)

    def design(self, tip: np.ndarray) -> Design:
        """Return the design with the pitch of a tip (7,), and its own materials."""
        return self._of_pitch(float(tip[-1]))

    def materials(self, tip: np.ndarray) -> np.ndarray:
        """Return the materials (6,) of a tip (7,), inputs of FastTip.coefficients."""
        return tip[:-1]

    def with_materials(self, tip: np.ndarray, materials: np.ndarray) -> np.ndarray:
        """Return a tip (7,) with other materials (6,), or the nearest that the learned tip knows."""
        return np.append(np.clip(materials, self.low[:-1], self.high[:-1]), tip[-1])

    def of(self, tip: np.ndarray) -> PinModel:
        """Return the model of a tip (7,)."""
        return self._with_pitch(float(tip[-1])).with_materials(self.materials(tip))

    def _of_pitch(self, log_pitch: float) -> Design:
        return with_spacing(self._design, float(np.exp(log_pitch))) if log_pitch else self._design

    def _model_of(self, log_pitch: float) -> PinModel:
        design = self._of_pitch(log_pitch)
        return PinModel(self._tip, PinDecoder(design, self._tip.modes), *self._ranges, Lens(design))

    def derivatives(self, values: np.ndarray, tip: np.ndarray) -> np.ndarray:
        """Return the derivatives (n, 2 p, 7) of the pins' positions by a tip (7,), by central differences, at free
        components (n, k) of the contacts."""
        out = np.zeros((len(values), self.of(tip).positions(values[:1]).size, len(tip)))
        for k in np.flatnonzero(self.steps):
            one = self.steps[k] * np.eye(len(tip))[k]
            ends = [self.of(tip + sign * one).positions(values) for sign in (1, -1)]
            out[..., k] = (ends[0] - ends[1]) / (2 * self.steps[k])
        return out


def most_likely_tip(
    models: TipModels,
    pins: np.ndarray,
    contacts: np.ndarray,
    tip: np.ndarray,
    noise: float,
    steps: int = 15,
    outlier: float = np.inf,
) -> np.ndarray:
    """Return the most likely tip (7,), whatever its contacts, for given pins.

    Args:
        models: Models of the pins.
        pins: As of Misfit.
        contacts: (n, 12) poses and shears from which to start, mm and degrees.
        tip: (7,) tip from which to start.
        noise: As of Misfit.
        steps: Number of steps.
        outlier: As of Misfit.
    """
    model = models.of(tip)
    misfit = Misfit(model, pins, noise, outlier)
    values = np.clip(contacts[:, model.free], model.low, model.high)

    def cost(of: np.ndarray, there: np.ndarray, tip: np.ndarray) -> float:
        return float(misfit.cost(of, there).sum() + (models.prior * (tip - models.middle) ** 2).sum())

    here = model.positions(values)
    now, damping = cost(values, here, tip), DAMPING
    for _ in range(steps):
        weights = misfit.weights(here)
        J = weights[..., None] * models.of(tip).jacobians(values) / noise
        M = weights[..., None] * models.derivatives(values, tip) / noise
        away = weights * misfit.away(here) / noise
        own = np.einsum("nij,ni->nj", J, away) - misfit.prior * (values - misfit.middle)
        # What is at the end of its range, and would leave it, stays there.
        held = ((values <= model.low) & (own < 0)) | ((values >= model.high) & (own > 0))
        J, own = np.where(held[:, None], 0.0, J), np.where(held, 0.0, own)
        A = np.einsum("nij,nik->njk", J, J) + np.diag(misfit.prior)
        A += damping * np.einsum("njj,jk->njk", A, np.eye(A.shape[1]))
        B = np.einsum("nij,nik->njk", J, M)
        C = np.einsum("nij,nik->jk", M, M) + np.diag(models.prior)
        C += damping * np.diag(np.diag(C))
        common = np.einsum("nij,ni->j", M, away) - models.prior * (tip - models.middle)
        solved = np.linalg.solve(A, np.concatenate([B, own[..., None]], 2))
        to_tip, alone = solved[..., :-1], solved[..., -1]
        reduced = C - np.einsum("nji,njk->ik", B, to_tip)
        step = np.linalg.solve(reduced, common - np.einsum("nji,nj->i", B, alone))
        their_tip = np.clip(tip + step, models.low, models.high)
        moved = np.clip(values + alone - to_tip @ (their_tip - tip), model.low, model.high)
        # A contact whose step is too long for its slopes stays, so that it does not hold the others back.
        their = models.of(their_tip)
        ways = [(way, their.positions(way)) for way in (moved, values)]
        better = np.subtract(*(misfit.cost(*way) for way in ways)) < 0
        moved, pins_there = (np.where(better[:, None], one, other) for one, other in zip(*ways, strict=True))
        then = cost(moved, pins_there, their_tip)
        if then < now:
            values, tip, here, now, damping = moved, their_tip, pins_there, then, 0.3 * damping
        else:
            damping *= 5
    return tip
