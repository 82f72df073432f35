"""Shipped network from which the training of a network for a real sensor starts."""

import re

from tactip_twin.learning.configuration import PoseNetConfig
from tactip_twin.learning.data import Samples
from tactip_twin.learning.model import Model, load_network, shipped_models
from tactip_twin.learning.training import initial_state
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import load_design

_MAX_PIN_DIFFERENCE = 0.05
"""Largest difference of the numbers of pins, as a fraction, of a sensor and of a shipped network that its training starts
from. On 331 pins, weights for 127 pins made the tilt 0.5° worse than random ones [M]."""

_NO_START = ("surface-tactip-331",)
"""Shipped networks that no training starts from: on real-331, depth was 0.165 mm off in place of 0.120 with random weights,
because its gain became 0.85 in place of 0.91 [M]. On a hidden simulated sensor it made the tilt 0.1° better."""


def shipped_network_for(samples: Samples, pins: float, config: PoseNetConfig) -> Model | None:
    """Return the shipped network that suits a sensor best as initial weights; None if none does.

    Args:
        samples: Real set of the sensor.
        pins: Number of pins in its frames.
        config: Network to be trained.
    """
    fitting = []
    for name in shipped_models():
        found = re.fullmatch(rf"{samples.labels.task}(?:-\d+px|-any|-any-yaw)?-(tactip-\d+)", name)
        if not found or name in _NO_START:
            continue
        own = len(neutral_pins(load_design(found[1]))[0])
        if abs(own / pins - 1) > _MAX_PIN_DIFFERENCE:
            continue
        network = load_network(name)
        try:
            initial_state(network, config, samples)
        except TactipError:  # other images or layers
            continue
        fitting.append(network)
    # A network for another range of yaws comes last.
    return min(fitting, key=lambda network: network.labels.circular != samples.labels.circular, default=None)
