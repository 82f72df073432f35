"""A digital twin of the TacTip, a soft optical fingertip.

    import tactip_twin as tt

    tip = tt.TacTip("tactip-127")
    contact = tip.press("surface", depth_mm=3, roll_deg=8, shear_mm=(2, 0))
    network = tt.load_network("surface-tactip-127")
    network.predict(contact.image)

These names are the public face; everything else may move between versions. They load when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

import tactip_twin.tactip_model  # noqa: F401  (the OpenGL platform and how threads wait are chosen before anything loads)

if TYPE_CHECKING:
    from tactip_twin.control.estimator import Estimate, Estimator
    from tactip_twin.control.options import RouteOptions, ServoOptions
    from tactip_twin.control.servo import Controller
    from tactip_twin.control.servo_run import run_servo
    from tactip_twin.learning.data import read_samples
    from tactip_twin.learning.evaluate import evaluate
    from tactip_twin.learning.model import load_network
    from tactip_twin.learning.tactile_dataset import TactileDataset
    from tactip_twin.sim.contact.stimuli import Stimulus
    from tactip_twin.sim.dataset.format import read_dataset
    from tactip_twin.sim.robot.objects import load_object
    from tactip_twin.sim.robot.recording import read_recording
    from tactip_twin.sim.tactip import TactileContact, TacTip, UntrustedContact
    from tactip_twin.tactip_model.design import Design
    from tactip_twin.tactip_model.errors import TactipError
    from tactip_twin.tactip_model.presets import load_design

_HOMES = {
    "Controller": "control.servo",
    "Design": "tactip_model.design",
    "Estimate": "control.estimator",
    "Estimator": "control.estimator",
    "RouteOptions": "control.options",
    "ServoOptions": "control.options",
    "Stimulus": "sim.contact.stimuli",
    "TacTip": "sim.tactip",
    "TactileContact": "sim.tactip",
    "TactileDataset": "learning.tactile_dataset",
    "TactipError": "tactip_model.errors",
    "UntrustedContact": "sim.tactip",
    "evaluate": "learning.evaluate",
    "load_design": "tactip_model.presets",
    "load_network": "learning.model",
    "load_object": "sim.robot.objects",
    "read_dataset": "sim.dataset.format",
    "read_recording": "sim.robot.recording",
    "read_samples": "learning.data",
    "run_servo": "control.servo_run",
}
"""The module of each public name."""

__all__ = [
    "Controller",
    "Design",
    "Estimate",
    "Estimator",
    "RouteOptions",
    "ServoOptions",
    "Stimulus",
    "TacTip",
    "TactileContact",
    "TactileDataset",
    "TactipError",
    "UntrustedContact",
    "evaluate",
    "load_design",
    "load_network",
    "load_object",
    "read_dataset",
    "read_recording",
    "read_samples",
    "run_servo",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
