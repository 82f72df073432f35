"""The place of a camera from which points just fill its image."""

import numpy as np
from numpy.typing import ArrayLike


def fitted_camera(
    points: np.ndarray, towards: ArrayLike, field_rad: float, aspect: float, left: float = 0.0, margin: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """Return the eye (3,) nearest to points from which an upright camera sees them all, and the point (3,) it looks at.

    Args:
        points: (n, 3) m.
        towards: (3,), direction from the points to the eye; not vertical.
        field_rad: Vertical field of view, rad.
        aspect: Width of the image over its height.
        left: Fraction of the image's width at its left that something else covers.
        margin: Fraction of the image that stays empty at each border.
    """
    back = np.asarray(towards, float) / np.linalg.norm(towards)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    x, y, z = axes @ points.T
    half = np.tan(field_rad / 2)
    # Slopes of the lines of sight at the borders: right, left, top and bottom.
    to_right, to_top = half * aspect * (1 - 2 * margin), half * (1 - 2 * margin)
    to_left = half * aspect * (1 - 2 * margin - 2 * left)
    # A point is seen if x - eye_x <= slope (eye_z - z) at the right, and likewise at the other borders.
    low_x, high_x = (x + to_right * z).max(), (x - to_left * z).min()
    low_y, high_y = (y + to_top * z).max(), (y - to_top * z).min()
    depth = max((low_x - high_x) / (to_right + to_left), (low_y - high_y) / (2 * to_top))
    middle_x = (low_x - to_right * depth + high_x + to_left * depth) / 2
    eye = axes.T @ [middle_x, (low_y + high_y) / 2, depth]
    return eye, eye - back * (depth - z.mean())


def beside(
    eye: np.ndarray, target: np.ndarray, field_rad: float, aspect: float, left: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return an eye and a target (3,) shifted so the target appears in the middle of what is not covered.

    Args:
        eye: (3,) m.
        target: (3,) m; not above or below the eye.
        field_rad: Vertical field of view, rad.
        aspect: Width of the image over its height.
        left: Fraction of the image's width at its left that something else covers.
    """
    right = np.cross(target - eye, [0.0, 0.0, 1.0])
    shift = -left * aspect * np.tan(field_rad / 2) * np.linalg.norm(target - eye) * right / np.linalg.norm(right)
    return eye + shift, target + shift
