"""Linear correction of a network's poses by a few labelled real frames.

What a network taught in simulation reads wrong on a real sensor is to a large part a linear function of the pose: the rig's
zeros are offsets, a tip of other mechanics is a gain, and a tool centre beside the axis makes depth change with tilt
(linear_errors.py). A handful of frames determine these numbers, where a fine-tuning would learn the frames by heart. The
correction goes into the weights of the output layer, so the result is a network like any other.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from tactip_twin.learning.data import Samples
from tactip_twin.learning.deviation_scale import DeviationScale, fit_deviation_scale
from tactip_twin.learning.model import WEIGHTS, Model, save_model
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.sim2real.transfer.fine_tune import origin, recorded
from tactip_twin.sim2real.transfer.score import MIN_SPREAD
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import remove_leftovers

MIN_FRAMES = 10
"""Minimum number of frames. Five raise the tilt error on real-331 by a quarter, because some frames lag behind their labels
[M]."""

_GAIN_SPREAD = 0.15
"""Standard deviation of a gain before any frame is used: real-331 has 0.12 [M], another 331-pin tip 0.2 [R]."""

_CROSS_SPREAD = {("mm", "mm"): 0.1, ("mm", "°"): 0.01, ("°", "mm"): 0.5, ("°", "°"): 0.1}
"""Standard deviation, before any frame is used, of the change of a component by another, by their units. 0.01 mm per degree
is a tool centre 0.6 mm beside the axis; 0.1 degree per degree a camera turned by 6 degrees [?]."""

_OFFSET_SPREAD = {"mm": 2.0, "°": 10.0}
"""Standard deviation of an offset before any frame is used, by unit: hardly a restriction [?]."""

_NOISE_ROUNDS = 10
"""Number of rounds in which coefficients and noise are estimated in turn."""

_SCALE_FRAMES = 3
"""Number of frames from which the factors on the standard deviations are believed by half [?]."""


@dataclass(frozen=True)
class LinearCorrection:
    """A correction of k components of a pose, mm and degrees: matrix @ (pose - middle) + middle + offset."""

    matrix: np.ndarray
    """(k, k)."""
    middle: np.ndarray
    """(k,)."""
    offset: np.ndarray
    """(k,)."""
    freedoms: np.ndarray
    """(k,) Number of coefficients of each component that the frames determine."""

    def __call__(self, poses: np.ndarray) -> np.ndarray:
        """Return corrected poses (n, k)."""
        return (poses - self.middle) @ self.matrix.T + self.middle + self.offset


def fit_linear_correction(
    poses: np.ndarray, labels: np.ndarray, units: tuple[str, ...], varies: np.ndarray
) -> LinearCorrection:
    """Return the most likely correction, with normal priors on its coefficients.

    The noise of each component is estimated with it, by the evidence (MacKay, Neural Computation 4(3), 1992).

    Args:
        poses: (n, k) estimates, mm and degrees.
        labels: (n, k) their labels.
        units: (k) units of the components.
        varies: (k,) bool, whether the labels of a component vary; others are neither scaled nor used for others.
    """
    count, middle = len(units), poses.mean(0)
    matrix, offset, freedoms = np.eye(count), np.zeros(count), np.ones(count)
    terms = np.flatnonzero(varies)
    for k, unit in enumerate(units):
        used = terms if varies[k] else terms[:0]
        columns = np.column_stack([poses[:, used] - middle[used], np.ones(len(poses))])
        spreads = [_GAIN_SPREAD if j == k else _CROSS_SPREAD[unit, units[j]] for j in used]
        prior = np.diag(1 / np.square([*spreads, _OFFSET_SPREAD[unit]]))
        wrong = labels[:, k] - poses[:, k]
        curvature, noise = columns.T @ columns, max(float(wrong.std()), 1e-6)
        found = np.zeros(len(used) + 1)
        for _ in range(_NOISE_ROUNDS):
            whole = curvature / noise**2 + prior
            found = np.linalg.solve(whole, columns.T @ wrong / noise**2)
            freedoms[k] = np.trace(np.linalg.solve(whole, curvature / noise**2))
            rest = float(np.square(wrong - columns @ found).sum())
            noise = max(np.sqrt(rest / max(len(wrong) - freedoms[k], 1.0)), 1e-6)
        matrix[k, used] += found[:-1]
        offset[k] = found[-1]
    return LinearCorrection(matrix, middle, offset, freedoms)


def corrected(model: Model, real: Samples) -> tuple[Model, LinearCorrection]:
    """Return a network with its poses corrected, and its standard deviations scaled, to fit labelled frames.

    Args:
        model: The network, left unchanged.
        real: Samples of a real set.

    Raises:
        TactipError: If there are fewer than MIN_FRAMES samples.
    """
    if len(real) < MIN_FRAMES:
        raise TactipError(f"a linear correction needs at least {MIN_FRAMES} real frames, got {len(real)}")
    estimates, count = model.estimate(real.images), len(model.labels.components)
    poses = model.labels.unwrapped(estimates.means[:, :count], real.targets)
    varies = real.targets.std(0) > MIN_SPREAD * model.labels.scale  # the others get an offset only
    if model.labels.circular is not None:
        varies[model.labels.circular] = False
    correction = fit_linear_correction(poses, real.targets, model.labels.units, varies)
    net = _with_outputs(model, correction)
    if estimates.deviations is None:
        return replace(model, net=net), correction
    errors = correction(poses) - real.targets
    errors = errors * np.sqrt(len(real) / np.maximum(len(real) - correction.freedoms, 1.0))
    found = fit_deviation_scale(errors, estimates.deviations[:, :count], None).factors[0]
    factors = np.ones(len(model.columns))
    factors[:count] = np.array(found) ** (len(real) / (len(real) + _SCALE_FRAMES))
    before = model.deviation_scale or DeviationScale((0.0,), (tuple(np.ones(len(factors)).tolist()),))
    return replace(model, net=net, deviation_scale=before.times(factors)), correction


def _with_outputs(model: Model, correction: LinearCorrection) -> PoseNet:
    """Return a copy of a model's network whose output layer has the correction."""
    net, count, scale = deepcopy(model.net), len(correction.offset), model.labels.scale
    matrix = torch.from_numpy(correction.matrix * scale / scale[:, None])
    shift = correction.middle + correction.offset - correction.matrix @ correction.middle
    last = net.dense[-1]
    assert isinstance(last, nn.Linear)  # noqa: S101
    k = model.labels.circular
    if k is not None:
        shift[k] = 0.0
    with torch.no_grad():
        weight, bias = last.weight[:count].double().cpu(), last.bias[:count].double().cpu()
        last.weight[:count] = (matrix @ weight).to(last.weight)
        last.bias[:count] = (matrix @ bias + torch.from_numpy(shift / scale)).to(last.bias)
        if k is not None:  # its outputs are a sine, and last a cosine
            turn = Rotation.from_rotvec([0, 0, np.radians(correction.offset[k])]).as_matrix()[:2, :2]
            for outputs in (last.weight, last.bias):
                both = torch.stack([outputs[-1], outputs[k]])
                outputs[-1], outputs[k] = torch.tensordot(torch.from_numpy(turn).to(both), both, 1)
    return net


def write_corrected(model: Model, real: Samples, folder: str | Path, log: Callable[[str], object] = print) -> None:
    """Correct a network by labelled frames and write it to a folder. An existing network is kept.

    Args:
        model: Network to start from, left unchanged.
        real: Samples of a real set.
        folder: Folder to write.
        log: Callback for messages to the user.

    Raises:
        TactipError: If the folder holds something else, or there are too few real samples.
    """
    folder = Path(folder)
    record = origin(model, real)
    if check_resumable(folder, "corrected network", recorded(folder, record, "linear_correction"), record, own=(WEIGHTS,)):
        log(f"{folder} already holds this network")
        return
    found, correction = corrected(model, real)
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder)
    numbers = {name: np.round(getattr(correction, name), 6).tolist() for name in ("matrix", "middle", "offset")}
    provenance = model.provenance | record | {"linear_correction": numbers}
    save_model(folder, found.net.state_dict(), model.config, model.labels, model.size, provenance, found.deviation_scale)
