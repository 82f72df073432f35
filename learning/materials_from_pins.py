"""Materials of a tip from the pins of contacts whose poses nobody knows, by maximum likelihood through a learned tip.

Each contact has a pose and a shear of its own; the materials are the same in all. Gauss-Newton steps eliminate each
contact's own components first, as bundle adjustment does (Triggs et al., "Bundle adjustment: a modern synthesis",
2000, section 6).
"""

import numpy as np

from tactip_twin.learning.pose_from_pins import DAMPING, Misfit, PinModel

_STEP = 0.02
"""Differences for the derivatives of the pins, as a fraction of the materials' ranges [?]."""


def most_likely_materials(
    model: PinModel, pins: np.ndarray, start: np.ndarray, noise: float, steps: int = 15, outlier: float = np.inf
) -> np.ndarray:
    """Return the most likely materials (5,), inputs of FastTip.coefficients, of the tip whose pins are given.

    Args:
        model: Model of the pins, with materials to start from.
        pins: As of Misfit.
        start: (n, 12) poses and shears from which to start, mm and degrees.
        noise: As of Misfit.
        steps: Number of steps.
        outlier: As of Misfit.

    Raises:
        ValueError: The learned tip knows the materials of one design only.
    """
    low, high = model.material_ranges.T
    misfit = Misfit(model, pins, noise, outlier)
    values = np.clip(start[:, model.free], model.low, model.high)
    materials = np.clip(0.5 * (low + high) if model.materials is None else model.materials, low, high)
    # A uniform distribution over a range has a twelfth of its square as variance.
    middle, prior = 0.5 * (low + high), 12 / (high - low) ** 2

    def cost(of: np.ndarray, there: np.ndarray, inputs: np.ndarray) -> float:
        return float(misfit.cost(of, there).sum() + (prior * (inputs - middle) ** 2).sum())

    here = model.with_materials(materials).positions(values)
    now, damping = cost(values, here, materials), DAMPING
    for _ in range(steps):
        weights, there = misfit.weights(here), model.with_materials(materials)
        J = weights[..., None] * there.jacobians(values) / noise
        M = weights[..., None] * _derivatives(model, values, materials, _STEP * (high - low)) / noise
        away = weights * misfit.away(here) / noise
        own = np.einsum("nij,ni->nj", J, away) - misfit.prior * (values - misfit.middle)
        # What is at the end of its range, and would leave it, stays there.
        held = ((values <= model.low) & (own < 0)) | ((values >= model.high) & (own > 0))
        J, own = np.where(held[:, None], 0.0, J), np.where(held, 0.0, own)
        A = np.einsum("nij,nik->njk", J, J) + np.diag(misfit.prior)
        A += damping * np.einsum("njj,jk->njk", A, np.eye(A.shape[1]))
        B = np.einsum("nij,nik->njk", J, M)
        C = np.einsum("nij,nik->jk", M, M) + np.diag(prior)
        C += damping * np.diag(np.diag(C))
        common = np.einsum("nij,ni->j", M, away) - prior * (materials - middle)
        solved = np.linalg.solve(A, np.concatenate([B, own[..., None]], 2))
        to_materials, alone = solved[..., :-1], solved[..., -1]
        reduced = C - np.einsum("nji,njk->ik", B, to_materials)
        step = np.linalg.solve(reduced, common - np.einsum("nji,nj->i", B, alone))
        their_materials = np.clip(materials + step, low, high)
        moved = np.clip(values + alone - to_materials @ (their_materials - materials), model.low, model.high)
        # A contact whose step is too long for its slopes stays, so that it does not hold the others back.
        their = model.with_materials(their_materials)
        ways = [(way, their.positions(way)) for way in (moved, values)]
        better = np.subtract(*(misfit.cost(*way) for way in ways)) < 0
        moved, pins_there = (np.where(better[:, None], one, other) for one, other in zip(*ways, strict=True))
        then = cost(moved, pins_there, their_materials)
        if then < now:
            values, materials, here, now, damping = moved, their_materials, pins_there, then, 0.3 * damping
        else:
            damping *= 5
    return materials


def _derivatives(model: PinModel, values: np.ndarray, materials: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 2 p, 5) of the pins' positions by the materials (5,), by central differences; free
    components (n, k) and steps (5,)."""
    ends = [[model.with_materials(materials + sign * one).positions(values) for sign in (1, -1)] for one in np.diag(steps)]
    return np.stack([(a - b) / (2 * s) for (a, b), s in zip(ends, steps, strict=True)], -1)
