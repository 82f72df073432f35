"""A trained network on disk and in use: weights (model.pt) and what they are for (model.json)."""

import contextlib
import dataclasses
import hashlib
import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

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
    """What it was built by."""
    labels: Labels
    """The components that it tells, and their ranges."""
    size: int
    """Width of its images, px."""
    provenance: dict
    """What it was trained on and how, JSON."""

    def predict(self, images, batch=256):
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


def to_input(images):
    """What the network takes, (n, 1, size, size) float 0 to 1 in channels-last order, of uint8 images (n, size, size)."""
    return (images[:, None].float() / 255).contiguous(memory_format=torch.channels_last)


def weights_bytes(tensors):
    """A state dict of tensors as bytes that torch.load(weights_only=True) reads."""
    data = io.BytesIO()
    torch.save(tensors, data)
    return data.getvalue()


def tensors_of(data):
    """The tensors that weights_bytes made bytes of. Raises ValueError where they are damaged."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError("it is cut short, or no file of tensors")
    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, KeyError) as error:
        raise ValueError(str(error).splitlines()[0]) from error


def save_model(folder, state, config, labels, size, provenance):
    """Write a model. folder: path. state: the net's state dict. The rest: as of Model. Raises OSError."""
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


def net_sha256(net):
    """Checksum (str) of a network's weights as they are in memory."""
    return hashlib.sha256(b"".join(t.cpu().numpy().tobytes() for t in net.state_dict().values())).hexdigest()


def shipped_models():
    """Names (list of str) of the networks that come with the package."""
    return sorted(path.parent.name for path in MODELS.glob(f"*/{DESCRIPTION}"))


def load_network(name, device="cpu"):
    """The Model of a shipped network's name, or in a folder.

    Raises TactipError that lists the names where there is neither.
    """
    return load_model(_folder_of(name), device)


def weights_sha256(name):
    """Checksum (str) of the weights of a shipped network's name, or in a folder, as its description has it.

    Raises TactipError where there is none.
    """
    path = _folder_of(name) / DESCRIPTION
    try:
        return json.loads(path.read_text())["weights"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TactipError(f"{path} cannot be used: {error!r}") from error


def _folder_of(name):
    """The folder (Path) of a network."""
    if str(name) in shipped_models():
        return MODELS / str(name)
    if not Path(name).is_dir():
        raise TactipError(f"there is no folder {name}, and no shipped model of that name: {', '.join(shipped_models())}")
    return Path(name)


def load_model(folder, device="cpu"):
    """Read a Model from a folder. Raises TactipError where there is none, or a damaged one."""
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
    net = net.to(device=device, memory_format=torch.channels_last)
    return Model(net, config, labels, size, description.get("provenance", {}))
