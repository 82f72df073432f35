"""A recording as a film: the arm over the object, beside it the image that it feels, and what is felt against the truth."""

import io

import cv2
import numpy as np

from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim.view.geometry import SceneGeometry, way
from tactip_twin.sim.view.offscreen import BACKGROUND, SceneRenderer
from tactip_twin.sim.view.plot import pyplot

WIDTH, HEIGHT = 1120, 630
_VIEW = 700
"""Width of the picture of the arm; the rest is the image and the curves, px."""

_IMAGE = 256
"""Width of the tactile image, px."""

_EYE_M = (0.30, -0.44, 0.24)
"""From what is followed to the eye, m, base frame."""

_NEARER = 0.55
"""How near the eye is where no arm is to be seen, over that."""

_FIELD_DEG = 40.0

_CURVES = {
    "surface": (("depth, mm", 2), ("Rx, deg", 3), ("Ry, deg", 4)),
    "edge": (("x, mm", 0), ("depth, mm", 2), ("Rz, deg", 5)),
}
"""What is drawn over the steps, by task: its name and its component."""


def render_frames(scenery, record, arrays, every=1):
    """The pictures (h, w, 3) uint8 of a recording, one after another.

    scenery, record, arrays: of tactip_twin.sim.robot.recording. every: int, steps a picture. Raises TactipError where
    OpenGL cannot be used.
    """
    if not record["steps"]:
        return
    task = record["task"]
    stage = SceneGeometry(scenery)
    studio = SceneRenderer(_VIEW, HEIGHT, stage.still)
    curves, left, right = _curves(arrays, task)
    poses = arrays["T_base_tcp"]
    middle = (poses[:, :3, 3].min(0) + poses[:, :3, 3].max(0)) / 2 + [0, 0, 0.03]
    eye = middle + np.multiply(_EYE_M, 1.0 if scenery.with_arm else _NEARER)
    for k in range(0, len(poses), every):
        props = stage.moving(arrays["angles_rad"][k], poses[k], arrays["skin_m"][k]) + way(arrays, task, k + 1)
        frame = np.empty((HEIGHT, WIDTH, 3), np.uint8)
        frame[:] = BACKGROUND
        frame[:, :_VIEW] = studio.picture(props, eye, middle, _FIELD_DEG)
        image = arrays["images"][k]
        if image.size:
            at = _VIEW + (WIDTH - _VIEW - _IMAGE) // 2
            large = cv2.resize(image, (_IMAGE, _IMAGE), interpolation=cv2.INTER_AREA)
            frame[16 : 16 + _IMAGE, at : at + _IMAGE] = large[..., None]
        drawn = curves.copy()
        now = round(left + (right - left) * k / max(1, len(poses) - 1))
        drawn[:, now : now + 2] = (120, 120, 120)
        frame[HEIGHT - len(curves) :, _VIEW:] = drawn
        yield frame


def _curves(arrays, task):
    """What was felt and what was true over the steps: image (h, w, 3) uint8, and the columns of its first and last step."""
    plt = pyplot()
    felt, true = to_mm_deg(arrays["felt"]), to_mm_deg(arrays["true"])
    touching = arrays["touching"] > 0
    wide, high = WIDTH - _VIEW, HEIGHT - _IMAGE - 32
    names = _CURVES[task]
    figure, axes = plt.subplots(len(names), 1, figsize=(wide / 100, high / 100), dpi=100, sharex=True)
    for axis, (name, k) in zip(axes, names, strict=True):
        axis.plot(true[:, k], color="0.15", lw=1.2, label="true")
        axis.plot(felt[:, k], color="C3", lw=0.8, label="felt")
        seen = np.concatenate([true[touching, k], [-1.0, 1.0]])
        low, top = np.percentile(seen, [1, 99])
        axis.set(xlim=(0, max(1, len(felt) - 1)), ylim=(low - 0.15 * (top - low), top + 0.15 * (top - low)))
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
