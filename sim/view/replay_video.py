"""A recording as video frames: the arm over the object, the tactile image, and predictions against ground truth."""

import io
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np

from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.geometry import SceneGeometry, path_meshes
from tactip_twin.sim.view.offscreen import BACKGROUND, SceneRenderer
from tactip_twin.sim.view.plot import pyplot

WIDTH, HEIGHT = 1120, 630
_VIEW = 700
"""Width of the view of the arm, px; the rest is the tactile image and the curves."""

_IMAGE = 256
"""Width of the tactile image, px."""

_EYE_M = (0.30, -0.44, 0.24)
"""Position of the eye relative to the path, m, base frame."""

_CLOSE_UP = 0.55
"""Factor on that distance without an arm, -."""

_FIELD_DEG = 40.0

_CURVES = {
    "surface": (("depth, mm", 2), ("Rx, deg", 3), ("Ry, deg", 4)),
    "edge": (("x, mm", 0), ("depth, mm", 2), ("Rz, deg", 5)),
}
"""Curves by task: title and index in a label."""


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
    task = record["task"]
    geometry = SceneGeometry(scenery)
    renderer = SceneRenderer(_VIEW, HEIGHT, geometry.static)
    curves, left, right = _curves(arrays, task)
    poses = arrays["T_base_tcp"]
    middle = (poses[:, :3, 3].min(0) + poses[:, :3, 3].max(0)) / 2 + [0, 0, 0.03]
    eye = middle + np.multiply(_EYE_M, 1.0 if scenery.with_arm else _CLOSE_UP)
    for k in range(0, len(poses), every):
        meshes = geometry.moving_meshes(arrays["angles_rad"][k], poses[k], arrays["skin_m"][k])
        meshes += path_meshes(arrays, task, k + 1)
        frame = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        frame[:] = BACKGROUND
        frame[:, :_VIEW] = renderer.render(meshes, eye, middle, _FIELD_DEG)
        image = arrays["images"][k]
        if image.size:
            left_px = _VIEW + (WIDTH - _VIEW - _IMAGE) // 2
            large = cv2.resize(image, (_IMAGE, _IMAGE), interpolation=cv2.INTER_AREA)
            frame[16 : 16 + _IMAGE, left_px : left_px + _IMAGE] = large[..., None]
        marked = curves.copy()
        now = round(left + (right - left) * k / max(1, len(poses) - 1))
        marked[:, now : now + 2] = (120, 120, 120)
        frame[HEIGHT - len(curves) :, _VIEW:] = marked
        yield frame


_BAND = 2.0
"""Half width of the band about the estimates, in standard deviations: it contains 95 % of the true values."""


def _curves(arrays: Mapping[str, np.ndarray], task: str) -> tuple[np.ndarray, float, float]:
    """Plot predictions and ground truth over the steps.

    Returns:
        Image (h, w, 3) uint8, and the columns of its first and last step, px.
    """
    plt = pyplot()
    predicted, true, deviations = (to_mm_deg(arrays[name]) for name in ("predicted", "true", "deviations"))
    touching = arrays["touching"] > 0
    wide, high = WIDTH - _VIEW, HEIGHT - _IMAGE - 32
    names = _CURVES[task]
    figure, axes = plt.subplots(len(names), 1, figsize=(wide / 100, high / 100), dpi=100, sharex=True)
    for axis, (name, k) in zip(axes, names, strict=True):
        axis.plot(true[:, k], color="0.15", lw=1.2, label="true")
        if np.isfinite(deviations[touching, k]).all():
            low, top = predicted[:, k] - _BAND * deviations[:, k], predicted[:, k] + _BAND * deviations[:, k]
            axis.fill_between(range(len(low)), low, top, where=touching, color="C3", alpha=0.2, lw=0)
        axis.plot(predicted[:, k], color="C3", lw=0.8, label="estimated")
        values = np.concatenate([true[touching, k], [-1.0, 1.0]])
        low, top = np.percentile(values, [1, 99])
        axis.set(xlim=(0, max(1, len(predicted) - 1)), ylim=(low - 0.15 * (top - low), top + 0.15 * (top - low)))
        axis.set_ylabel(name, fontsize=8)
        axis.tick_params(labelsize=7)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(fontsize=7, loc="lower right", bbox_to_anchor=(1, 0.95), frameon=False, ncol=2)
    axes[-1].set_xlabel("step", fontsize=8)
    figure.tight_layout(pad=0.6)
    data = io.BytesIO()
    figure.savefig(data, dpi=100, format="png", facecolor=tuple(c / 255 for c in BACKGROUND))
    box = axes[0].get_position()
    plt.close(figure)
    image = plt.imread(io.BytesIO(data.getvalue()), format="png")[..., :3]
    return cv2.resize((255 * image).round().astype(np.uint8), (wide, high)), box.x0 * wide, box.x1 * wide
