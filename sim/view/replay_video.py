"""A recording as video frames: arm and object, a close view of the tip, tactile image, force and predictions."""

import io
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np

from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.camera_fit import fitted_camera
from tactip_twin.sim.view.curves import BAND, curves_of, position_errors_mm
from tactip_twin.sim.view.force_arrow import arrow_meshes, force_arrow, skin_radius_m
from tactip_twin.sim.view.geometry import ColoredMesh, SceneGeometry, object_moves, path_meshes, skin_displacements_mm
from tactip_twin.sim.view.offscreen import BACKGROUND, SceneRenderer
from tactip_twin.sim.view.palette import (
    ERROR_RAMP,
    ESTIMATED_COLOR,
    FORCE_COLOR,
    SKIN_RAMP,
    TRUE_COLOR,
    ramp_colors,
    scale_end,
)
from tactip_twin.sim.view.plot import pyplot
from tactip_twin.sim.view.tactile_picture import pin_projection, tactile_picture

WIDTH, HEIGHT = 1120, 630
_VIEW = 700
"""Width of the view of the arm, px; the rest is the tactile image and the curves."""

_IMAGE = 256
"""Width of the tactile image, px."""

_TOWARDS = (0.5, -0.75, 0.45)
"""Direction from the scene to the eye, base frame."""

_FIELD_DEG = 36.0

_FITTED = 12
"""Number of steps that the view shows as a whole, where the object moves."""

_INSET = 230
_INSET_EYE_M = (0.07, -0.13, 0.05)
_INSET_FIELD_DEG = 34.0
"""Width of the close view, px, the place of its eye relative to the tip, m, base frame, and its field of view."""

_SCALE_PX = 70
"""Length of a color scale, px."""

_CURVES = {"surface": ("force", "depth", "Rx", "Ry"), "edge": ("force", "x", "depth", "Rz")}
"""Names of the curves by task."""


def render_frames(
    scenery: RecordedScene, record: Mapping[str, Any], arrays: Mapping[str, np.ndarray], every: int = 1
) -> Iterator[np.ndarray]:
    """Render the video frames of a recording, one after another.

    Args:
        scenery: Scene of the recording.
        record: Its record (tactip_twin.sim.robot.recording.read_recording).
        arrays: Its arrays.
        every: Steps per frame.

    Yields:
        Frames (h, w, 3) uint8.

    Raises:
        TactipError: If OpenGL cannot be used.
    """
    if not record["steps"]:
        return
    task, poses = record["task"], arrays["T_base_tcp"]
    moves, project = object_moves(arrays), pin_projection(record)
    geometry = SceneGeometry(scenery, moves)
    fixed = [] if moves else [geometry.object.transformed(scenery.T_base_object)]
    renderer = SceneRenderer(_VIEW, HEIGHT, [geometry.table, *fixed])
    curves, left, right = _curves(arrays, task)
    errors, displacements = position_errors_mm(arrays, task), skin_displacements_mm(arrays)
    error_end, displacement_end = scale_end(errors), scale_end(displacements)
    extent: list[ColoredMesh] = []
    for k in np.linspace(0, len(poses) - 1, _FITTED).astype(int) if moves else [-1]:
        extent += geometry.moving_meshes(arrays["angles_rad"][k], poses[k], arrays["skin_m"][k])
        extent += [geometry.object.transformed(arrays["T_base_object"][k])]
    eye, target = fitted_camera(
        np.concatenate([mesh.vertices for mesh in extent]), _TOWARDS, np.radians(_FIELD_DEG), _VIEW / HEIGHT, left=0.18
    )
    radius_m = skin_radius_m(arrays["skin_m"][0])
    scales = _scales(displacement_end, error_end)
    for k in range(0, len(poses), every):
        colors = ramp_colors(displacements[k], displacement_end, SKIN_RAMP)
        meshes = geometry.moving_meshes(arrays["angles_rad"][k], poses[k], arrays["skin_m"][k], colors)
        if moves:
            meshes += [geometry.object.transformed(arrays["T_base_object"][k])]
        meshes += path_meshes(arrays, errors, error_end, k + 1)
        arrow = force_arrow(arrays["skin_m"][k], arrays["force_n"][k], radius_m)
        if arrow is not None:
            meshes += [mesh.transformed(poses[k]) for mesh in arrow_meshes(arrow)]
        frame = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        frame[:] = BACKGROUND
        frame[:, :_VIEW] = renderer.render(meshes, eye, target, _FIELD_DEG)
        tip = poses[k, :3, 3]
        close = renderer.render(meshes, tip + _INSET_EYE_M, tip, _INSET_FIELD_DEG)
        _paste(frame, close[:, (_VIEW - HEIGHT) // 2 :][:, :HEIGHT], 12, 12, _INSET)
        frame[HEIGHT - len(scales) - 10 : HEIGHT - 10, 12 : 12 + scales.shape[1]] = scales
        if arrays["images"][k].size:
            arrows = None if project is None else np.stack([project(arrays["pin_tips_m"][j]) for j in (0, k)], 1)
            picture = tactile_picture(arrays["images"][k], arrows)
            _paste(frame, picture, 16, _VIEW + (WIDTH - _VIEW - _IMAGE) // 2, _IMAGE)
        marked = curves.copy()
        now = round(left + (right - left) * k / max(1, len(poses) - 1))
        marked[:, now : now + 2] = (120, 120, 120)
        frame[HEIGHT - len(curves) :, _VIEW:] = marked
        yield frame


def _scales(displacement_end_mm: float, error_end_mm: float) -> np.ndarray:
    """Return a picture (h, w, 3) uint8 of what the arrow and the colors of skin and path mean."""
    rows = (
        ("skin displacement, mm", displacement_end_mm, SKIN_RAMP),
        ("position error on the path, mm", error_end_mm, ERROR_RAMP),
    )
    out = np.empty((22 * len(rows) + 22, _SCALE_PX + 200, 3), np.uint8)
    out[:] = BACKGROUND
    style = (cv2.FONT_HERSHEY_SIMPLEX, 0.36, (35, 38, 46), 1, cv2.LINE_AA)
    for n, (what, end, ramp) in enumerate(rows):
        top = 22 * n + 4
        out[top : top + 12, :_SCALE_PX] = ramp_colors(np.linspace(0, end, _SCALE_PX), end, ramp).round()
        cv2.putText(out, f"0 to {end:g}: {what}", (_SCALE_PX + 6, top + 10), *style)
    top = 22 * len(rows) + 4
    cv2.arrowedLine(out, (0, top + 6), (_SCALE_PX // 2, top + 6), tuple(map(int, FORCE_COLOR)), 2, cv2.LINE_AA, 0, 0.25)
    cv2.putText(out, "force on the tip; arrows of the pins: x 3", (_SCALE_PX + 6, top + 10), *style)
    return out


def _paste(frame: np.ndarray, picture: np.ndarray, top: int, left: int, width: int) -> None:
    """Draw a square picture into a frame, `width` px wide, with a thin border."""
    frame[top - 1 : top + width + 1, left - 1 : left + width + 1] = (150, 150, 150)
    small = cv2.resize(np.ascontiguousarray(picture), (width, width), interpolation=cv2.INTER_AREA)
    frame[top : top + width, left : left + width] = small


def _curves(arrays: Mapping[str, np.ndarray], task: str) -> tuple[np.ndarray, float, float]:
    """Plot predictions and ground truth over the steps.

    Returns:
        Image (h, w, 3) uint8, and the columns of its first and last step, px.
    """
    plt = pyplot()
    wide, high = WIDTH - _VIEW, HEIGHT - _IMAGE - 32
    by_name = {curve.name: curve for curve in curves_of(arrays, task)}
    chosen = [by_name[name] for name in _CURVES[task]]
    steps = np.arange(len(arrays["phase"]))
    figure, axes = plt.subplots(len(chosen), 1, figsize=(wide / 100, high / 100), dpi=100, sharex=True)
    for axis, curve in zip(axes, chosen, strict=True):
        axis.plot(steps, curve.true, color=TRUE_COLOR, lw=1.2, label="true")
        if curve.estimated is not None:
            if curve.deviations is not None:
                low, top = curve.estimated - BAND * curve.deviations, curve.estimated + BAND * curve.deviations
                axis.fill_between(steps, low, top, color=ESTIMATED_COLOR, alpha=0.2, lw=0)
            axis.plot(steps, curve.estimated, color=ESTIMATED_COLOR, lw=0.9, label="estimated")
        axis.set(xlim=(0, max(1, len(steps) - 1)), ylim=curve.span)
        axis.set_ylabel(f"{curve.name}, {curve.unit}", fontsize=8)
        axis.locator_params(axis="y", nbins=4)
        axis.tick_params(labelsize=7)
        axis.spines[["top", "right"]].set_visible(False)
    axes[1].legend(fontsize=7, loc="lower right", bbox_to_anchor=(1, 0.9), frameon=False, ncol=2)
    figure.align_ylabels()
    axes[-1].set_xlabel("step", fontsize=8)
    figure.tight_layout(pad=0.6)
    data = io.BytesIO()
    figure.savefig(data, dpi=100, format="png", facecolor=tuple(c / 255 for c in BACKGROUND))
    box = axes[0].get_position()
    plt.close(figure)
    image = plt.imread(io.BytesIO(data.getvalue()), format="png")[..., :3]
    return cv2.resize((255 * image).round().astype(np.uint8), (wide, high)), box.x0 * wide, box.x1 * wide
