"""Device and precision of networks."""

import contextlib
import os
from collections.abc import Iterator
from typing import Literal

import torch

from tactip_twin.learning.configuration import DeviceName, Precision, check_choice
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError


def device_named(name: DeviceName) -> Literal["cpu", "cuda"]:
    """Return the torch device of a name. Raises TactipError if the name is unknown or the machine lacks the device."""
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    check_choice("device", name, DeviceName)
    if name == "cuda" and not torch.cuda.is_available():
        raise TactipError("device 'cuda' is not available: torch finds no GPU that it can use; choose cpu or auto")
    return name


def is_half(precision: Precision, device: str) -> bool:
    """Return whether convolutions are computed in bfloat16.

    Args:
        precision: Precision; `auto` chooses bfloat16 if the device computes with it natively.
        device: Torch device.

    Raises:
        TactipError: If the precision is unknown.
    """
    check_choice("precision", precision, Precision)
    if precision == "auto":
        return device == "cuda" or bool(torch.cpu.get_capabilities().get("amx_bf16"))
    return precision == "bfloat16"


def set_threads(count: int | None) -> None:
    """Set the number of torch's threads; None keeps it. Raises TactipError unless it is from 1 to the number of cores."""
    if count is None:
        return
    cores = len(os.sched_getaffinity(0))
    require(1 <= count <= cores, "--threads", count, f"from 1 to the number of cores, {cores}")
    torch.set_num_threads(count)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread in a `with` block.

    This is faster for a single image, especially on busy cores: 4 instead of 176 ms on two of them.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
