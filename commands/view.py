"""tactip view: the live scene in a browser."""

from dataclasses import dataclass
from typing import Literal

from tactip_twin.commands._pages import serve_until_interrupted
from tactip_twin.commands._parsing import Command
from tactip_twin.commands._pose_reader import load_pose_reader
from tactip_twin.sim.labels import FidelityName
from tactip_twin.tactip_model.renderer import RendererName


@dataclass(frozen=True)
class View(Command):
    """Show a live contact in a browser: drag the stimulus or move it by sliders, and see pins, image and predicted pose."""

    example = "tactip view --task edge"

    task: Literal["surface", "edge", "sphere", "point", "needle", "knife", "corner", "hole"] = "surface"
    """Stimulus."""
    design: str = "tactip-127"
    """Sensor: tactip-127, tactip-331, or a design file (.json)."""
    fidelity: FidelityName = "standard"
    """Fidelity of the simulation."""
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
        from tactip_twin.sim.view.live_page import LivePage
        from tactip_twin.tactip_model.presets import load_design
        from tactip_twin.tactip_model.renderer import renderer_named

        design = load_design(self.design)
        render, read = renderer_named(self.renderer, design), load_pose_reader(self.model, self.task, design)
        live = LivePage(design, self.task, fidelity_named(self.fidelity), render, read, self.host, self.port)
        print(f"{live.address} shows the tip {design.name} on the stimulus {self.task}; stop with Ctrl-C", flush=True)
        return serve_until_interrupted(live)
