"""A live simulation in a browser: the stimulus is moved by dragging or by six sliders; skin, pins and image are shown."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.interactive import InteractiveContact
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_interactive import FastInteractiveContact
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, inverse, label_of, matrix, sensor_in_contact, to_mm_deg
from tactip_twin.sim.view.camera_fit import beside
from tactip_twin.sim.view.geometry import body_meshes, sensor_meshes, solid_mesh
from tactip_twin.sim.view.palette import OBJECT_COLOR, SKIN_RAMP
from tactip_twin.sim.view.status import penetration_text
from tactip_twin.sim.view.tactile_picture import PinProjection, tactile_picture
from tactip_twin.sim.view.tip_nodes import SEE_THROUGH, SKINS, TipNodes
from tactip_twin.sim.view.viser_utils import (
    IMAGE_PANEL_PX,
    LOCAL,
    add_image_panel,
    add_mesh,
    color_scale,
    covered_fraction,
    keep_in_view,
    serve,
    set_pose,
    stop,
)
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.tactile_image import tactile_image

_STEPS_PER_UPDATE = 3
"""Time steps between two updates of the page."""

_IDLE_S = 0.03
"""Interval at which a tip at rest checks for input, s."""

_MAX_CLEARANCE_MM = 3.0
"""Largest distance from the stimulus on the slider, mm."""

_PANEL_PX = 380
"""Width of the panel, px."""

_SKIN_END_MM = 4.0
"""Displacement of the skin at the end of the color scale, mm."""

_VIEWS = {
    "overview": ((0.1, -0.25, 0.1), (0, 0, 0.025), 45.0),
    "close": ((0.03, -0.1, 0.005), (0, 0, 0.008), 45.0),
    "inside": ((0, 0, 0.022), (0, 0, 0), 110.0),
}
"""Eye, target, m, world, and field of view, degrees, of each view."""

_SLIDER_NAMES = ("x, mm", "y, mm", "depth, mm", "roll, deg", "pitch, deg", "yaw, deg")

_START_MM_DEG = (0.0, 0.0, -2.0, 0.0, 0.0, 0.0)

_T_WORLD_SENSOR = sensor_in_contact(np.zeros(6))
"""The sensor points down, and its apex is the origin of the world."""


def ranges_of(name: str) -> np.ndarray:
    """Return the lowest and highest label (2, 6), mm and degrees, on the sliders: a task's poses and shears added up."""
    pose, shear = (ranges.bounds().T for ranges in (POSE_RANGES.get(name, POSE_RANGES["edge"]), SHEAR_RANGES))
    both = pose + shear
    both[1, 2] = _MAX_CLEARANCE_MM
    return both


class LivePage:
    """A page that shows a tip and a stimulus that can be moved."""

    def __init__(
        self,
        design: Design,
        name: str,
        fidelity: Fidelity,
        render: Callable[[np.ndarray, np.ndarray], np.ndarray],
        read: Callable[[np.ndarray], Mapping[str, float]] | None = None,
        host: str = LOCAL,
        port: int = 8080,
        tip: SlidingTip | None = None,
        corrected: bool = False,
        stimulus: SolidStimulus | None = None,
    ) -> None:
        """Build the simulation and serve the page.

        Args:
            design: Design of the tip.
            name: Name of the stimulus, of stimuli.STIMULI.
            fidelity: Fidelity of the simulation.
            render: Function of pin tips and directions, (p, 3) each, to a grey frame.
            read: Function of a tactile image to the predicted label by component, mm and degrees; None without a network.
            host: Address to serve at.
            port: Port; the next free one is taken if it is in use.
            tip: Learned tip that predicts the contact, of the task `name`; None simulates it.
            corrected: Whether the simulation corrects what is predicted.
            stimulus: Object to press on instead of the stimulus `name`, whose ranges it has.

        Raises:
            TactipError: If the simulation cannot be built or the page cannot be served.
        """
        start = from_mm_deg(_START_MM_DEG)
        self._contact = InteractiveContact(design, stimulus or name, fidelity, start)
        if tip is not None:
            self._contact = FastInteractiveContact(tip, design, fidelity, start, corrected)
        self._design, self._name, self._render, self._read = design, name, render, read
        self._lock = threading.RLock()
        self._requested: np.ndarray | None = None
        self._lift_requested, self._changed, self._message = False, True, ""
        self._server = serve(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        """Address of the page."""
        self._build_scene()
        self._build_panel()
        self._handles: dict[int, viser.TransformControlsHandle] = {}
        self._views: dict[int, str] = {}
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._forget)
        self._show(self._contact.tip_state(), 0.0)

    def run(self, seconds: float | None = None) -> None:
        """Simulate and serve until Ctrl-C, or for some seconds."""
        end = None if seconds is None else time.monotonic() + seconds
        while end is None or time.monotonic() < end:
            self._on_input()
            if self._contact.at_rest and not self._changed:
                time.sleep(_IDLE_S)
                continue
            self._changed, began = False, time.perf_counter()
            try:
                state = self._contact.advance(_STEPS_PER_UPDATE)
            except Diverged as error:
                self._message, self._changed = f"{error}; the tip was lifted", True
                self._contact.lift()
                state = self._contact.tip_state()
            self._show(state, time.perf_counter() - began)

    def close(self) -> None:
        """Stop serving."""
        stop(self._server)

    def _on_input(self) -> None:
        """Apply the requests that came from the page since the last call."""
        with self._lock:
            requested, lift = self._requested, self._lift_requested
            self._requested, self._lift_requested = None, False
        if requested is not None:
            try:
                self._contact.set_target(from_mm_deg(requested))
                self._message = ""
            except TactipError as error:
                self._message = str(error)
            self._changed = True
        if lift:
            self._contact.lift()
            self._changed = True

    def _show(self, state: TipState, seconds: float) -> None:
        """Show a state of the tip, whose simulation took a number of seconds."""
        image = tactile_image(self._render(state.pin_tips, state.directions), self._design.image)
        predicted = self._read(image) if self._read else {}
        arrows = np.stack([self._rest_px, self._project(state.pin_tips)], 1)
        self._state = state
        with self._server.atomic():
            set_pose(self._stimulus, _T_WORLD_SENSOR @ inverse(sensor_in_contact(self._contact.label)))
            self._show_tip()
            self._image.image = tactile_picture(image, arrows)
            self._status.content = self._status_text(state, predicted, seconds)

    def _show_tip(self) -> None:
        """Show the tip in its last state."""
        self._tip.show(self._state.skin, self._state.pin_tips, self._state.directions, self._state.force)

    def _status_text(self, state: TipState, predicted: Mapping[str, float], seconds: float) -> str:
        """Return the text beside the scene, Markdown."""
        label = zip(_SLIDER_NAMES, to_mm_deg(self._contact.label), strict=True)
        true: dict[str, tuple[str, float]] = dict(zip(COMPONENTS, label, strict=True))
        lines = [
            f"force {np.linalg.norm(state.force):.2f} N ({-state.force[2]:.2f} N along the axis), "
            f"{penetration_text(state.penetration_m)}",
            "at rest" if self._contact.at_rest else f"{1e3 * seconds / _STEPS_PER_UPDATE:.0f} ms per time step",
        ]
        if predicted:
            rows = [f"| {true[c][0]} | {true[c][1]:.2f} | {value:.2f} |" for c, value in predicted.items()]
            lines.append("\n".join(["| | true | estimated |", "|---|---|---|", *rows]))
        return "\n\n".join([*lines, f"**{self._message}**" if self._message else ""])

    def _build_scene(self) -> None:
        scene, state = self._server.scene, self._contact.tip_state()
        scene.set_up_direction("+z")
        self._stimulus = scene.add_frame("/stimulus", show_axes=False)
        stimulus = self._contact.scene.stimulus
        solid = isinstance(stimulus, SolidStimulus)
        shown = [solid_mesh(stimulus.solid)] if solid else body_meshes(self._contact.scene.model, "stimulus", OBJECT_COLOR)
        self._surfaces = [add_mesh(scene, f"/stimulus/{n}", mesh) for n, mesh in enumerate(shown)]
        triangles = self._contact.scene.mesh.triangles
        self._tip = TipNodes(scene, sensor_meshes(self._design.shape.radius_m), triangles, state.skin, _SKIN_END_MM)
        set_pose(self._tip.frame, _T_WORLD_SENSOR)
        self._state, self._project = state, PinProjection(self._design)
        self._rest_px = self._project(state.pin_tips)

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Give a new viewer a handle, which is the target of the stimulus, and the overview."""
        handle = client.scene.add_transform_controls("/target", scale=0.03, depth_test=False)
        handle.on_update(lambda _: self._on_drag(handle))
        with self._lock:
            self._handles[client.client_id] = handle
            self._place_handles()
        keep_in_view(client, lambda: self._set_view(self._views.get(client.client_id, "overview"), client))

    def _forget(self, client: viser.ClientHandle) -> None:
        """Forget a viewer who has left."""
        with self._lock:
            self._handles.pop(client.client_id, None)
            self._views.pop(client.client_id, None)

    def _build_panel(self) -> None:
        gui, (low, high) = self._server.gui, ranges_of(self._name)
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        gui.set_panel_label(f"{self._design.name}, {self._name}")
        self._image = add_image_panel(gui, np.zeros((self._design.image.size_px,) * 2, np.uint8), with_arrows=True)
        self._sliders = []

        def on_update(event: viser.GuiEvent) -> None:
            if event.client is not None:  # moved by the user, not by the handle
                self._on_slider()

        for name, minimum, maximum, start in zip(_SLIDER_NAMES, low, high, _START_MM_DEG, strict=True):
            slider = gui.add_slider(name, float(minimum), float(maximum), 0.1, start)
            slider.on_update(on_update)
            self._sliders.append(slider)
        actions = gui.add_button_group("motion", ["lift and press", "reset"])
        views = gui.add_button_group("view", list(_VIEWS))
        skin = gui.add_dropdown("skin", SKINS)
        see_through = gui.add_checkbox("see through the stimulus", False)
        gui.add_html(color_scale("skin displacement, mm", _SKIN_END_MM, SKIN_RAMP))
        self._status = gui.add_markdown("")
        functions = {"lift and press": self._on_lift, "reset": self._on_reset}
        actions.on_click(lambda event: functions[event.target.value]())
        views.on_click(lambda event: event.client and self._set_view(event.target.value, event.client))

        @see_through.on_update
        def _(_: viser.GuiEvent) -> None:
            for surface in self._surfaces:
                surface.opacity = SEE_THROUGH if see_through.value else None

        @skin.on_update
        def _(_: viser.GuiEvent) -> None:
            self._tip.skin_style = skin.value
            self._show_tip()

    def _request(self, label_mm_deg: Sequence[float] | np.ndarray) -> None:
        """Request a label (6,), mm and degrees."""
        with self._lock:
            self._requested = np.array(label_mm_deg, float)

    def _on_slider(self) -> None:
        """Request the sliders' label, and move the handles there."""
        self._request([slider.value for slider in self._sliders])
        self._place_handles()

    def _on_drag(self, handle: viser.TransformControlsHandle) -> None:
        """Request a handle's label, within the sliders' ranges, and move the sliders and the other handles there."""
        T = matrix(handle.position, Rotation.from_quat(handle.wxyz, scalar_first=True))
        low, high = ranges_of(self._name)
        label = np.clip(to_mm_deg(label_of(inverse(inverse(_T_WORLD_SENSOR) @ T))), low, high)
        for slider, value in zip(self._sliders, label, strict=True):
            slider.value = float(value)
        self._request(label)
        self._place_handles(but=handle)

    def _on_lift(self) -> None:
        """Request a lift."""
        with self._lock:
            self._lift_requested = True

    def _on_reset(self) -> None:
        """Request the initial label and a lift."""
        for slider, value in zip(self._sliders, _START_MM_DEG, strict=True):
            slider.value = value
        self._on_slider()
        self._on_lift()

    def _place_handles(self, but: viser.TransformControlsHandle | None = None) -> None:
        """Move the handles, but one that is dragged, to the sliders' label."""
        label = from_mm_deg([slider.value for slider in self._sliders])
        with self._lock:
            others = [handle for handle in self._handles.values() if handle is not but]
        for handle in others:
            set_pose(handle, _T_WORLD_SENSOR @ inverse(sensor_in_contact(label)))

    def _set_view(self, view: str, client: viser.ClientHandle) -> None:
        """Move a viewer's camera to a view: `overview`, `close` or `inside`."""
        self._views[client.client_id] = view
        eye, target, field_deg = _VIEWS[view]
        camera, field = client.camera, float(np.radians(field_deg))
        if view != "inside":
            covered = covered_fraction(camera, IMAGE_PANEL_PX)
            eye, target = beside(np.array(eye), np.array(target), field, camera.aspect, covered)
        # From inside, the handle would cover the pins.
        self._handles[client.client_id].visible = view != "inside"
        with client.atomic():
            camera.position, camera.look_at, camera.fov = tuple(eye), tuple(target), field
            # The view from inside is oriented as the tactile image: x to the right, y down.
            camera.up_direction = tuple(-_T_WORLD_SENSOR[:3, 1]) if view == "inside" else (0.0, 0.0, 1.0)
