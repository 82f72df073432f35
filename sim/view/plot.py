"""Matplotlib for figures in files: nothing here needs a display."""

from types import ModuleType


def pyplot() -> ModuleType:
    """Return matplotlib.pyplot with the backend for files. It is imported on the first call because that takes a while."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt
