"""A replay in a browser, by viser: arm, object, skin and pins, the tactile image, and predictions against ground truth."""

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser
from viser import uplot

from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim.robot.recording import PHASES, RecordedScene
from tactip_twin.sim.view.geometry import PATH_COLORS, SKIN_COLOR, SceneGeometry, path_lines
from tactip_twin.sim.view.playback import SPEEDS, Playback
from tactip_twin.sim.view.viser_utils import LOCAL, add_mesh, grey, penetration_text, pin_lines, rgb, serve, set_pose, stop
from tactip_twin.tactip_model.errors import TactipError

_PICTURES_HZ = 30.0
"""Rate at which moving geometry is sent while playing."""

_CURVES_HZ = 5.0
"""Rate at which the mark on the curves is sent: lower, because the curves are sent whole."""

_CURVES = (("x", 0, "mm"), ("depth", 2, "mm"), ("Rx", 3, "deg"), ("Ry", 4, "deg"), ("Rz", 5, "deg"))
"""Components that networks predict: name, index in a label, unit."""


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
        self._record, self._arrays, self._geometry = record, arrays, SceneGeometry(scenery)
        self._predicted, self._true = to_mm_deg(arrays["predicted"]), to_mm_deg(arrays["true"])
        self._deviations = to_mm_deg(arrays["deviations"])
        self._lines, self._line_counts = path_lines(arrays)
        if not len(self._lines):
            self._lines = np.zeros((1, 2, 3), np.float32)  # viser needs a line
        self.playback = Playback(record["steps"], [event["step"] for event in record["events"]])
        """State of the replay."""
        self.pictures = 0
        """Number of steps shown so far."""
        self._lock, self._shown, self._marked_s = threading.RLock(), -1, 0.0
        self._server = serve(host, port)
        self.address = f"http://{host}:{self._server.get_port()}"
        """Address of the page."""
        self._build_scene()
        self._build_panel()
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
            set_pose(self._tip, a["T_base_tcp"][k])
            self._skin.vertices = a["skin_m"][k].astype(np.float32)
            self._pins.points = pin_lines(a["pin_tips_m"][k], a["directions"][k])
            if np.isfinite(a["angles_rad"][k]).all():
                poses = self._geometry.body_poses(a["angles_rad"][k])
                for body, frame in self._links.items():
                    set_pose(frame, poses[body])
            self._path.points = self._lines[: max(1, self._line_counts[k])]
            if self._image is not None:
                self._image.image = grey(a["images"][k])
            self._status.content = self._status_text(k)
            now = time.monotonic()
            if not self.playback.playing or now - self._marked_s > 1 / _CURVES_HZ:
                self._marked_s = now
                for handle, data in self._curves:
                    handle.data = (*data, _mark(data, k))

    def _build_scene(self) -> None:
        scene, geometry = self._server.scene, self._geometry
        scene.set_up_direction("+z")
        scene.add_light_ambient("/lights/ambient", intensity=0.6)
        for name, mesh in zip(("object", "table"), geometry.static, strict=True):
            add_mesh(scene, f"/{name}", mesh)
        self._links = {}
        for body, meshes in geometry.links.items():
            self._links[body] = scene.add_frame(f"/arm/{body}", show_axes=False)
            for n, mesh in enumerate(meshes):
                add_mesh(scene, f"/arm/{body}/{n}", mesh)
        self._tip = scene.add_frame("/tip", show_axes=False)
        for n, mesh in enumerate(geometry.sensor):
            add_mesh(scene, f"/tip/{n}", mesh)
        skin = self._arrays["skin_m"][0].astype(np.float32)
        triangles = geometry.skin_triangles.astype(np.uint32)
        self._skin = scene.add_mesh_simple("/tip/skin", skin, triangles, color=rgb(SKIN_COLOR), side="double")
        pins = pin_lines(self._arrays["pin_tips_m"][0], self._arrays["directions"][0])
        self._pins = scene.add_line_segments("/tip/pins", pins, (245, 245, 245), thickness=0.9e-3)
        color = rgb(PATH_COLORS[self._record["task"]])
        self._path = scene.add_line_segments("/path", self._lines[:1], color, thickness=0.6e-3)
        self._set_view("overview", self._server.initial_camera)

    def _build_panel(self) -> None:
        gui, replay = self._server.gui, self.playback
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.set_panel_label(f"{self._record['object']}, {self._record['task']}")
        self._buttons = {"play": gui.add_button("Play")}
        self._slider = gui.add_slider("step", 0, max(1, self._record["steps"] - 1), 1, 0)
        moves = {
            "first": lambda: replay.forward(-(10**9)),
            "previous": lambda: replay.forward(-1),
            "next": lambda: replay.forward(1),
            "last": lambda: replay.forward(10**9),
            "previous event": lambda: replay.jump(-1),
            "next event": lambda: replay.jump(1),
        }
        speed = gui.add_dropdown("speed", [f"{s:g}" for s in SPEEDS], initial_value="1")
        step_buttons = gui.add_button_group("step", list(moves)[:4])
        event_buttons = gui.add_button_group("event", list(moves)[4:])
        views = gui.add_button_group("view", ["overview", "close", "inside"])
        see_through = gui.add_checkbox("transparent skin", False)
        self._status = gui.add_markdown("")
        has_images = self._arrays["images"].size > 0
        self._image = (
            gui.add_image(grey(self._arrays["images"][0]), label="tactile image", format="png") if has_images else None
        )
        self._curves = []
        steps = np.arange(self._record["steps"], dtype=float)
        for name, k, unit in _CURVES:
            if COMPONENTS[k] in LEARNED[self._record["task"]]:
                data = (steps, self._true[:, k].copy(), self._predicted[:, k].copy())
                series = [uplot.Series(label="step"), uplot.Series(label="true", stroke="black", width=2)]
                series += [uplot.Series(label="estimated", stroke="#c0392b", width=1)]
                bands = ()
                if np.isfinite(self._deviations[:, k]).any():
                    spread = _BAND * self._deviations[:, k]
                    data += (self._predicted[:, k] + spread, self._predicted[:, k] - spread)
                    series += [uplot.Series(label=label, width=0) for label in ("highest", "lowest")]
                    bands = (uplot.Band(series=(3, 4), fill="rgba(192, 57, 43, 0.2)"),)
                series += [_dot()]
                chart = gui.add_uplot(
                    (*data, _mark(data, 0)),
                    tuple(series),
                    title=f"{name}, {unit}",
                    bands=bands,
                    scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=_span(data[:3]))},
                    legend=uplot.Legend(show=False),
                    aspect=3.0,
                )
                self._curves.append((chart, data))

        def and_show(change: Callable[[], None]) -> Callable[[object], None]:
            def callback(_: object) -> None:
                with self._lock:
                    change()
                    self.show()

            return callback

        self._buttons["play"].on_click(and_show(replay.toggle))
        for buttons in (step_buttons, event_buttons):
            buttons.on_click(lambda event: and_show(moves[event.target.value])(event))
        views.on_click(lambda event: event.client and self._set_view(event.target.value, event.client.camera))
        speed.on_update(and_show(lambda: setattr(replay, "speed", float(speed.value))))
        see_through.on_update(and_show(lambda: setattr(self._skin, "opacity", 0.35 if see_through.value else None)))

        @self._slider.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # moved by the user, not by the replay
                and_show(lambda: replay.go(self._slider.value))(event)

        gui.add_command("Play or pause", hotkey="space").on_trigger(and_show(replay.toggle))
        gui.add_command("Next step", hotkey="arrowright").on_trigger(and_show(moves["next"]))
        gui.add_command("Previous step", hotkey="arrowleft").on_trigger(and_show(moves["previous"]))
        gui.add_command("First step", hotkey="home").on_trigger(and_show(moves["first"]))
        gui.add_command("Last step", hotkey="end").on_trigger(and_show(moves["last"]))
        gui.add_command("Next event", hotkey="N").on_trigger(and_show(moves["next event"]))
        gui.add_command("Previous event", hotkey="P").on_trigger(and_show(moves["previous event"]))

    def _set_view(self, view: str, camera: viser.CameraHandle | viser.InitialCameraConfig) -> None:
        """Move a camera to a view: `overview`, `close` or `inside`."""
        with self._lock:
            T = self._arrays["T_base_tcp"][self.playback.step]
            poses = self._arrays["T_base_tcp"][:, :3, 3]
        middle = (poses.min(0) + poses.max(0)) / 2
        if view == "overview":
            eye, target, field = middle + np.array([0.42, -0.6, 0.34]), middle + np.array([0, 0, 0.05]), 45.0
        elif view == "close":
            eye, target, field = T[:3, 3] + np.array([0.09, -0.14, 0.05]), T[:3, 3], 45.0
        else:
            eye, target, field = T[:3, 3] - 0.022 * T[:3, 2], T[:3, 3], 110.0
        camera.position, camera.look_at, camera.fov = tuple(eye), tuple(target), float(np.radians(field))
        if isinstance(camera, viser.CameraHandle):
            # The view from inside is oriented as the tactile image: x to the right, y down.
            camera.up_direction = tuple(-T[:3, 1]) if view == "inside" else (0.0, 0.0, 1.0)

    def _status_text(self, k: int) -> str:
        """Return the text beside the scene at a step, Markdown."""
        a = self._arrays
        seconds = 1e3 * a["seconds"][k]
        lines = [
            f"**step {k}** of {self._record['steps'] - 1}, {PHASES[int(a['phase'][k])]}{self._pass_text(k)}",
            f"force {np.linalg.norm(a['force_n'][k]):.2f} N, {penetration_text(a['penetration_m'][k])}",
            f"{seconds.sum():.0f} ms: simulation {seconds[0]:.0f}, image {seconds[1]:.0f}, network {seconds[2]:.0f}",
        ]
        events = [e for e in self._record["events"] if e["step"] == k]
        lines += [f"**{e['kind']}**: {e['what']}" for e in events]
        if k == self._record["steps"] - 1:
            lines.append(f"ended: {self._record.get('stopped_because', 'the recording is incomplete')}")
        return "\n\n".join(lines)

    def _pass_text(self, k: int) -> str:
        """Return the pass at a step that follows a route, else an empty text. The even parts of a route are its passes."""
        if PHASES[int(self._arrays["phase"][k])] != "follow":
            return ""
        number, odd = divmod(int(self._arrays["part"][k]), 2)
        count = int(self._arrays["part"].max() + 1) // 2 + 1
        return f", between passes {number + 1} and {number + 2}" if odd else f", pass {number + 1} of {count}"


_BAND = 2.0
"""Half width of the band about the estimates, in standard deviations: it contains 95 % of the true values."""


def _mark(data: tuple[np.ndarray, ...], k: int) -> np.ndarray:
    """Return the series of a curve's mark: NaN except at step k."""
    out = np.full(len(data[0]), np.nan)
    out[k] = data[1][k]
    return out


def _span(data: tuple[np.ndarray, ...]) -> tuple[float, float]:
    """Return the lowest and highest value of the curves, with a margin."""
    values = np.concatenate(data[1:])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return low - 0.05 * (high - low) - 1e-3, high + 0.05 * (high - low) + 1e-3


def _dot() -> uplot.Series:
    return uplot.Series(label="now", stroke="#2060c0", points=uplot.Series_Points(show=True, size=9))
