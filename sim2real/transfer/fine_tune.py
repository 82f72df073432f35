"""Fine-tuning of a simulation-trained network on a mix of real and simulated frames, to avoid forgetting.

Half of every batch is real, shifted by up to a pixel; the other half is simulated with randomized optics. It takes few steps
at a low learning rate.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from tactip_twin.learning.augmentation import OpticsAugmentation
from tactip_twin.learning.configuration import DeviceName, TrainSettings
from tactip_twin.learning.data import Samples
from tactip_twin.learning.device import device_named
from tactip_twin.learning.model import DESCRIPTION, WEIGHTS, Model, net_sha256, read_description, save_model, to_input
from tactip_twin.learning.optics_ranges import OPTICS
from tactip_twin.learning.outputs import Layout, losses
from tactip_twin.learning.training import cosine_rate, scaled_targets
from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import Interrupted, TactipError, lookup
from tactip_twin.tactip_model.files import remove_leftovers


@dataclass(frozen=True)
class FineTuning:
    """Settings of a fine-tuning."""

    seed: int = within(0, 2**31, default=0)
    """Seed of the batches."""
    steps: int = within(1, 10**6, default=800)
    """Number of steps."""
    learning_rate: float = within(1e-7, 1, default=5e-4)
    """Maximum learning rate of Adam."""
    batch: int = within(2, 4096, default=32)
    """Images per step, half of them real."""
    shift_px: int = within(0, 8, default=1)
    """Maximum shift of a real image in any direction, px."""
    optics_ranges: str = "real"
    """Name of the ranges of optics of the simulated images (learning/optics_ranges.py)."""

    def __post_init__(self) -> None:
        check(self)
        lookup("optics_ranges", self.optics_ranges, OPTICS)


def fine_tune(
    model: Model,
    simulated: Samples,
    real: Samples,
    settings: FineTuning,
    folder: str | Path,
    device: DeviceName = "auto",
    log: Callable[[str], object] = print,
) -> None:
    """Fine-tune a network and write it to a folder. An existing network is kept.

    Args:
        model: Network to start from, left unchanged.
        simulated: Samples of simulated contacts.
        real: Samples of a real set.
        settings: Settings of the fine-tuning.
        folder: Folder to write.
        device: Device to compute on.
        log: Callback for messages to the user.

    Raises:
        TactipError: If the folder holds something else, or there are no real samples.
        Interrupted: On Ctrl-C; the same command then starts over.
    """
    folder = Path(folder)
    record = origin(model, real) | {
        "simulated": simulated.dataset.meta["digest"],
        "fine_tuning": json.loads(json.dumps(asdict(settings))),
    }
    # An interruption leaves weights without a description.
    if check_resumable(folder, "fine-tuned network", recorded(folder, record, "fine_tuning"), record, own=(WEIGHTS,)):
        log(f"{folder} already holds this network")
        return
    if not len(real):
        raise TactipError("fine-tuning needs at least 1 real frame, got 0")
    device = device_named(device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        try:
            state = _steps(model, simulated, real, settings, device)
        except KeyboardInterrupt:
            raise Interrupted("fine-tuning keeps no partial results: run the same command to start again") from None
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder)
    save_model(folder, state, model.config, model.labels, model.size, model.provenance | record, model.deviation_scale)


def origin(model: Model, real: Samples) -> dict[str, Any]:
    """Return, as JSON, the initial network and the real samples from which another network is made."""
    chosen = hashlib.sha256(real.rows.astype("<i8").tobytes()).hexdigest()
    samples = {"digest": real.dataset.meta["digest"], "samples": len(real), "chosen": chosen}
    return {"initial_weights": net_sha256(model.net), "real": samples}


def recorded(folder: Path, record: dict[str, Any], kind: str) -> dict[str, Any] | None:
    """Return what the provenance of a folder's network has for the keys of `record`; None without a network of this kind,
    whose provenance has the key `kind`."""
    if not (folder / DESCRIPTION).exists():
        return None
    provenance = read_description(folder)["provenance"]
    return {key: provenance.get(key) for key in record} if kind in provenance else None


def _steps(model: Model, simulated: Samples, real: Samples, settings: FineTuning, device: str) -> dict[str, torch.Tensor]:
    """Return the state dict of the network after the steps."""
    net, layout = model.net.to(device), Layout(model.config, model.labels)
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    augmented = OpticsAugmentation(simulated, 1.0, OPTICS[settings.optics_ranges], device)
    images = torch.from_numpy(real.images).to(device)
    targets = [
        torch.from_numpy(scaled_targets(samples, model.labels, model.config).astype(np.float32)).to(device)
        for samples in (real, simulated)
    ]
    half = settings.batch // 2
    optimizer = torch.optim.Adam(net.parameters(), lr=settings.learning_rate)
    net.train()
    for step in tqdm(range(settings.steps), unit="step", mininterval=15, leave=False):
        for group in optimizer.param_groups:
            group["lr"] = cosine_rate(settings, step, settings.steps)
        real_rows = torch.randint(len(images), (half,), device=device)
        simulated_rows = torch.randint(len(simulated), (settings.batch - half,), device=device)
        batch = torch.cat([_shifted(images[real_rows], settings.shift_px), augmented.render(simulated_rows)])
        wanted = torch.cat([targets[0][real_rows], targets[1][simulated_rows]])
        loss = losses(layout.split(net(to_input(batch))), wanted, TrainSettings().beta).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    state = {name: tensor.detach().clone() for name, tensor in net.state_dict().items()}
    net.load_state_dict(before)
    net.eval()
    return state


def _shifted(images: torch.Tensor, max_px: int) -> torch.Tensor:
    """Return images (m, n, n), each shifted at random by up to `max_px` in any direction and filled with black."""
    if not max_px:
        return images
    size = images.shape[-1]
    padded = torch.nn.functional.pad(images, (max_px,) * 4)
    places = torch.randint(2 * max_px + 1, (len(images), 2), device=images.device).tolist()
    return torch.stack([image[y : y + size, x : x + size] for image, (y, x) in zip(padded, places, strict=True)])
