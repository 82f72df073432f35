"""Fine-tuning: a network of simulation goes on with some real frames among the simulated ones, so that it forgets nothing.

Half of every batch is real, shifted by a pixel or not; half is simulated under varied optics. Few steps, a small rate.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from tactip_twin.learning.augmentation import OpticsAugmentation
from tactip_twin.learning.device import device_named
from tactip_twin.learning.model import DESCRIPTION, net_sha256, save_model, to_input
from tactip_twin.learning.optics_ranges import OPTICS
from tactip_twin.learning.train import cosine_rate
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import Interrupted, TactipError, lookup


@dataclass(frozen=True)
class FineTuning:
    """How a network is fine-tuned."""

    seed: int = within(0, 2**31, default=0)
    """Seed of what is drawn."""
    steps: int = within(1, 10**6, default=800)
    """Steps in all."""
    rate: float = within(1e-7, 1, default=5e-4)
    """Greatest learning rate of Adam."""
    batch: int = within(2, 4096, default=32)
    """Images a step, half of them real."""
    shift_px: int = within(0, 8, default=1)
    """Most that a real image is shifted, to any side."""
    optics: str = "real"
    """How the simulated images vary: varied.py."""

    def __post_init__(self):
        check(self)
        lookup("optics", self.optics, OPTICS)


def fine_tune(model, simulated, real, settings, folder, device="auto", say=print):
    """Fine-tune a Model with Samples of a real set, among Samples of simulated contacts; written to a folder (path).

    settings: FineTuning. device: str. say: called with lines for the user. What is there already, alike, is left. Raises
    TactipError where the folder holds something else, and Interrupted at Ctrl-C, after which the command begins it anew.
    """
    folder = Path(folder)
    chosen = hashlib.sha256(real.rows.astype("<i8").tobytes()).hexdigest()
    record = {
        "begun_from": net_sha256(model.net),
        "real": {"digest": real.dataset.meta["digest"], "samples": len(real), "chosen": chosen},
        "simulated": simulated.dataset.meta["digest"],
        "fine_tuning": json.loads(json.dumps(asdict(settings))),
    }
    path = folder / DESCRIPTION
    if path.exists():
        there = json.loads(path.read_text())["provenance"]
        if {k: there.get(k) for k in record} != record:
            raise TactipError(f"the folder {folder} holds another network: name another one, or remove this one")
        say(f"{folder} holds this network already")
        return
    if not len(real):
        raise TactipError("there are no real frames to fine-tune with: at least 1 is needed")
    device = device_named(device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        try:
            state = _steps(model, simulated, real, settings, device)
        except KeyboardInterrupt:
            raise Interrupted("the same command begins this fine-tuning anew") from None
    folder.mkdir(parents=True, exist_ok=True)
    save_model(folder, state, model.config, model.labels, model.size, model.provenance | record)


def _steps(model, simulated, real, settings, device):
    """The state dict of the network after the steps."""
    net = model.net.to(device)
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    scale = model.labels.scale
    drawn = OpticsAugmentation(simulated, 1.0, OPTICS[settings.optics], device)
    images = torch.from_numpy(real.images).to(device)
    targets, theirs = (
        torch.from_numpy((samples.targets / scale).astype(np.float32)).to(device) for samples in (real, simulated)
    )
    half = settings.batch // 2
    optimizer = torch.optim.Adam(net.parameters(), lr=settings.rate)
    net.train()
    for step in tqdm(range(settings.steps), unit="step", mininterval=15, leave=False):
        for group in optimizer.param_groups:
            group["lr"] = cosine_rate(settings, step, settings.steps)
        mine = torch.randint(len(images), (half,), device=device)
        other = torch.randint(len(simulated), (settings.batch - half,), device=device)
        batch = torch.cat([_shifted(images[mine], settings.shift_px), drawn.draw(other)])
        wanted = torch.cat([targets[mine], theirs[other]])
        loss = (net(to_input(batch)) - wanted).square().sum(1).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    state = {name: tensor.detach().clone() for name, tensor in net.state_dict().items()}
    net.load_state_dict(before)
    net.eval()
    return state


def _shifted(images, most):
    """Images (m, n, n), each shifted by up to `most` px to a side; what comes in is black."""
    if not most:
        return images
    size = images.shape[-1]
    padded = torch.nn.functional.pad(images, (most,) * 4)
    places = torch.randint(2 * most + 1, (len(images), 2), device=images.device).tolist()
    return torch.stack([image[y : y + size, x : x + size] for image, (y, x) in zip(padded, places, strict=True)])
