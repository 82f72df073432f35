"""The live scene in a browser: a stimulus that is dragged, or moved by six sliders, and what the tip feels of it."""

import threading
import time

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.interactive import InteractiveContact
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, inverse, label_of, matrix, sensor_in_contact, to_mm_deg
from tactip_twin.sim.view.geometry import PORCELAIN, SKIN, body_props, sensor_props
from tactip_twin.sim.view.viser_utils import LOCAL, grey, mesh, pin_lines, place, rgb, serve, stop
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.tactile_image import tactile_image

_STEPS = 3
"""Time steps between two pictures."""

_IDLE_S = 0.03
"""How often a tip at rest looks whether it is to move, s."""

_CLEAR_MM = 3.0
"""How far off the stimulus can be asked to be, mm."""

_NAMES = ("x, mm", "y, mm", "depth, mm", "roll, deg", "pitch, deg", "yaw, deg")

_START_MM_DEG = (0.0, 0.0, -2.0, 0.0, 0.0, 0.0)

_T_WORLD_SENSOR = sensor_in_contact(np.zeros(6))
"""The sensor looks down, and its apex is the middle of the world."""


def ranges_of(name):
    """Lowest and highest label (2, 6), mm and degrees, that can be asked for on a stimulus: a task's poses and shears."""
    pose, shear = (ranges.bounds().T for ranges in (POSE_RANGES.get(name, POSE_RANGES["edge"]), SHEAR_RANGES))
    both = pose + shear
    both[1, 2] = _CLEAR_MM
    return both


class LivePage:
    """A page that shows a tip and a stimulus, and lets one move it."""

    def __init__(self, design, name, fidelity, render, read=None, host=LOCAL, port=8080):
        """design: Design. name: of stimulus.STIMULI. fidelity: Fidelity. render: function of tips and directions (p, 3) to
        a grey frame. read: function of a tactile image to a dict of what is felt by component (mm and degrees), or None.
        host: str. port: int, or the next that is free.

        Raises TactipError on what cannot be built or served.
        """
        self._press = InteractiveContact(design, name, fidelity, from_mm_deg(_START_MM_DEG))
        self._design, self._name, self._render, self._read = design, name, render, read
        self._lock = threading.RLock()
        self._wanted, self._lift, self._moved, self._said = None, False, True, ""
        self._server = serve(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        """Where the page is."""
        self._build_scene()
        self._build_panel()
        self._show(self._press.touch(), 0.0)

    def run(self, seconds=None):
        """Serve until Ctrl-C, or for some seconds."""
        end = None if seconds is None else time.monotonic() + seconds
        while end is None or time.monotonic() < end:
            self._heed()
            if self._press.at_rest and not self._moved:
                time.sleep(_IDLE_S)
                continue
            self._moved, began = False, time.perf_counter()
            try:
                touch = self._press.advance(_STEPS)
            except Diverged as error:
                self._said, self._moved = f"{error}: it was lifted", True
                self._press.lift()
                touch = self._press.touch()
            self._show(touch, time.perf_counter() - began)

    def close(self):
        """Stop serving."""
        stop(self._server)

    def _heed(self):
        """Do what the page asked for since the last time."""
        with self._lock:
            wanted, lift = self._wanted, self._lift
            self._wanted, self._lift = None, False
        if wanted is not None:
            try:
                self._press.aim(from_mm_deg(wanted))
                self._said = ""
            except TactipError as error:
                self._said = str(error)
            self._moved = True
        if lift:
            self._press.lift()
            self._moved = True

    def _show(self, touch, seconds):
        """Show a touch.TipState; the simulation of its steps took so many seconds."""
        image = tactile_image(self._render(touch.tips, touch.directions), self._design.image)
        felt = self._read(image) if self._read else {}
        with self._server.atomic():
            place(self._stimulus, _T_WORLD_SENSOR @ inverse(sensor_in_contact(self._press.label)))
            self._skin.vertices = touch.skin.astype(np.float32)
            self._pins.points = pin_lines(touch.tips, touch.directions)
            self._image.image = grey(image)
            self._told.content = self._words(touch, felt, seconds)

    def _words(self, touch, felt, seconds):
        """What is told, Markdown."""
        now = dict(zip(COMPONENTS, zip(_NAMES, to_mm_deg(self._press.label), strict=True), strict=True))
        lines = [
            f"force {np.linalg.norm(touch.force):.2f} N, of it along the axis {-touch.force[2]:.2f} N; "
            f"penetration {1e3 * touch.penetration_m:.3f} mm",
            "at rest" if self._press.at_rest else f"{1e3 * seconds / _STEPS:.0f} ms a time step",
        ]
        if felt:
            rows = [f"| {now[c][0]} | {now[c][1]:.2f} | {value:.2f} |" for c, value in felt.items()]
            lines.append("\n".join(["| | is | felt |", "|---|---|---|", *rows]))
        return "\n\n".join([*lines, f"**{self._said}**" if self._said else ""])

    def _build_scene(self):
        scene, touch = self._server.scene, self._press.touch()
        scene.set_up_direction("+z")
        scene.add_light_ambient("/lights/ambient", intensity=0.6)
        self._stimulus = scene.add_frame("/stimulus", show_axes=False)
        for n, prop in enumerate(body_props(self._press.scene.model, "stimulus", PORCELAIN)):
            mesh(scene, f"/stimulus/{n}", prop)
        tip = scene.add_frame("/tip", show_axes=False)
        place(tip, _T_WORLD_SENSOR)
        for n, prop in enumerate(sensor_props(self._design.shape.radius_m)):
            mesh(scene, f"/tip/{n}", prop)
        triangles = self._press.scene.mesh.triangles.astype(np.uint32)
        skin = touch.skin.astype(np.float32)
        self._skin = scene.add_mesh_simple("/tip/skin", skin, triangles, color=rgb(SKIN), side="double")
        pins = pin_lines(touch.tips, touch.directions)
        self._pins = scene.add_line_segments("/tip/pins", pins, (245, 245, 245), thickness=0.9e-3)
        # What is dragged is where the stimulus is to be, and it comes after.
        self._handle = scene.add_transform_controls("/wanted", scale=0.03, depth_test=False)
        self._handle.on_update(lambda event: self._dragged())
        self._look("overview", self._server.initial_camera)

    def _build_panel(self):
        gui, (low, high) = self._server.gui, ranges_of(self._name)
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.set_panel_label(f"{self._design.name}, {self._name}")
        self._sliders = []
        for name, least, most, start in zip(_NAMES, low, high, _START_MM_DEG, strict=True):
            slider = gui.add_slider(name, float(least), float(most), 0.1, start)
            slider.on_update(lambda event: event.client is not None and self._slid())
            self._sliders.append(slider)
        self._put_handle()
        does = gui.add_button_group("do", ["lift and press", "back to the start"])
        views = gui.add_button_group("look", ["overview", "close", "inside"])
        clear = gui.add_checkbox("see through the skin", False)
        self._told = gui.add_markdown("")
        self._image = gui.add_image(np.zeros((8, 8, 3), np.uint8), label="felt", format="png")
        acts = {"lift and press": self._lifted, "back to the start": self._back}
        does.on_click(lambda event: acts[event.target.value]())
        views.on_click(lambda event: event.client and self._look(event.target.value, event.client.camera))
        clear.on_update(lambda event: setattr(self._skin, "opacity", 0.35 if clear.value else None))

    def _want(self, label_mm_deg):
        with self._lock:
            self._wanted = np.array(label_mm_deg, float)

    def _slid(self):
        """A slider was moved."""
        self._want([slider.value for slider in self._sliders])
        self._put_handle()

    def _dragged(self):
        """The handle was: the sliders follow, as far as they go."""
        T = matrix(self._handle.position, Rotation.from_quat(self._handle.wxyz, scalar_first=True))
        low, high = ranges_of(self._name)
        label = np.clip(to_mm_deg(label_of(inverse(inverse(_T_WORLD_SENSOR) @ T))), low, high)
        for slider, value in zip(self._sliders, label, strict=True):
            slider.value = float(value)
        self._want(label)

    def _lifted(self):
        with self._lock:
            self._lift = True

    def _back(self):
        for slider, value in zip(self._sliders, _START_MM_DEG, strict=True):
            slider.value = value
        self._slid()
        self._lifted()

    def _put_handle(self):
        label = from_mm_deg([slider.value for slider in self._sliders])
        place(self._handle, _T_WORLD_SENSOR @ inverse(sensor_in_contact(label)))

    def _look(self, view, camera):
        """Bring a camera (viser's) to a view: overview, close or inside."""
        eye, target, field = {
            "overview": ((0.12, -0.3, 0.12), (0, 0, 0.03), 45.0),
            "close": ((0.03, -0.1, -0.015), (0, 0, 0.005), 45.0),
            "inside": ((0, 0, 0.022), (0, 0, 0), 110.0),
        }[view]
        camera.position, camera.look_at, camera.fov = eye, target, float(np.radians(field))
        if camera is not self._server.initial_camera:
            # Inside as the tactile image is: x to the right, y down.
            camera.up_direction = tuple(-_T_WORLD_SENSOR[:3, 1]) if view == "inside" else (0.0, 0.0, 1.0)
