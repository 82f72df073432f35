"""Where networks run, and how precisely."""

import torch

from tactip_model.errors import TactipError

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
    """Whether convolutions are computed in bfloat16 (bool): always if asked for, and of itself on a GPU.

    precision: str of PRECISIONS. device: str. Raises TactipError on another precision.
    """
    if precision not in PRECISIONS:
        raise TactipError(f"unknown precision {precision!r}: choose one of {', '.join(PRECISIONS)}")
    return precision == "bfloat16" or (precision == "auto" and device == "cuda")
