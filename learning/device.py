"""Where networks run, and how precisely."""

import contextlib

import torch

from tactip_twin.tactip_model.errors import TactipError

PRECISIONS = ("auto", "float32", "bfloat16")


def device_named(name):
    """The torch device (str) of `auto`, `cpu` or `cuda`. Raises TactipError on another name, or where there is none such."""
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name not in ("cpu", "cuda"):
        raise TactipError(f"unknown device {name!r}: choose one of auto, cpu, cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise TactipError("the device 'cuda' is asked for and this machine has none that torch can use: choose cpu or auto")
    return name


def is_half(precision, device):
    """Whether convolutions are computed in bfloat16 (bool): if asked for, and by `auto` where the device is made for it.

    precision: str of PRECISIONS. device: str. Raises TactipError on another precision.
    """
    if precision not in PRECISIONS:
        raise TactipError(f"unknown precision {precision!r}: choose one of {', '.join(PRECISIONS)}")
    if precision == "auto":
        return device == "cuda" or bool(torch.cpu.get_capabilities().get("amx_bf16"))
    return precision == "bfloat16"


@contextlib.contextmanager
def one_thread():
    """One thread for torch: a single image is read sooner so, and where other work shares the cores by far (176 ms for 4
    with two threads on two busy cores)."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
