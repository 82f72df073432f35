"""A network as an ONNX file: from tactile images to estimates in their units, with all that `Model.estimate` does.

    input   images                    (n, size, size) uint8: tactile images, of the kind that metadata `images` names
    output  pose_z_mm, pose_Rx_deg …  (n,) float32 each: components of the pose; of networks that estimate them, QUANTITIES
            deviation_pose_z_mm …     their standard deviations, with the factors that were fitted to held-out samples
            contact_probability       probability that the force is at least quantities.CONTACT_FORCE_N

Needs the extra `onnx`.
"""

import copy
import io
import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from tactip_twin.learning.data import kind_of
from tactip_twin.learning.deviation_scale import DeviationScale
from tactip_twin.learning.model import Model, net_sha256, to_input
from tactip_twin.learning.outputs import Layout
from tactip_twin.learning.quantities import CONTACT_FORCE_N
from tactip_twin.sim.dataset.format import FORCES
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.tactip_model.design_file import design_from_dict
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

if TYPE_CHECKING:
    from types import ModuleType

MAX_DIFFERENCE = 1e-5
"""Maximum difference between onnxruntime and torch, over the sum of an output's scale and magnitude, -."""

_OPSET = 18
"""Version of ONNX's operators: of 2022, so older runtimes read the files."""

_TEST_IMAGES = 8
"""Number of images for which a file is compared with torch."""


def output_names(model: Model) -> tuple[str, ...]:
    """Return the names of the outputs, with units: means, then, if the network estimates them, deviations and contact."""
    means = [_with_unit(name, unit) for name, unit in zip(model.columns, model.units, strict=True)]
    if not model.config.deviations:
        return tuple(means)
    contact = ["contact_probability"] if model.config.quantities else []
    return tuple([*means, *(f"deviation_{name}" for name in means), *contact])


def _with_unit(name: str, unit: str) -> str:
    """Return the name of a column with its unit, which some columns end with already."""
    ending = "_deg" if unit == "°" else f"_{unit}" if unit else ""
    return name if name.endswith(ending) else name + ending


def export_onnx(model: Model, path: str | Path) -> float:
    """Write a network as an ONNX file, after comparing it with torch.

    Args:
        model: The network.
        path: File to write.

    Returns:
        The largest difference between onnxruntime and torch, as `difference` has it.

    Raises:
        TactipError: If the extra is not installed, or the two differ by more than MAX_DIFFERENCE.
        OSError: If the file cannot be written.
    """
    data = onnx_bytes(model)
    found = difference(model, data, _test_images(model))
    if not found <= MAX_DIFFERENCE:
        raise TactipError(f"the ONNX file differs from torch by {found:.2g} of an output, allowed is {MAX_DIFFERENCE:g}")
    write_file(Path(path), data)
    return found


def _test_images(model: Model) -> np.ndarray:
    """Return images (n, size, size) uint8 of contacts of the network's sensor, which the learned tip predicts: far from what
    it has learned, a network's outputs are huge, and so are their roundings."""
    made = model.provenance.get("train", {}).get("configuration")
    design = design_from_dict(made["design"], "design") if made else design_named("nominal-127")
    design = replace(design, image=replace(design.image, size_px=model.size))
    tip, rng = read_fast_tip(any_materials("edge" if model.labels.task == "edge" else "surface")), np.random.default_rng(0)
    decoder, raster = PinDecoder(design, tip.modes), Raster(design)
    materials = material_inputs(design.materials)
    if tip.materials is not None:
        materials = materials.clip(*tip.materials.T)
    poses, shears = (
        low + (high - low) * rng.uniform(0.3, 0.7, (_TEST_IMAGES, 6)) for low, high in (tip.ranges[:6].T, tip.ranges[6:].T)
    )
    predicted = tip.predict(decoder, poses, shears, materials)
    frames = raster.render(predicted.pin_tips, predicted.directions)
    return np.stack([tactile_image(frame, design.image) for frame in frames])


def onnx_bytes(model: Model) -> bytes:
    """Return a network as an ONNX file. Raises TactipError if the extra `onnx` is not installed."""
    onnx, _ = _libraries()
    module = _Estimator(model).eval()
    names, stream = output_names(model), io.BytesIO()
    export: Callable[..., Any] = torch.onnx.export  # torch's annotations lack streams
    with warnings.catch_warnings():
        # This exporter needs no further package. It warns that it is the older one, and that the parts of the network whose
        # sizes are known are constant.
        warnings.simplefilter("ignore")
        export(
            module,
            (torch.zeros((2, model.size, model.size), dtype=torch.uint8),),
            stream,
            dynamo=False,
            opset_version=_OPSET,
            input_names=["images"],
            output_names=list(names),
            dynamic_axes={name: {0: "n"} for name in ("images", *names)},
        )
    content = onnx.load_from_string(stream.getvalue())
    low, high = (dict(zip(model.labels.names, ends, strict=True)) for ends in (model.labels.low, model.labels.high))
    facts = {
        "tactip-twin": version("tactip-twin"),
        "task": model.labels.task,
        "images": kind_of(model.grey),
        "weights_sha256": net_sha256(model.net),
        "range_low": json.dumps(low),
        "range_high": json.dumps(high),
    }
    onnx.helper.set_model_props(content, facts)
    onnx.checker.check_model(content)
    return content.SerializeToString()


def difference(model: Model, data: bytes, images: np.ndarray) -> float:
    """Return the largest difference between onnxruntime and torch, over the sum of an output's scale and magnitude.

    Args:
        model: The network.
        data: Its ONNX file.
        images: (n, size, size) uint8.

    Raises:
        TactipError: If the extra `onnx` is not installed.
    """
    _, onnxruntime = _libraries()
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    found = np.stack(session.run(list(output_names(model)), {"images": images}), 1)
    expected, scales = model.estimate(images), [model.scales]
    columns = [expected.means]
    if expected.deviations is not None:
        columns, scales = [*columns, expected.deviations], [*scales, model.scales]
    if expected.contact is not None:
        columns, scales = [*columns, expected.contact[:, None]], [*scales, np.ones(1)]
    values = np.concatenate(columns, 1)
    return float((np.abs(found - values) / (np.concatenate(scales) + np.abs(values))).max())


def _libraries() -> "tuple[ModuleType, Any]":
    """Return the modules onnx and onnxruntime. Raises TactipError if they are not installed."""
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise TactipError(f"ONNX files need more ({error}): in the clone, .venv/bin/pip install -e '.[onnx]'") from error
    return onnx, onnxruntime


class _Estimator(nn.Module):
    """`Model.estimate` as a module: images (n, size, size) uint8 to a tensor (n,) for each of `output_names`."""

    def __init__(self, model: Model) -> None:
        super().__init__()
        self._net, self._quantities = copy.deepcopy(model.net).cpu(), model.config.quantities
        self._layout = Layout(model.config, model.labels)
        self._scales = torch.from_numpy(model.scales).float()
        self._forces = [model.columns.index(name) for name in FORCES] if self._quantities else []
        self._factors = None if model.deviation_scale is None else _Factors(model.deviation_scale)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the estimates."""
        split = self._layout.split(self._net(to_input(images)))
        means = split.means * self._scales
        if split.log_deviations is None:
            return means.unbind(1)
        deviations = split.log_deviations.exp() * self._scales
        forces = means[:, self._forces].square().sum(1).sqrt()  # of no components: 0
        if self._factors is not None:
            deviations = deviations * self._factors(forces)
        if not self._quantities:
            return (*means.unbind(1), *deviations.unbind(1))
        spread = deviations[:, self._forces].square().mean(1).sqrt()
        contact = 0.5 * (1 + torch.erf((forces - CONTACT_FORCE_N) / (spread * 2**0.5)))
        return (*means.unbind(1), *deviations.unbind(1), contact)


class _Factors(nn.Module):
    """`DeviationScale.at` as a module."""

    def __init__(self, scale: DeviationScale) -> None:
        super().__init__()
        self._at = torch.tensor(scale.forces_n)
        self._logs = torch.tensor(scale.factors).log()

    def forward(self, forces: torch.Tensor) -> torch.Tensor:
        """Return the factors (n, c) at forces (n,), N: the first ones plus, of each step to the next, the part passed."""
        passed = ((forces[:, None] - self._at[:-1]) / self._at.diff()).clamp(0, 1)
        return (self._logs[0] + passed @ self._logs.diff(dim=0)).exp()
