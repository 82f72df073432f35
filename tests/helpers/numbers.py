"""Measures that tests compare with limits."""

import numpy as np


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))
