"""Trained networks: their weights (model.pt) and description (model.json), and prediction with them."""

import contextlib
import dataclasses
import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from tactip_twin.assets import MODELS
from tactip_twin.learning.configuration import PoseNetConfig
from tactip_twin.learning.deviation_scale import DeviationScale, fit_deviation_scale
from tactip_twin.learning.device import one_thread
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.outputs import Layout
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.learning.quantities import QUANTITIES, contact_probability
from tactip_twin.sim.dataset.configuration import has_grey_images
from tactip_twin.sim.dataset.format import FORCES
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import MAX_UNPACKED_BYTES, has_checksum, read_file, read_json, with_checksum

FORMAT = "tactip-twin PoseNet"
VERSION = 2

WEIGHTS, DESCRIPTION = "model.pt", "model.json"


@dataclass(frozen=True)
class Estimates:
    """Estimates from n images: poses and, if the network has them, other quantities and deviations. (c components)"""

    means: np.ndarray
    """(n, c) in the units of Model.columns."""
    deviations: np.ndarray | None
    """(n, c) standard deviations, or None."""
    contact: np.ndarray | None
    """(n,) probability that the force is at least quantities.CONTACT_FORCE_N; None without deviations of forces."""


@dataclass(frozen=True)
class Model:
    """A trained PoseNet and its labels."""

    net: PoseNet
    """The network, with its weights."""
    config: PoseNetConfig
    """Its hyperparameters."""
    labels: Labels
    """The components that it predicts, and their ranges."""
    size: int
    """Width of its images, px."""
    provenance: dict[str, Any]
    """Data and settings of its training, as JSON."""
    deviation_scale: DeviationScale | None = None
    """Factors on the standard deviations as the network estimates them; None: 1."""

    @property
    def grey(self) -> bool:
        """Whether it learned from grey images, not binary ones."""
        train = self.provenance.get("train")
        configuration = train.get("configuration") if isinstance(train, dict) else None
        return isinstance(configuration, dict) and has_grey_images(configuration)

    def predict(self, images: ArrayLike, batch: int = 256) -> np.ndarray:
        """Predict poses from tactile images.

        Args:
            images: (n, size, size) uint8, or one image (size, size).
            batch: Maximum number of images per forward pass.

        Returns:
            Poses (n, k), or (k,) of one image, mm and degrees in the order of labels.components.

        Raises:
            TactipError: If the images have another size or type.
        """
        images = np.asarray(images)
        if images.ndim == 2:
            return self.predict(images[None], batch)[0]
        return self.estimate(images, batch).means[:, : len(self.labels.components)]

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns (c) of what the network estimates: components of the pose, then, if it has them, QUANTITIES."""
        return (*self.labels.names, *(q.name for q in QUANTITIES if self.config.quantities))

    @property
    def units(self) -> tuple[str, ...]:
        """Units (c) of the columns."""
        return (*self.labels.units, *(q.unit for q in QUANTITIES if self.config.quantities))

    @property
    def scales(self) -> np.ndarray:
        """Scales (c) of the columns, in their units."""
        return np.array([*self.labels.scale, *(q.scale for q in QUANTITIES if self.config.quantities)])

    def estimate(self, images: np.ndarray, batch: int = 256) -> Estimates:
        """Estimate all that the network does from tactile images (n, size, size) uint8.

        Args:
            images: The images.
            batch: Maximum number of images per forward pass.

        Raises:
            TactipError: If the images have another size or type.
        """
        if images.ndim != 3 or images.shape[1:] != (self.size, self.size) or images.dtype != np.uint8:
            raise TactipError(
                f"images must be uint8 of shape (n, {self.size}, {self.size}), got {images.dtype} of shape {images.shape}"
            )
        if images.size and images.max() == 1:
            raise TactipError("images must have values from 0 to 255, and binary ones 0 and 255, got 0 and 1")
        device, layout = next(self.net.parameters()).device, Layout(self.config, self.labels)
        if self.net.training:  # setting it again takes 4 % of an estimate [M]
            self.net.eval()
        out = [torch.zeros((0, layout.size))]
        with torch.inference_mode(), one_thread() if len(images) == 1 else contextlib.nullcontext():
            for start in range(0, len(images), batch):
                some = torch.from_numpy(np.ascontiguousarray(images[start : start + batch])).to(device)
                out.append(self.net(to_input(some)).cpu())
            split = layout.split(torch.cat(out).double())
            means = split.means.numpy() * self.scales
            if split.log_deviations is None:
                return Estimates(means, None, None)
            deviations, forces = split.log_deviations.exp().numpy() * self.scales, self._forces(means)
            if self.deviation_scale is not None:
                deviations = deviations * self.deviation_scale.at(forces)
            contact = contact_probability(forces, deviations[:, self._force_columns]) if self.config.quantities else None
            return Estimates(means, deviations, contact)

    @property
    def _force_columns(self) -> list[int]:
        """Columns of the force; the network must estimate it."""
        return [self.columns.index(name) for name in FORCES]

    def _forces(self, means: np.ndarray) -> np.ndarray:
        """Return the magnitudes (n,), N, of estimated forces; zeros if the network estimates none. means: (n, c)."""
        if not self.config.quantities:
            return np.zeros(len(means))
        return np.linalg.norm(means[:, self._force_columns], axis=1)

    def with_fitted_scale(self, images: np.ndarray, targets: np.ndarray) -> "Model":
        """Return the model with the factors on its deviations fitted to held-out samples; itself if it has no deviations.

        Args:
            images: (n, size, size) uint8.
            targets: (n, c) in the units of the columns; NaN where unknown.
        """
        if not self.config.deviations:
            return self
        plain = replace(self, deviation_scale=None)
        found = plain.estimate(images)
        assert found.deviations is not None  # noqa: S101
        forces = self._forces(found.means) if self.config.quantities else None
        errors = self.labels.unwrapped(found.means, targets) - targets
        return replace(plain, deviation_scale=fit_deviation_scale(errors, found.deviations, forces))


def to_input(images: torch.Tensor) -> torch.Tensor:
    """Convert images (n, size, size) uint8 to the network's input, (n, 1, size, size) float from 0 to 1, channels last."""
    return (images[:, None].float() / 255).contiguous(memory_format=torch.channels_last)


def to_device(net: PoseNet, device: str) -> PoseNet:
    """Move a network to a torch device, with channels-last weights, and return it."""
    move: Callable[..., PoseNet] = net.to  # torch's annotations lack memory_format
    return move(device=device, memory_format=torch.channels_last)


def weights_bytes(tensors: dict[str, Any]) -> bytes:
    """Return a state dict of tensors as bytes that torch.load(weights_only=True) reads."""
    data = io.BytesIO()
    torch.save(tensors, data)
    return data.getvalue()


def tensors_from_bytes(data: bytes) -> dict[str, Any]:
    """Return the state dict that `weights_bytes` serialized. Raises ValueError if the bytes are damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_UNPACKED_BYTES:
                raise ValueError(f"it unpacks to more than {MAX_UNPACKED_BYTES / 2**20:.0f} MiB")
            damaged = archive.testzip()
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, OSError, RuntimeError) as error:
        raise ValueError("truncated, or not a file of tensors") from error
    if damaged:
        raise ValueError(f"its part {damaged!r:.60} does not match its checksum")
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # what torch raises for a damaged file depends on the damage; its advice is not for users
        raise ValueError("damaged, or not a file of tensors") from error
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise ValueError("it has no tensors by name")
    return state


def save_model(
    folder: str | Path,
    state: dict[str, torch.Tensor],
    config: PoseNetConfig,
    labels: Labels,
    size: int,
    provenance: dict[str, Any],
    deviation_scale: DeviationScale | None = None,
) -> None:
    """Write a model to a folder.

    Args:
        folder: Output folder.
        state: State dict of the network.
        config: Hyperparameters of the network.
        labels: Components that it predicts, and their ranges.
        size: Width of its images, px.
        provenance: Data and settings of its training, as JSON.
        deviation_scale: Factors on its standard deviations, if it estimates any.

    Raises:
        OSError: If a file cannot be written.
    """
    folder = Path(folder)
    data = weights_bytes({name: tensor.detach().cpu().contiguous() for name, tensor in state.items()})
    description = {
        "format": FORMAT,
        "version": VERSION,
        "network": dataclasses.asdict(config),
        "labels": dataclasses.asdict(labels),
        "size_px": size,
        "weights": {"file": WEIGHTS, "sha256": hashlib.sha256(data).hexdigest()},
        "provenance": provenance,
    }
    if deviation_scale is not None:
        description["deviation_scale"] = dataclasses.asdict(deviation_scale)
    # The description contains the weights' checksum, so the reader detects a kill between the two writes.
    write_file(folder / WEIGHTS, data)
    write_file(folder / DESCRIPTION, (json.dumps(with_checksum(description), indent=1) + "\n").encode())


def net_sha256(net: PoseNet) -> str:
    """Return a checksum (hex) of the weights of a network in memory."""
    return hashlib.sha256(b"".join(t.cpu().numpy().tobytes() for t in net.state_dict().values())).hexdigest()


def shipped_models() -> list[str]:
    """Return the names of the networks that are shipped with the package."""
    return sorted(path.parent.name for path in MODELS.glob(f"*/{DESCRIPTION}"))


def load_network(name: str | Path, device: str = "cpu") -> Model:
    """Load a shipped network or the model in a folder.

    Args:
        name: Name of a shipped network, or a folder.
        device: Torch device.

    Raises:
        TactipError: If there is neither, or the model is damaged; the message lists the shipped networks.
    """
    return load_model(_network_folder(name), device)


def weights_sha256(name: str | Path) -> str:
    """Return the checksum (hex) of the weights of a shipped network, or of the model in a folder, from its description.

    Raises:
        TactipError: If there is none.
    """
    return read_description(_network_folder(name))["weights"]["sha256"]


def _network_folder(name: str | Path) -> Path:
    """Return the folder of a shipped network, or the given folder. Raises TactipError if there is neither."""
    if str(name) in shipped_models():
        return MODELS / str(name)
    if not Path(name).is_dir():
        raise TactipError(
            f"{name} is neither a folder nor a shipped model: choose a folder or one of {', '.join(shipped_models())}"
        )
    return Path(name)


_MAX_SIZE_PX = 4096
"""Maximum width of a network's images, px."""


def read_description(folder: Path) -> dict[str, Any]:
    """Return the description of the model in a folder, which matches its checksum.

    Raises:
        TactipError: If there is none, it is of another version, or it was altered.
    """
    path = folder / DESCRIPTION
    if not path.exists():
        raise TactipError(f"no model in {folder}: {DESCRIPTION} is missing (training writes it after the first epoch)")
    description = read_json(path)
    if not isinstance(description, dict) or description.get("format") != FORMAT or description.get("version") != VERSION:
        raise TactipError(f"{path} must have the format {FORMAT!r}, version {VERSION}: train the model again")
    if not has_checksum(description):
        raise TactipError(f"{path} was altered: it does not match its own checksum; train again, or copy the model again")
    weights = description.get("weights")
    if not isinstance(weights, dict) or weights.get("file") != WEIGHTS or not isinstance(weights.get("sha256"), str):
        raise TactipError(f"{path}: weights must have the file {WEIGHTS} and its sha256, got {weights!r:.60}")
    if not isinstance(description.get("provenance"), dict):
        raise TactipError(f"{path}: provenance must be an object")
    return description


def load_model(folder: str | Path, device: str = "cpu") -> Model:
    """Load the model in a folder to a torch device. Raises TactipError if there is none or it is damaged."""
    folder = Path(folder)
    path, description = folder / DESCRIPTION, read_description(folder)
    config = from_dict(PoseNetConfig, description.get("network"), f"{path}: network")
    labels = from_dict(Labels, description.get("labels"), f"{path}: labels")
    size = description.get("size_px")
    if type(size) is not int or not 1 <= size <= _MAX_SIZE_PX:
        raise TactipError(f"{path}: size_px must be a whole number from 1 to {_MAX_SIZE_PX}, got {size!r:.60}")
    data = read_file(folder / WEIGHTS)
    if hashlib.sha256(data).hexdigest() != description["weights"]["sha256"]:
        raise TactipError(
            f"the weights in {folder} do not match the checksum in {path}: train again, or copy both files again"
        )
    net = PoseNet(config, size, Layout(config, labels).size)
    try:
        state = tensors_from_bytes(data)
        if not all(isinstance(tensor, torch.Tensor) and torch.isfinite(tensor).all() for tensor in state.values()):
            raise ValueError("it has something else than tensors of finite numbers")
        net.load_state_dict(state)
    except (RuntimeError, ValueError) as error:
        raise TactipError(
            f"the weights in {folder} do not match the network in {path}: {str(error).splitlines()[0]}"
        ) from error
    scale = None
    if "deviation_scale" in description:
        scale = from_dict(DeviationScale, description["deviation_scale"], f"{path}: deviation_scale")
    model = Model(to_device(net, device), config, labels, size, description["provenance"], scale)
    if scale is not None and (not config.deviations or len(scale.factors[0]) != len(model.columns)):
        raise TactipError(f"{path}: deviation_scale must have a factor for each of {', '.join(model.columns)}")
    return model
