"""The live sensor in a browser: tactile image with arrows, the predicted contact in space, and its curves."""

import math
from collections import deque

import numpy as np
import trimesh
import viser
from viser import uplot

from tactip_twin.learning.model import Model
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact
from tactip_twin.sim.view.camera_fit import beside
from tactip_twin.sim.view.curves import BAND, COMPONENT_NAMES
from tactip_twin.sim.view.geometry import ColoredMesh, sensor_meshes
from tactip_twin.sim.view.palette import ESTIMATED_COLOR, SKIN_COLOR, Color
from tactip_twin.sim.view.tactile_picture import tactile_picture
from tactip_twin.sim.view.viser_utils import (
    LOCAL,
    add_image_panel,
    add_mesh,
    covered_fraction,
    keep_in_view,
    rgb,
    serve,
    set_pose,
    stop,
)
from tactip_twin.sim2real.sensor.live import Reading
from tactip_twin.sim2real.sensor.pin_tracker import PinTracker

_PANEL_PX, _IMAGE_PX, _CURVE_PX = 400, 402, 92
"""Widths of the panel and of the window with the tactile image, and height of a curve, px."""

_HISTORY_S, _CURVES_HZ = 10.0, 5.0
"""Time that the curves show, s, and rate at which they are sent."""

_TIP_RADIUS_M = 20e-3
"""Radius at which a tip is shown, m: the sensor's own is not known."""

_PLATE_M = (0.06, 0.06, 1.5e-3)
"""Size of the plate that shows the predicted surface, m; of an edge it shows one half."""

_GOOD_COLOR: Color = (120.0, 160.0, 205.0)
_BAD_COLOR: Color = (205.0, 60.0, 50.0)
"""Colors of the plate: for estimates within the trained range from images like those in training, and for others."""

_EYE_M, _TARGET_M, _FIELD_DEG = (0.07, -0.22, 0.06), (0.0, 0.0, 0.02), 40.0

_T_WORLD_SENSOR = sensor_in_contact(np.zeros(6))


class CameraPage:
    """A page that shows each Reading."""

    def __init__(self, title: str, model: Model | None = None, host: str = LOCAL, port: int = 8080) -> None:
        """Start serving the page.

        Args:
            title: Title of the page.
            model: Network whose estimates are shown, if there is one.
            host: Address at which it is served.
            port: Its port; if it is taken, the next free one.

        Raises:
            TactipError: If it cannot be served.
        """
        self._server = serve(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        """Address of the page."""
        self._model, self._tracker, self._history = model, None, deque[tuple[float, Reading]]()
        self._sent_s = -math.inf
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        gui.set_panel_label(title)
        self._text, self._image, self._curves = gui.add_markdown("waiting for the first frame"), None, {}
        if model is not None:
            self._build_scene(edge=model.labels.task == "edge")
            tabs = gui.add_tab_group()
            with tabs.add_tab("curves"):
                gui.add_markdown(f"Over time, s; band: ± {BAND:g} standard deviations, if the network estimates them.")
                self._add_curves(dict(zip(model.columns, model.units, strict=True)))
            with tabs.add_tab("numbers"):
                self._numbers = gui.add_markdown("")

    def show(self, reading: Reading, rate: float) -> None:
        """Show a Reading, and the rate, frames per second."""
        outside = self._outside(reading)
        with self._server.atomic():
            self._text.content = _status_text(reading, rate, outside)
            self._show_image(reading)
            if self._model is not None:
                self._numbers.content = _table(reading)
                self._show_plate(self._model, reading, bad=bool(outside or reading.unlike))
        self._history.append((reading.time_s, reading))
        while self._history[0][0] < reading.time_s - _HISTORY_S:
            self._history.popleft()
        if reading.time_s > self._sent_s + 1 / _CURVES_HZ:
            self._sent_s = reading.time_s
            self._show_curves()

    def close(self) -> None:
        """Stop serving."""
        stop(self._server)

    def _show_image(self, reading: Reading) -> None:
        """Show the tactile image, with an arrow for each pin that is followed from its place at rest."""
        if self._tracker is None and len(reading.rest_px):
            self._tracker = PinTracker(reading.rest_px)
        arrows = None
        if self._tracker and len(reading.pins_px):
            arrows = np.stack([self._tracker.rest, self._tracker.track(reading.pins_px)], 1)
        if self._image is None:
            self._image = add_image_panel(self._server.gui, reading.image, with_arrows=True, width_px=_IMAGE_PX)
        self._image.image = tactile_picture(reading.image, arrows)

    def _outside(self, reading: Reading) -> list[str]:
        """Return the components of a Reading that are outside the range in which the network was trained."""
        if self._model is None:
            return []
        labels = self._model.labels
        ends = zip(labels.names, labels.low, labels.high, strict=True)
        return [n for n, low, high in ends if not low <= reading.predicted.get(n, low) <= high]

    def _build_scene(self, edge: bool) -> None:
        """Add a tip, and a plate where a contact is estimated: of an edge, the half of it that fills x < 0."""
        scene = self._server.scene
        scene.set_up_direction("+z")
        set_pose(scene.add_frame("/tip", show_axes=False), _T_WORLD_SENSOR)
        dome = trimesh.creation.icosphere(4, _TIP_RADIUS_M)
        center = np.array([0, 0, -_TIP_RADIUS_M])
        meshes = sensor_meshes(_TIP_RADIUS_M)
        meshes += [ColoredMesh(dome.vertices + center, dome.faces, dome.vertex_normals, SKIN_COLOR)]
        for n, mesh in enumerate(meshes):
            add_mesh(scene, f"/tip/{n}", mesh)
        box = trimesh.creation.box(_PLATE_M)
        box.apply_translation([-_PLATE_M[0] / 2 if edge else 0.0, 0, -_PLATE_M[2] / 2])
        self._plate = scene.add_mesh_simple("/plate", box.vertices, box.faces, color=rgb(_GOOD_COLOR), flat_shading=True)
        self._plate.opacity, self._plate.visible = 0.7, False
        self._server.on_client_connect(lambda client: keep_in_view(client, lambda: _look(client)))

    def _show_plate(self, model: Model, reading: Reading, bad: bool) -> None:
        """Show the estimated contact as a plate."""
        self._plate.visible = bool(reading.predicted)
        if reading.predicted:
            label = np.array([reading.predicted.get(f"pose_{c}", 0.0) for c in COMPONENTS])
            set_pose(self._plate, _T_WORLD_SENSOR @ inverse(sensor_in_contact(from_mm_deg(label))))
            self._plate.color = rgb(_BAD_COLOR if bad else _GOOD_COLOR)

    def _add_curves(self, units: dict[str, str]) -> None:
        """Add a chart for each component of the pose and of the force that a network estimates."""
        for name, unit in units.items():
            if not (name.startswith("pose_") or name.endswith("_N")):
                continue
            nothing = np.array([0.0])
            series = [uplot.Series(label="s"), uplot.Series(label="estimated", stroke=ESTIMATED_COLOR, width=1.5)]
            series += [uplot.Series(label=f"{sign}{BAND:g}σ", width=0) for sign in ("+", "−")]
            self._curves[name] = self._server.gui.add_uplot(
                (nothing,) * 4,
                tuple(series),
                title=f"{_shown_name(name)}, {unit}",
                bands=(uplot.Band(series=(2, 3), fill="rgba(194, 65, 12, 0.18)"),),
                scales={"x": uplot.Scale(time=False)},
                axes=(uplot.Axis(space=40, size=30), uplot.Axis(space=13)),
                legend=uplot.Legend(show=True, live=True),
                height=_CURVE_PX,
                padding=(8, 8, 0, 0),
            )

    def _show_curves(self) -> None:
        """Send the curves of the last seconds."""
        times = np.array([time for time, _ in self._history])
        with self._server.atomic():
            for name, chart in self._curves.items():
                values = np.array([r.predicted.get(name, np.nan) for _, r in self._history])
                spread = BAND * np.array([r.deviations.get(name, np.nan) for _, r in self._history])
                chart.data = (times, values, values + spread, values - spread)


def _shown_name(column: str) -> str:
    """Return the name of a column of estimates on the page."""
    return COMPONENT_NAMES.get(column.removeprefix("pose_"), column.removesuffix("_N").replace("_", " "))


def _look(client: viser.ClientHandle) -> None:
    """Show a viewer the tip, beside the tactile image."""
    camera, field = client.camera, float(np.radians(_FIELD_DEG))
    covered = covered_fraction(camera, _IMAGE_PX + 24)
    eye, target = beside(np.array(_EYE_M), np.array(_TARGET_M), field, camera.aspect, covered)
    with client.atomic():
        camera.position, camera.look_at, camera.fov = tuple(eye), tuple(target), field


def _status_text(reading: Reading, rate: float, outside: list[str]) -> str:
    """Return the text about a Reading, Markdown."""
    lines = [f"frame {reading.number}, {reading.pins} pins, {rate:.1f} frames/s"]
    lines += [f"**outside the trained range: {', '.join(outside)}**"] if outside else []
    return "\n\n".join(lines + [f"**{text}**" for text in (reading.fault, reading.unlike) if text])


def _table(reading: Reading) -> str:
    """Return the estimates of a Reading, Markdown."""
    rows = (f"| {name} | {_cell(name, value, reading.deviations.get(name))} |" for name, value in reading.predicted.items())
    return "\n".join(["| | estimated |", "|---|---|", *rows])


def _cell(name: str, value: float, deviation: float | None) -> str:
    """Return a value with its unit, and with its standard deviation if there is one."""
    unit = "°" if "_R" in name or name.endswith("_deg") else "N" if name.endswith("_N") else "mm"
    unit = "" if name in ("slip_fraction", "contact") else f" {unit}"
    return f"{value:.2f}{unit}" if deviation is None else f"{value:.2f} ± {deviation:.2f}{unit}"
