"""Figures that tests are held to."""

import numpy as np


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))
