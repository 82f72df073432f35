"""A replay in a browser, by viser: arm, object, skin and pins, the tactile image, and predictions against ground truth."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from viser import uplot

from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.camera_fit import beside, fitted_camera
from tactip_twin.sim.view.curves import BAND, Curve, curves_of, position_errors_mm
from tactip_twin.sim.view.follow_camera import FollowCamera
from tactip_twin.sim.view.geometry import (
    SceneGeometry,
    nearest_to_ray,
    object_moves,
    path_lines,
    predicted_frames,
    skin_displacements_mm,
)
from tactip_twin.sim.view.palette import ERROR_RAMP, ESTIMATED_COLOR, SKIN_RAMP, TRUE_COLOR, scale_end
from tactip_twin.sim.view.playback import SPEEDS, Playback
from tactip_twin.sim.view.status import status_lines
from tactip_twin.sim.view.tactile_picture import pin_projection, tactile_picture
from tactip_twin.sim.view.tip_nodes import SEE_THROUGH, SKINS, TipNodes
from tactip_twin.sim.view.viser_utils import (
    IMAGE_PANEL_PX,
    LOCAL,
    add_image_panel,
    add_mesh,
    color_scale,
    covered_fraction,
    keep_in_view,
    line_colors,
    serve,
    set_pose,
    stop,
)
from tactip_twin.tactip_model.errors import TactipError

_PICTURES_HZ = 30.0
"""Rate at which moving geometry is sent while playing."""

_CURVES_HZ = 5.0
"""Rate at which the mark on the curves is sent: lower, because the curves are sent whole."""

_PANEL_PX = 424
"""Width of the panel, px."""

_CURVE_PX = 104
"""Height of a curve, px."""

_FIELD_DEG = 40.0
_TOWARDS = (0.5, -0.75, 0.45)
"""Field of view of the overview, degrees, and the direction from the scene to its eye, base frame."""

_CLOSE_M = (0.07, -0.13, 0.04)
"""Place of the eye of the close view relative to the tip, m, base frame."""

_VIEWS = ("overview", "close", "inside")

_CLICKS = "A click on the path goes back to its step."
_KEYS = "Keys: **space** play or pause, **← →** one step, **Home End** first and last step"
_EVENT_KEYS = ", **N P** next and previous event"

_CLICK_DEG = 1.5
"""Angle, degrees, from which a click counts as beside the path: 30 px in the overview on a screen of 900 px."""

_INSIDE_M, _INSIDE_FIELD_DEG = 0.022, 110.0
"""Distance of the eye of the view from inside from the apex, m, and its field of view, degrees."""


@dataclass
class _Viewer:
    """One who looks at the page."""

    client: viser.ClientHandle
    camera: FollowCamera
    path: viser.LineSegmentsHandle
    """The path, which other viewers may see while this one does not."""
    view: str = "overview"
    """One of _VIEWS."""


class ReplayPage:
    """A page that shows one recording."""

    def __init__(
        self,
        record: Mapping[str, Any],
        arrays: Mapping[str, np.ndarray],
        scenery: RecordedScene,
        host: str = LOCAL,
        port: int = 8080,
    ) -> None:
        """Serve the page.

        Args:
            record: Record of the recording (tactip_twin.sim.robot.recording.read_recording).
            arrays: Its arrays.
            scenery: Its scene.
            host: Address to serve at.
            port: Port; the next free one is taken if it is in use.

        Raises:
            TactipError: If there is no step to show, or the page cannot be served.
        """
        if not record["steps"]:
            raise TactipError("the recording has no steps to show")
        self._record, self._arrays = record, arrays
        self._geometry = SceneGeometry(scenery, object_moves(arrays))
        self._skin_end_mm = scale_end(skin_displacements_mm(arrays))
        errors = position_errors_mm(arrays, record["task"])
        self._error_end_mm = scale_end(errors)
        self._lines, colors, self._line_counts = path_lines(arrays, errors, self._error_end_mm)
        self._line_colors = line_colors(colors)
        frames, self._path_steps = predicted_frames(arrays)
        self._path_places = frames[:, :3, 3]
        if not len(self._lines):  # viser needs a line
            self._lines, self._line_colors = np.zeros((1, 2, 3), np.float32), np.zeros((1, 2, 3), np.uint8)
        self._project = pin_projection(record)
        self.playback = Playback(record["steps"], [event["step"] for event in record["events"]])
        """State of the replay."""
        self.pictures = 0
        """Number of steps shown so far."""
        self._lock, self._shown, self._marked_s = threading.RLock(), -1, 0.0
        self._viewers: dict[int, _Viewer] = {}
        self._server = serve(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        """Address of the page."""
        self._build_scene()
        self._build_panel()
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._forget)
        self.show()

    def run(self, seconds: float | None = None) -> None:
        """Serve until Ctrl-C, or for some seconds."""
        end = None if seconds is None else time.monotonic() + seconds
        while end is None or time.monotonic() < end:
            began = time.monotonic()
            with self._lock:
                playing = self.playback.playing
                self.playback.tick(began)
                if playing:
                    self.show()
            time.sleep(max(0.001, 1 / _PICTURES_HZ - (time.monotonic() - began)))

    def close(self) -> None:
        """Stop serving."""
        stop(self._server)

    def show(self) -> None:
        """Show the current step of the replay."""
        with self._lock, self._server.atomic():
            k, a = self.playback.step, self._arrays
            self._buttons["play"].label = "Pause" if self.playback.playing else "Play"
            if k == self._shown:
                return
            self._shown, self.pictures = k, self.pictures + 1
            self._slider.value = k
            set_pose(self._tip.frame, a["T_base_tcp"][k])
            set_pose(self._object_frame, a["T_base_object"][k])
            self._show_tip()
            if np.isfinite(a["angles_rad"][k]).all():
                poses = self._geometry.body_poses(a["angles_rad"][k])
                for body, frame in self._links.items():
                    set_pose(frame, poses[body])
            for viewer in self._viewers.values():
                viewer.path.points, viewer.path.colors = self._path()
            self._show_image()
            first, *others = status_lines(self._record, a, k)
            self._status.content = "  \n".join([f"**{first}**", *others])
            self._follow()
            now = time.monotonic()
            if not self.playback.playing or now - self._marked_s > 1 / _CURVES_HZ:
                self._marked_s = now
                for handle, data in self._curves:
                    handle.data = (*data, _mark(data, k))

    def _path(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lines of the path up to the step that is shown, (n, 2, 3) m, and their colors."""
        count = max(1, self._line_counts[max(0, self._shown)])
        return self._lines[:count], self._line_colors[:count]

    def _go_to_click(self, event: viser.SceneClickEvent) -> None:
        """Go to the step of the path that a viewer has clicked on."""
        with self._lock:
            viewer = self._viewers.get(event.client_id)
            if viewer is None or not viewer.path.visible:
                return
            seen = self._path_places[self._path_steps <= self._shown]
            k = nearest_to_ray(seen, event.ray_origin, event.ray_direction, np.radians(_CLICK_DEG))
            if k is not None:
                self.playback.go(int(self._path_steps[k]))
                self.show()

    def _show_tip(self) -> None:
        """Show the tip at the step that is shown."""
        k, a = self._shown, self._arrays
        self._tip.show(a["skin_m"][k], a["pin_tips_m"][k], a["directions"][k], a["force_n"][k])

    def _show_image(self) -> None:
        """Show the tactile image at the step that is shown."""
        if self._image is not None:
            k, tips = self._shown, self._arrays["pin_tips_m"]
            arrows = None
            if self._project and self._arrows.value:
                arrows = np.stack([self._project(tips[0]), self._project(tips[k])], 1)
            self._image.image = tactile_picture(self._arrays["images"][k], arrows)

    def _build_scene(self) -> None:
        scene, geometry, skin = self._server.scene, self._geometry, self._arrays["skin_m"][0]
        scene.set_up_direction("+z")
        add_mesh(scene, "/table", geometry.table)
        self._object_frame = scene.add_frame("/object", show_axes=False)
        self._object = add_mesh(scene, "/object/mesh", geometry.object)
        self._links = {}
        for body, meshes in geometry.links.items():
            self._links[body] = scene.add_frame(f"/arm/{body}", show_axes=False)
            for n, mesh in enumerate(meshes):
                add_mesh(scene, f"/arm/{body}/{n}", mesh)
        self._tip = TipNodes(scene, geometry.sensor, geometry.skin_triangles, skin, self._skin_end_mm)
        scene.on_click()(self._go_to_click)

    def _build_panel(self) -> None:
        gui, replay, record = self._server.gui, self.playback, self._record
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        gui.set_panel_label(f"{record['object']}, {record['task']}")
        has_images = self._arrays["images"].size > 0
        self._image = add_image_panel(gui, self._arrays["images"][0], self._project is not None) if has_images else None
        self._buttons = {"play": gui.add_button("Play")}
        self._slider = gui.add_slider("step", 0, max(1, record["steps"] - 1), 1, 0)
        moves = {
            "first": lambda: replay.forward(-(10**9)),
            "previous": lambda: replay.forward(-1),
            "next": lambda: replay.forward(1),
            "last": lambda: replay.forward(10**9),
            "previous event": lambda: replay.jump(-1),
            "next event": lambda: replay.jump(1),
        }
        step_buttons = gui.add_button_group("step", list(moves)[:4])
        event_buttons = gui.add_button_group("event", list(moves)[4:], visible=bool(record["events"]))
        views = gui.add_button_group("view", _VIEWS)
        # Its number of lines changes, and what is above it stays where it is.
        self._status = gui.add_markdown("")
        gui.add_html(color_scale("skin displacement, mm", self._skin_end_mm, SKIN_RAMP))
        gui.add_html(color_scale("position error on the path, mm", self._error_end_mm, ERROR_RAMP))
        tabs = gui.add_tab_group()
        with tabs.add_tab("curves"):
            self._add_curves()
        with tabs.add_tab("settings and keys"):
            skin = gui.add_dropdown("skin", SKINS)
            see_through = gui.add_checkbox("see through the object", False)
            speed = gui.add_dropdown("speed", [f"{s:g}" for s in SPEEDS], initial_value="1")
            self._follows = gui.add_checkbox("camera follows the tip", True)
            self._arrows = gui.add_checkbox("arrows on the image", True, visible=self._project is not None)
            gui.add_markdown(f"{_CLICKS} {_KEYS}{_EVENT_KEYS if record['events'] else ''}.")

        self._buttons["play"].on_click(self._then_show(replay.toggle))
        for buttons in (step_buttons, event_buttons):
            buttons.on_click(lambda event: self._then_show(moves[event.target.value])(event))
        views.on_click(lambda event: event.client and self._set_view(event.target.value, event.client))
        speed.on_update(self._then_show(lambda: setattr(replay, "speed", float(speed.value))))
        self._arrows.on_update(self._then_show(self._show_image))
        see_through.on_update(lambda _: setattr(self._object, "opacity", SEE_THROUGH if see_through.value else None))

        @skin.on_update
        def _(_: viser.GuiEvent) -> None:
            with self._lock:
                self._tip.skin_style = skin.value
                self._show_tip()

        @self._slider.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # moved by the user, not by the replay
                self._then_show(lambda: replay.go(self._slider.value))(event)

        self._add_keys(moves)

    def _then_show(self, change: Callable[[], None]) -> Callable[[object], None]:
        """Return a callback that makes a change and shows it."""

        def callback(_: object) -> None:
            with self._lock:
                change()
                self.show()

        return callback

    def _add_keys(self, moves: Mapping[str, Callable[[], None]]) -> None:
        """Bind keys to playing and to moves by name."""
        gui = self._server.gui
        gui.add_command("Play or pause", hotkey="space").on_trigger(self._then_show(self.playback.toggle))
        gui.add_command("Next step", hotkey="arrowright").on_trigger(self._then_show(moves["next"]))
        gui.add_command("Previous step", hotkey="arrowleft").on_trigger(self._then_show(moves["previous"]))
        gui.add_command("First step", hotkey="home").on_trigger(self._then_show(moves["first"]))
        gui.add_command("Last step", hotkey="end").on_trigger(self._then_show(moves["last"]))
        gui.add_command("Next event", hotkey="N").on_trigger(self._then_show(moves["next event"]))
        gui.add_command("Previous event", hotkey="P").on_trigger(self._then_show(moves["previous event"]))

    def _add_curves(self) -> None:
        """Add a chart for each curve."""
        self._curves = []
        steps = np.arange(self._record["steps"], dtype=float)
        for curve in curves_of(self._arrays, self._record["task"]):
            data, series, bands = _chart(steps, curve)
            chart = self._server.gui.add_uplot(
                (*data, _mark(data, 0)),
                (*series, _dot()),
                title=f"{curve.name}, {curve.unit}",
                bands=bands,
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=curve.span)},
                axes=(uplot.Axis(space=40, size=30), uplot.Axis(space=13)),
                legend=uplot.Legend(show=True, live=True),
                height=_CURVE_PX,
            )
            self._curves.append((chart, data))

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Show a new viewer the overview."""
        with self._lock:
            path = client.scene.add_line_segments("/path", *self._path(), thickness=0.8e-3)
            viewer = self._viewers[client.client_id] = _Viewer(client, FollowCamera(client.camera), path)

        def look() -> None:
            if viewer.view != "inside":
                self._set_view(viewer.view, client)

        keep_in_view(client, look)

    def _forget(self, client: viser.ClientHandle) -> None:
        """Forget a viewer who has left."""
        with self._lock:
            self._viewers.pop(client.client_id, None)

    def _set_view(self, view: str, client: viser.ClientHandle) -> None:
        """Move a viewer's camera to one of _VIEWS."""
        with self._lock:
            viewer, T = self._viewers[client.client_id], self._arrays["T_base_tcp"][max(0, self._shown)]
        viewer.view, viewer.path.visible = view, view != "inside"  # it would cover the pins
        if view == "inside":
            _look_inside(client, T)
            return
        field, camera = np.radians(_FIELD_DEG), client.camera
        covered = covered_fraction(camera, IMAGE_PANEL_PX) if self._image is not None else 0.0
        if view == "overview":
            eye, target = fitted_camera(self._extent(), _TOWARDS, field, camera.aspect, covered)
        else:
            eye, target = beside(T[:3, 3] + _CLOSE_M, T[:3, 3], field, camera.aspect, covered)
        with client.atomic():
            camera.position, camera.look_at, camera.fov = tuple(eye), tuple(target), float(field)
            camera.up_direction = (0.0, 0.0, 1.0)
        with self._lock:
            viewer.camera.start(eye, target, T[:3, 3])

    def _extent(self) -> np.ndarray:
        """Return points (n, 3) m that the overview shows: the object and the arm at the step that is shown."""
        k, a, geometry = max(0, self._shown), self._arrays, self._geometry
        meshes = geometry.moving_meshes(a["angles_rad"][k], a["T_base_tcp"][k], a["skin_m"][0])
        meshes += [geometry.object.transformed(a["T_base_object"][k])]
        return np.concatenate([mesh.vertices for mesh in meshes])

    def _follow(self) -> None:
        """Move the cameras of viewers who look at the tip with it."""
        if self._follows.value:
            T = self._arrays["T_base_tcp"][self._shown]
            for viewer in self._viewers.values():
                if viewer.view == "close":
                    viewer.camera.follow(T[:3, 3])
                elif viewer.view == "inside":
                    _look_inside(viewer.client, T)


def _look_inside(client: viser.ClientHandle, T_base_tcp: np.ndarray) -> None:
    """Look at the pins from inside the tip at a pose (4, 4), oriented as the tactile image: x to the right, y down."""
    camera, apex = client.camera, T_base_tcp[:3, 3]
    with client.atomic():
        camera.position, camera.look_at = tuple(apex - _INSIDE_M * T_base_tcp[:3, 2]), tuple(apex)
        camera.up_direction, camera.fov = tuple(-T_base_tcp[:3, 1]), float(np.radians(_INSIDE_FIELD_DEG))


def _chart(steps: np.ndarray, curve: Curve) -> tuple[tuple[np.ndarray, ...], list[uplot.Series], tuple[uplot.Band, ...]]:
    """Return the data, series and bands of a curve's chart."""
    data: tuple[np.ndarray, ...] = (steps, curve.true)
    first = curve.name if curve.estimated is None else "true"
    series = [uplot.Series(label="step"), uplot.Series(label=first, stroke=TRUE_COLOR, width=2)]
    if curve.estimated is None:
        return data, series, ()
    data, series = (*data, curve.estimated), [*series, uplot.Series(label="estimated", stroke=ESTIMATED_COLOR, width=1.5)]
    if curve.deviations is None:
        return data, series, ()
    spread = BAND * curve.deviations
    series += [uplot.Series(label=f"{sign}{BAND:g}σ", width=0) for sign in ("+", "−")]
    bands = (uplot.Band(series=(3, 4), fill="rgba(194, 65, 12, 0.18)"),)
    return (*data, curve.estimated + spread, curve.estimated - spread), series, bands


def _mark(data: tuple[np.ndarray, ...], k: int) -> np.ndarray:
    """Return the series of a curve's mark: NaN except at step k."""
    out = np.full(len(data[0]), np.nan)
    out[k] = data[1][k]
    return out


def _dot() -> uplot.Series:
    return uplot.Series(label="now", stroke="#2060c0", points=uplot.Series_Points(show=True, size=9))
