"""A trained network in its folder and in use: weights (model.pt) and their description (model.json)."""

import contextlib
import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from tactip_twin.assets import MODELS
from tactip_twin.learning.configuration import PoseNetConfig
from tactip_twin.learning.device import one_thread
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.sim.labels import LEARNED
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file

FORMAT = "tactip-twin PoseNet"
VERSION = 1

WEIGHTS, DESCRIPTION = "model.pt", "model.json"


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
    """Data and settings of its training, JSON."""

    def predict(self, images: ArrayLike, batch: int = 256) -> np.ndarray:
        """Predict poses (n, k), mm and degrees in the order of labels.components, from images (n, size, size) uint8.

        One image (size, size) gives one pose (k,). Raises TactipError on images of another size or type.
        """
        images = np.asarray(images)
        if images.ndim == 2:
            return self.predict(images[None], batch)[0]
        if images.ndim != 3 or images.shape[1:] != (self.size, self.size) or images.dtype != np.uint8:
            raise TactipError(
                f"images of {images.dtype} {images.shape} were given: the model takes uint8 (n, {self.size}, {self.size})"
            )
        device = next(self.net.parameters()).device
        self.net.eval()
        out = []
        with torch.inference_mode(), one_thread() if len(images) == 1 else contextlib.nullcontext():
            for start in range(0, len(images), batch):
                some = torch.from_numpy(np.ascontiguousarray(images[start : start + batch])).to(device)
                out.append(self.net(to_input(some)).double().cpu().numpy())
        return np.concatenate(out) * self.labels.scale if out else np.zeros((0, len(self.labels.scale)))


def to_input(images: torch.Tensor) -> torch.Tensor:
    """Return the network's input, (n, 1, size, size) float 0 to 1, channels last, of images (n, size, size) uint8."""
    return (images[:, None].float() / 255).contiguous(memory_format=torch.channels_last)


def to_device(net: PoseNet, device: str) -> PoseNet:
    """Return a network moved to a torch device, its weights with channels last."""
    move: Callable[..., PoseNet] = net.to  # torch's annotations lack memory_format
    return move(device=device, memory_format=torch.channels_last)


def weights_bytes(tensors: dict[str, Any]) -> bytes:
    """Return a state dict of tensors as bytes that torch.load(weights_only=True) reads."""
    data = io.BytesIO()
    torch.save(tensors, data)
    return data.getvalue()


def tensors_of(data: bytes) -> dict[str, Any]:
    """Return the state dict in the bytes of `weights_bytes`. Raises ValueError where they are damaged."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError("it is cut short, or no file of tensors")
    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, KeyError) as error:
        raise ValueError(str(error).splitlines()[0]) from error


def save_model(
    folder: str | Path,
    state: dict[str, torch.Tensor],
    config: PoseNetConfig,
    labels: Labels,
    size: int,
    provenance: dict[str, Any],
) -> None:
    """Write a model to a folder.

    Args:
        folder: The folder.
        state: State dict of the network.
        config: Its hyperparameters.
        labels: Its components and their ranges.
        size: Width of its images, px.
        provenance: Data and settings of its training, JSON.

    Raises:
        OSError: Where a file cannot be written.
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
    # The description names the weights' checksum: a kill between the two is seen by the reader.
    write_file(folder / WEIGHTS, data)
    write_file(folder / DESCRIPTION, (json.dumps(description, indent=1) + "\n").encode())


def net_sha256(net: PoseNet) -> str:
    """Return a checksum (hex) of a network's weights in memory."""
    return hashlib.sha256(b"".join(t.cpu().numpy().tobytes() for t in net.state_dict().values())).hexdigest()


def shipped_models() -> list[str]:
    """Return the names of the networks that come with the package."""
    return sorted(path.parent.name for path in MODELS.glob(f"*/{DESCRIPTION}"))


def load_network(name: str | Path, device: str = "cpu") -> Model:
    """Return the model of a shipped network's name, or in a folder.

    Raises TactipError that lists the names where there is neither.
    """
    return load_model(_folder_of(name), device)


def weights_sha256(name: str | Path) -> str:
    """Return the checksum (hex) of the weights of a shipped network's name, or in a folder, as in its description.

    Raises TactipError where there is none.
    """
    path = _folder_of(name) / DESCRIPTION
    try:
        return json.loads(path.read_text())["weights"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TactipError(f"{path} cannot be used: {error!r}") from error


def _folder_of(name: str | Path) -> Path:
    """Return the folder of a network."""
    if str(name) in shipped_models():
        return MODELS / str(name)
    if not Path(name).is_dir():
        raise TactipError(f"there is no folder {name}, and no shipped model of that name: {', '.join(shipped_models())}")
    return Path(name)


def load_model(folder: str | Path, device: str = "cpu") -> Model:
    """Read a model from a folder. Raises TactipError where there is none, or a damaged one."""
    folder = Path(folder)
    path = folder / DESCRIPTION
    if not path.exists():
        raise TactipError(f"there is no model in {folder}: it has no {DESCRIPTION} (an unfinished training has none yet)")
    try:
        description = json.loads(path.read_text())
        if description.get("format") != FORMAT or description.get("version") != VERSION:
            raise TactipError(f"{path} does not describe a model of this version of the project")
        config = PoseNetConfig(**description["network"])
        given = description["labels"]
        lookup("task", given["task"], LEARNED)
        labels = Labels(given["task"], tuple(given["low"]), tuple(given["high"]))
        data = (folder / description["weights"]["file"]).read_bytes()
        size, expected = int(description["size_px"]), description["weights"]["sha256"]
    except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
        raise TactipError(f"{path} cannot be used: {error!r}") from error
    if hashlib.sha256(data).hexdigest() != expected:
        raise TactipError(f"the weights beside {path} are not those that it names: train again, or fetch both anew")
    net = PoseNet(config, size, len(labels.components))
    try:
        net.load_state_dict(tensors_of(data))
    except (RuntimeError, ValueError) as error:
        raise TactipError(f"the weights beside {path} do not fit its network: {str(error).splitlines()[0]}") from error
    return Model(to_device(net, device), config, labels, size, description.get("provenance", {}))
