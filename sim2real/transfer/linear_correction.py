"""Linear correction of a network's poses by a few labelled real frames.

What a network taught in simulation reads wrong on a real sensor is to a large part a linear function of the pose: the rig's
zeros are offsets, a tip of other mechanics is a gain, and a tool centre beside the axis makes depth change with tilt
(linear_errors.py). What else its mechanics change is to a part a linear function of the features, the inputs of the output
layer. A handful of frames determine the former, and how large the latter may be. A fine-tuning of all layers would learn the
frames by heart. The correction goes into the weights of the output layer, so the result is a network like any other.
"""

import hashlib
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from tactip_twin.learning.data import Samples
from tactip_twin.learning.deviation_scale import DeviationScale, fit_deviation_scale
from tactip_twin.learning.model import DESCRIPTION, WEIGHTS, Estimates, Model, net_sha256, read_description, save_model
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.sim.parallel.resume import check_resumable
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

_FEATURE_SPREADS = {"mm": (0.003, 0.01, 0.03, 0.1, 0.3), "°": (0.03, 0.1, 0.3, 1.0, 3.0)}
"""Standard deviations, before any frame is used, of the change of a component per standard deviation of the features along
their widest direction, by unit: the most likely one is taken. The smallest leaves the linear function of the pose."""

_TAIL = 4.0
"""Degrees of freedom of the distribution of errors, a Student's t, -: a frame that lags far behind its label counts less
(Lange, Little and Taylor, Journal of the American Statistical Association 84, 1989, who use 4)."""

_MIN_NOISE = 1e-4
"""Minimum standard deviation of labels, mm or degrees: below it, rounding decides."""

_ROUNDS = 10
"""Number of rounds in which coefficients, noise and weights of frames are estimated in turn."""

_MIN_REST = 0.05
"""Minimum part of a frame's error that its own label leaves, -: below it, rounding decides."""

_SCALE_FRAMES = 3
"""Number of frames from which the factors on the standard deviations are believed by half [?]."""


@dataclass(frozen=True)
class LinearCorrection:
    """A correction of k components of a pose, mm and degrees, by the pose and f features of a network:
    matrix @ (pose - middle) + middle + offset + by_features @ (features - middle_features)."""

    matrix: np.ndarray
    """(k, k)."""
    middle: np.ndarray
    """(k,)."""
    offset: np.ndarray
    """(k,)."""
    by_features: np.ndarray
    """(k, f)."""
    middle_features: np.ndarray
    """(f,)."""
    leverages: np.ndarray
    """(n, k) Change of the corrected pose of each of the frames per change of its own label, -, 0 to 1."""

    def __call__(self, poses: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Return corrected poses (n, k) of poses (n, k) and features (n, f)."""
        changed = (features - self.middle_features) @ self.by_features.T
        return (poses - self.middle) @ self.matrix.T + self.middle + self.offset + changed


def fit_linear_correction(
    poses: np.ndarray, features: np.ndarray, labels: np.ndarray, units: tuple[str, ...], varies: np.ndarray
) -> LinearCorrection:
    """Return the most likely correction, with normal priors on its coefficients.

    The noise of each component, and how much the features change it, are estimated with it, by the evidence (MacKay, Neural
    Computation 4(3), 1992).

    Args:
        poses: (n, k) estimates, mm and degrees.
        features: (n, f) features of the network; f may be 0.
        labels: (n, k) their labels.
        units: (k) units of the components.
        varies: (k,) bool, whether the labels of a component vary; others are neither scaled nor used for others, and get an
            offset only.
    """
    count, middle, middle_features = len(units), poses.mean(0), features.mean(0)
    matrix, offset, leverages = np.eye(count), np.zeros(count), np.zeros(poses.shape)
    by_features = np.zeros((count, features.shape[1]))
    widest = np.linalg.norm(features - middle_features, 2) / np.sqrt(len(features)) if features.size else 0.0
    terms = np.flatnonzero(varies)
    for k, unit in enumerate(units):
        used = terms if varies[k] else terms[:0]
        extra = features - middle_features if varies[k] and widest else features[:, :0]
        columns = np.column_stack([poses[:, used] - middle[used], np.ones(len(poses)), extra])
        spreads = [_GAIN_SPREAD if j == k else _CROSS_SPREAD[unit, units[j]] for j in used]
        fits = [
            _fitted(columns, labels[:, k] - poses[:, k], np.array([*spreads, _OFFSET_SPREAD[unit], *each]))
            for each in ([[spread / widest] * extra.shape[1] for spread in _FEATURE_SPREADS[unit]] if extra.size else [[]])
        ]
        best = max(fits, key=lambda fit: fit.evidence)
        matrix[k, used] += best.coefficients[: len(used)]
        offset[k] = best.coefficients[len(used)]
        by_features[k, : extra.shape[1]] = best.coefficients[len(used) + 1 :]
        leverages[:, k] = best.leverages
    return LinearCorrection(matrix, middle, offset, by_features, middle_features, leverages)


@dataclass(frozen=True)
class _Fit:
    """Most likely coefficients of a linear function."""

    coefficients: np.ndarray
    """(c,)."""
    leverages: np.ndarray
    """(n,) Change of what they explain of each frame per change of what is wrong there, -."""
    evidence: float
    """Logarithm of the probability of the frames, whatever the coefficients, up to a constant."""


def _fitted(columns: np.ndarray, wrong: np.ndarray, spreads: np.ndarray) -> _Fit:
    """Return the coefficients of columns (n, c) that explain what is wrong (n,), with standard deviations (c,) before."""
    noise, weights, x = max(float(wrong.std()), _MIN_NOISE), np.ones(len(wrong)), columns * spreads
    for _ in range(_ROUNDS):
        _, solver, leverages = _least_squares(x, weights / noise**2)
        rest = wrong - x @ (solver @ wrong)
        noise = max(float(np.sqrt(weights @ rest**2 / max(len(wrong) - leverages.sum(), 1.0))), _MIN_NOISE)
        weights = (_TAIL + 1) / (_TAIL + (rest / noise) ** 2)
    precisions = weights / noise**2
    whole, solver, leverages = _least_squares(x, precisions)
    explained = solver @ wrong
    # Of a normal distribution with the covariance x @ x.T + diag(1 / precisions), by Woodbury's identity.
    evidence = -0.5 * (
        wrong @ (precisions * (wrong - x @ explained)) + np.linalg.slogdet(whole)[1] - np.log(precisions).sum()
    )
    return _Fit(spreads * explained, leverages, float(evidence))


def _least_squares(x: np.ndarray, precisions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrix (c, c) of the normal equations of columns (n, c), whose coefficients have a standard deviation of 1
    before; the coefficients (c, n) per value; and the leverages (n,) of values with these precisions (n,)."""
    weighted = x.T * precisions
    whole = weighted @ x + np.eye(x.shape[1])
    solver = np.linalg.solve(whole, weighted)
    return whole, solver, np.einsum("ij,ji->i", x, solver)


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
    count = len(model.labels.components)
    estimates, features = estimates_and_features(model, real.images)
    poses = model.labels.unwrapped(estimates.means[:, :count], real.targets)
    varies = real.targets.std(0) > MIN_SPREAD * model.labels.scale  # the others get an offset only
    if model.labels.circular is not None:
        varies[model.labels.circular] = False
    correction = fit_linear_correction(poses, features, real.targets, model.labels.units, varies)
    net = _with_outputs(model, correction)
    if estimates.deviations is None:
        return replace(model, net=net), correction
    errors = correction(poses, features) - real.targets
    errors = errors / np.maximum(1 - correction.leverages, _MIN_REST)  # as if each frame had been left out of the fit
    found = fit_deviation_scale(errors, estimates.deviations[:, :count], None).factors[0]
    factors = np.ones(len(model.columns))
    factors[:count] = np.array(found) ** (len(real) / (len(real) + _SCALE_FRAMES))
    before = model.deviation_scale or DeviationScale((0.0,), (tuple(np.ones(len(factors)).tolist()),))
    return replace(model, net=net, deviation_scale=before.times(factors)), correction


def estimates_and_features(model: Model, images: np.ndarray) -> tuple[Estimates, np.ndarray]:
    """Return estimates of n images, and the inputs (n, f) of the output layer."""
    found: list[torch.Tensor] = []
    handle = model.net.dense[-1].register_forward_pre_hook(lambda module, inputs: found.append(inputs[0].double().cpu()))
    try:
        estimates = model.estimate(images)
    finally:
        handle.remove()
    return estimates, torch.cat(found).numpy()


def _with_outputs(model: Model, correction: LinearCorrection) -> PoseNet:
    """Return a copy of a model's network whose output layer has the correction."""
    net, count, scale = deepcopy(model.net), len(correction.offset), model.labels.scale
    matrix = torch.from_numpy(correction.matrix * scale / scale[:, None])
    shift = correction.middle + correction.offset - correction.matrix @ correction.middle
    shift -= correction.by_features @ correction.middle_features
    further = torch.from_numpy(correction.by_features / scale[:, None])
    last = net.dense[-1]
    assert isinstance(last, nn.Linear)  # noqa: S101
    k = model.labels.circular
    if k is not None:
        shift[k] = 0.0
    with torch.no_grad():
        weight, bias = last.weight[:count].double().cpu(), last.bias[:count].double().cpu()
        last.weight[:count] = (matrix @ weight + further).to(last.weight)
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
    record = _record(model, real)
    if check_resumable(folder, "corrected network", _recorded(folder, record), record, own=(WEIGHTS,)):
        log(f"{folder} already holds this network")
        return
    found, correction = corrected(model, real)
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder)
    numbers = {name: np.round(getattr(correction, name), 6).tolist() for name in ("matrix", "middle", "offset")}
    provenance = model.provenance | record | {"linear_correction": numbers}
    save_model(folder, found.net.state_dict(), model.config, model.labels, model.size, provenance, found.deviation_scale)


def _record(model: Model, real: Samples) -> dict[str, Any]:
    """Return, as JSON, the initial network, the real samples and the function by which it is corrected."""
    chosen = hashlib.sha256(real.rows.astype("<i8").tobytes()).hexdigest()
    samples = {"digest": real.dataset.meta["digest"], "samples": len(real), "chosen": chosen}
    return {"initial_weights": net_sha256(model.net), "real": samples, "corrected_by": "poses and features"}


def _recorded(folder: Path, record: dict[str, Any]) -> dict[str, Any] | None:
    """Return what the provenance of a folder's corrected network has for the keys of `record`; None without one."""
    if not (folder / DESCRIPTION).exists():
        return None
    provenance = read_description(folder)["provenance"]
    return {key: provenance.get(key) for key in record} if "linear_correction" in provenance else None
