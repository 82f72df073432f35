"""Rounds of a calibration: the Gauss-Newton method on the distance between detected and simulated pins. For each parameter
that the mechanics depend on, every contact is simulated again.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from tactip_twin.sim.contact.simulator import LEVER_M
from tactip_twin.sim2real.calibration.frames import Frames
from tactip_twin.sim2real.calibration.moves import (
    LOAD_CELL_N,
    best_fraction,
    distances,
    pin_pixels,
    simulate_along,
    simulate_at,
    simulate_forces,
)
from tactip_twin.sim2real.calibration.parameters import Parameter, SensorOnRig, parameters
from tactip_twin.tactip_model.neutral_image import with_pin_offsets

_FORCE_SPREAD = 0.15
"""Standard deviation of the logarithm of a load cell's force, -."""

_PIXEL_SPREAD = 0.5
"""Residual of a good fit, px of 256."""

_INDEPENDENT = 10
"""Number of independent measurements that a frame counts for, because errors of its pins are correlated."""

_OUTLIER_PX = 1.0
"""Distance, px of 256, beyond which a frame's influence on the fit no longer grows, because the model does not explain
it."""

_AZIMUTHS = 12
"""Azimuths to start from."""

_DAMPING = 0.01
"""Levenberg's damping, as a fraction of the diagonal."""

_Job = TypeVar("_Job")


def robust_cost(rms: np.ndarray) -> float:
    """Return the Huber cost of frames' rms distances (n,) px: quadratic up to _OUTLIER_PX, linear beyond."""
    return float(np.where(rms < _OUTLIER_PX, rms**2, _OUTLIER_PX * (2 * rms - _OUTLIER_PX)).mean())


class Calibrator:
    """Fits a SensorOnRig to Frames."""

    def __init__(self, frames: Frames, neutral_pins_px: np.ndarray, executor: Executor) -> None:
        """Prepare a fit.

        Args:
            frames: Frames to fit.
            neutral_pins_px: (p, 2), px of 256, pins of the neutral image.
            executor: Executor of the simulations.
        """
        self._frames, self._neutral, self._executor = frames, neutral_pins_px, executor

    def pins_along_moves(self, twin: SensorOnRig, fidelity: str, frames: Frames | None = None) -> np.ndarray:
        """Return pins (n, MOVE_FRACTIONS, p, 2) px of 256 at each fraction of each move of `frames`, or of those fitted."""
        frames = frames or self._frames
        parts = np.array_split(np.arange(len(frames.commands)), min(16, len(frames.commands)))
        jobs = [(twin.design, twin.rig, fidelity, [frames.commands[i] for i in part], frames.tap) for part in parts]
        skins = np.concatenate(self._progress(simulate_along, jobs, "simulating moves"))
        return pin_pixels(twin.design, fidelity, skins)

    def misfit(self, twin: SensorOnRig, fidelity: str, count: int = 12) -> float:
        """Return the median distance, px, of the `count` frames with the largest tilt and move, before or after their
        move."""
        commands = self._frames.commands
        motion = [np.linalg.norm(pose[3:]) + np.linalg.norm(move[:3]) / LEVER_M for pose, move in commands]
        chosen = np.argsort(motion)[-count:]
        jobs = [(twin.design, twin.rig, fidelity, [commands[i]] * 2, self._frames.tap, [0.0, 1.0]) for i in chosen]
        pins = pin_pixels(twin.design, fidelity, np.array(list(self._executor.map(simulate_at, jobs))))
        return float(np.median(distances(pins, self._frames.pins_px[chosen][:, None]).min(1)))

    def forces(self, twin: SensorOnRig, fidelity: str) -> np.ndarray:
        """Return the normal forces (3,) N at the depths of LOAD_CELL_N."""
        return next(iter(self._executor.map(simulate_forces, [(twin.design, fidelity)])))

    def cost(self, twin: SensorOnRig, chosen: Sequence[Parameter], fidelity: str) -> tuple[float, np.ndarray]:
        """Return the cost, px², of a SensorOnRig, and its pins (n, MOVE_FRACTIONS, p, 2) px along each frame's move.

        The cost is the frames' robust cost and, in its unit, the residuals of forces and of the priors of `chosen`.
        """
        along = self.pins_along_moves(twin, fidelity)
        frames = robust_cost(distances(best_fraction(along, self._frames.pins_px)[1], self._frames.pins_px))
        residuals = np.concatenate([self._force_residuals(twin, fidelity), [p.prior_residual(twin) for p in chosen]])
        return frames + float((residuals**2).sum()) * 2 * _PIXEL_SPREAD**2 / (_INDEPENDENT * len(along)), along

    def _force_residuals(self, twin: SensorOnRig, fidelity: str) -> np.ndarray:
        """Return the deviations (3,) of forces from LOAD_CELL_N, in standard deviations."""
        return np.log(self.forces(twin, fidelity) / list(LOAD_CELL_N.values())) / _FORCE_SPREAD

    def round(
        self, twin: SensorOnRig, chosen: Sequence[Parameter], fidelity: str
    ) -> tuple[SensorOnRig, np.ndarray, dict[str, Any]]:
        """Take one Gauss-Newton step. Searched parameters keep their values, with the deviations of their priors. Each frame
        has its own fraction of the move, which is projected out of residuals and derivatives (variable projection), so no
        parameter changes for what a fraction explains as well. A step that does not lower the cost is halved.

        Args:
            twin: Sensor and rig before the step.
            chosen: The k parameters.
            fidelity: Fidelity of the simulations.

        Returns:
            The new SensorOnRig, deviations (k,) in the parameters' steps, and figures.
        """
        seen = self._frames.pins_px
        smooth = [p for p in chosen if not p.searched]
        cost, along = self.cost(twin, chosen, fidelity)
        fractions, _, tangents = best_fraction(along, seen)
        mechanical = [p for p in smooth if p.mechanical]
        twins = [twin] + [p.moved(twin, 1.0) for p in mechanical]
        names = [None] + [p.name for p in mechanical]
        jobs = [(t.design, t.rig, fidelity, self._frames.commands, self._frames.tap, fractions) for t in twins]
        skins = dict(zip(names, self._progress(simulate_at, jobs, "simulating slopes"), strict=True))
        pressed = list(self._executor.map(simulate_forces, [(t.design, fidelity) for t in twins]))
        forces = dict(zip(names, pressed, strict=True))

        here = pin_pixels(twin.design, fidelity, skins[None])
        rms = distances(here, seen)
        weight = np.sqrt(np.minimum(1, _OUTLIER_PX / np.maximum(rms, 1e-9))) / _PIXEL_SPREAD
        weight = weight * np.sqrt(_INDEPENDENT / (2 * np.isfinite(seen[..., 0]).sum(1)))
        expected = np.array(list(LOAD_CELL_N.values()))
        direction = np.where(np.isfinite(seen), tangents, 0.0).reshape(len(seen), -1)
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)

        def residual(pins: np.ndarray) -> np.ndarray:
            wrong = (np.nan_to_num(pins - seen) * weight[:, None, None]).reshape(len(seen), -1)
            return wrong - (wrong * direction).sum(1, keepdims=True) * direction

        slope_rows, force_slope_rows = [], []
        for p in smooth:
            moved = p.moved(twin, 1.0)
            design = self._rebuilt(moved).design if not p.mechanical else twin.design
            pins = pin_pixels(design, fidelity, skins[p.name if p.mechanical else None])
            slope_rows.append(residual(pins) - residual(here))
            force_slope_rows.append(np.log(forces[p.name if p.mechanical else None] / forces[None]) / _FORCE_SPREAD)
        slopes, force_slopes = np.array(slope_rows), np.array(force_slope_rows)
        by_frame = np.einsum("kni,ni->nk", slopes, residual(here))
        prior_residuals = np.array([p.prior_residual(twin) for p in smooth])
        prior_slopes = np.array([0.0 if p.prior is None else p.step / p.prior[1] for p in smooth])
        force_residuals = np.log(forces[None] / expected) / _FORCE_SPREAD
        curvature = np.einsum("kni,lni->kl", slopes, slopes) + force_slopes @ force_slopes.T + np.diag(prior_slopes**2)
        gradient = by_frame.sum(0) + force_slopes @ force_residuals + prior_slopes * prior_residuals
        change = -np.linalg.solve(curvature + _DAMPING * np.diag(np.diag(curvature)), gradient)
        # Frames are independent, pins are not: deviations come from the spread of the frames' gradients.
        inverse = np.linalg.inv(curvature)
        spread = by_frame.T @ by_frame + force_slopes @ force_slopes.T + np.diag(prior_slopes**2)
        found = dict(zip([p.name for p in smooth], np.sqrt(np.diag(inverse @ spread @ inverse)), strict=True))
        deviations = np.array([found.get(p.name, p.prior[1] / p.step if p.prior else np.inf) for p in chosen])
        changes = dict(zip(smooth, np.clip(change, -8, 8), strict=True))
        new, after, fraction = self._lowest(twin, chosen, changes, fidelity, cost)
        figures = {"fidelity": fidelity, "rms_px": float(np.sqrt((rms**2).mean())), "median_px": float(np.median(rms))}
        figures |= {"cost_before": cost, "cost_after": after, "share_of_step": fraction, "forces_n": forces[None].tolist()}
        return new, deviations, figures

    def _lowest(
        self, twin: SensorOnRig, chosen: Sequence[Parameter], changes: Mapping[Parameter, float], fidelity: str, cost: float
    ) -> tuple[SensorOnRig, float, float]:
        """Return the first SensorOnRig along `changes` (in steps) below `cost`, its cost, and the fraction taken."""
        for fraction in (1.0, 0.5, 0.25):
            new = twin
            for p, amount in changes.items():
                new = p.moved(new, fraction * amount)
            new = self._rebuilt(new)
            after, _ = self.cost(new, chosen, fidelity)
            if after < cost:
                return new, after, fraction
        return self._rebuilt(twin), cost, 0.0  # as a resumed run rebuilds it

    def search(
        self, twin: SensorOnRig, chosen: Sequence[Parameter], deviations: np.ndarray, fidelity: str
    ) -> tuple[SensorOnRig, np.ndarray, dict[str, Any]]:
        """Try each searched parameter of `chosen` one step up and down, and keep what lowers the cost.

        Args:
            twin: Sensor and rig before the search.
            chosen: The k parameters.
            deviations: (k,) standard deviations, in their steps.
            fidelity: Fidelity of the simulations.

        Returns:
            The new SensorOnRig, the deviations (k,), of searched parameters from a parabola through three costs, and
            figures.
        """
        before, _ = self.cost(twin, chosen, fidelity)
        here, deviations = before, deviations.copy()
        scale = _INDEPENDENT * len(self._frames.commands) / (2 * _PIXEL_SPREAD**2)
        for k, p in enumerate(chosen):
            if not p.searched:
                continue
            tried = {amount: p.moved(twin, amount) for amount in (-1.0, 1.0)}
            costs = {amount: self.cost(t, chosen, fidelity)[0] for amount, t in tried.items()}
            bend = scale * ((costs[-1.0] + costs[1.0]) / 2 - here)
            if bend > 0:
                deviations[k] = min(deviations[k], 1 / np.sqrt(bend))
            best = min(costs, key=costs.__getitem__)
            if costs[best] < here:
                twin, here = tried[best], costs[best]
        return twin, deviations, {"fidelity": fidelity, "searched": True, "cost_before": before, "cost_after": here}

    def _rebuilt(self, twin: SensorOnRig) -> SensorOnRig:
        """Return the SensorOnRig with its pins at their positions in the neutral image and the camera as it was then."""
        return replace(twin, design=with_pin_offsets(twin.design, self._neutral))

    def _progress(self, work: Callable[[_Job], np.ndarray], jobs: Sequence[_Job], what: str) -> list[np.ndarray]:
        return list(tqdm(self._executor.map(work, jobs), total=len(jobs), desc=what, leave=False))


def first_azimuth(calibrator: Calibrator, twin: SensorOnRig, fidelity: str) -> SensorOnRig:
    """Return the SensorOnRig with the best of _AZIMUTHS azimuths, because the fit itself finds the nearest optimum only."""
    azimuth = next(p for p in parameters(twin.design) if p.name == "azimuth")
    candidates = [azimuth.write(twin, 360 * k / _AZIMUTHS - 180) for k in range(_AZIMUTHS)]
    return min(candidates, key=lambda candidate: calibrator.misfit(candidate, fidelity))
