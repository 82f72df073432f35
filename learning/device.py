"""Device and precision of networks."""

import contextlib
from collections.abc import Iterator

import torch

from tactip_twin.learning.configuration import DeviceName, Precision, check_choice
from tactip_twin.tactip_model.errors import TactipError


def device_named(name: str) -> str:
    """Return the torch device of a DeviceName. Raises TactipError on another name, or where the machine lacks the device."""
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    check_choice("device", name, DeviceName)
    if name == "cuda" and not torch.cuda.is_available():
        raise TactipError("the device 'cuda' is asked for and this machine has none that torch can use: choose cpu or auto")
    return name


def is_half(precision: str, device: str) -> bool:
    """Return whether convolutions are computed in bfloat16.

    Args:
        precision: A Precision; `auto` chooses bfloat16 where the device is made for it.
        device: Torch device.

    Raises:
        TactipError: On another precision.
    """
    check_choice("precision", precision, Precision)
    if precision == "auto":
        return device == "cuda" or bool(torch.cpu.get_capabilities().get("amx_bf16"))
    return precision == "bfloat16"


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread of torch in a `with` block.

    It is faster for a single image, and by far where other work uses the cores: 4 instead of 176 ms on two busy cores.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
