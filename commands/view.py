"""tactip view: the live scene in a browser."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tactip_twin.commands._pages import serve_until_interrupted
from tactip_twin.commands._parsing import Command
from tactip_twin.commands._pose_reader import load_pose_reader
from tactip_twin.sim.dataset.object_options import ObjectOptions
from tactip_twin.sim.labels import LEARNED_FIDELITIES, TASKS, FidelityName, LearnedFidelityName
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.renderer import RendererName

if TYPE_CHECKING:
    from tactip_twin.sim.contact.solid_stimulus import SolidStimulus


@dataclass(frozen=True)
class View(Command):
    """Show a live contact in a browser: drag the stimulus or move it by sliders, and see pins, image and predicted pose."""

    example = "tactip view --task edge"

    task: Literal["surface", "edge", "sphere", "point", "needle", "knife", "corner", "hole"] = "surface"
    """Stimulus."""
    object: Annotated[ObjectOptions, tyro.conf.arg(name="")] = field(default_factory=ObjectOptions)
    """A mesh to press on instead of it, and where."""
    design: str = "tactip-127"
    """Sensor: tactip-127, tactip-331, or a design file (.json)."""
    fidelity: FidelityName | LearnedFidelityName = "standard"
    """Fidelity of the simulation; fast: predict the contact by the shipped learned tip; corrected: predict it, and let the
    simulation correct it. Both are for surface and edge."""
    model: str = ""
    """Shipped network, or folder of a training. Default: the shipped network of task and design, if there is one; none: no
    prediction."""
    renderer: RendererName = "pyrender"
    """Renderer of the pins; raster works without OpenGL."""
    host: str = "127.0.0.1"
    """Address at which the page is served; 127.0.0.1: this machine only."""
    port: int = 8080
    """Port of the page; if it is taken, the next free one."""

    def run(self) -> int:
        from tactip_twin.sim.contact.fidelity import fidelity_named
        from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
        from tactip_twin.sim.view.live_page import LivePage
        from tactip_twin.tactip_model.presets import load_design
        from tactip_twin.tactip_model.renderer import renderer_named

        design = load_design(self.design)
        render, read = renderer_named(self.renderer, design), load_pose_reader(self.model, self.task, design)
        tip, fidelity, stimulus = None, self.fidelity, self._stimulus()
        if stimulus is not None and (self.task != "surface" or fidelity in LEARNED_FIDELITIES):
            raise TactipError(f"--object needs --task surface and a simulation, got {self.task} and --fidelity {fidelity}")
        if self.fidelity in LEARNED_FIDELITIES:
            if self.task not in TASKS:
                raise TactipError(f"--fidelity {self.fidelity} is for surface and edge, got --task {self.task}")
            tip, fidelity = read_sliding_tip(shipped_sliding_tip(self.task, design.name)), "standard"
        corrected = self.fidelity == "corrected"
        arguments = design, self.task, fidelity_named(fidelity), render, read, self.host, self.port
        live = LivePage(*arguments, tip=tip, corrected=corrected, stimulus=stimulus)
        on = self.object.object or f"the stimulus {self.task}"
        print(f"{live.address} shows the tip {design.name} on {on}; stop with Ctrl-C", flush=True)
        return serve_until_interrupted(live)

    def _stimulus(self) -> "SolidStimulus | None":
        """Return the object in the contact frame of its place; None without one."""
        import numpy as np

        from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
        from tactip_twin.sim.dataset.pressed_object import PressedObject, PressPlaces

        if not self.object.object:
            if self.object != ObjectOptions():
                raise TactipError("--unit, --scale, --rotation-deg and --at-mm need an --object")
            return None
        places = PressPlaces(PressedObject(self.object.object, "", self.object.at_mm), self.object.solid(print))
        return SolidStimulus(places.sample(np.random.default_rng(0)))
