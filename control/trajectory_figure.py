"""The figure of a servo run: the path on the object, colored by the error of the contact, and the errors along it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from tactip_twin.control.score import angles_to_normal_deg
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.labels import Task
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim.robot.recording import PHASES, RecordedScene
from tactip_twin.sim.view.camera_fit import fitted_camera
from tactip_twin.sim.view.geometry import ColoredMesh, object_mesh, path_meshes
from tactip_twin.sim.view.offscreen import SceneRenderer
from tactip_twin.sim.view.palette import ERROR_RAMP, LEFT_OUT_COLOR, scale_end
from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH, _HEIGHT = 1500, 1000
_MARK_M = 1e-3
"""Radius of a mark of what was left out, m."""

_FIELD_DEG = 20.0
"""Field of view of the figure, degrees: narrow, for little distortion."""

_AROUND_M = 0.06
"""Distance from the path within which the object is in view, m."""

_SCALE_BAR_M = 0.02


def write_figure(
    path: Path,
    scenery: RecordedScene,
    arrays: Mapping[str, np.ndarray],
    task: Task,
    reference_mm_deg: np.ndarray,
    towards: tuple[float, float, float] = (0.45, -0.5, 0.8),
    left_out: Sequence[np.ndarray] = (),
) -> None:
    """Render a recorded path on its object and plot the errors along it to a file.

    Args:
        path: File to write, .png.
        scenery: Scene of the recording.
        arrays: Arrays of the recording.
        task: Task of the run.
        reference_mm_deg: (6,), the label to keep, mm and degrees.
        towards: (3,), direction from the object to the eye, base frame.
        left_out: Places (n, 3), m, base frame, of each stretch that was left out, which is marked.

    Raises:
        TactipError: OpenGL cannot be used.
    """
    errors = position_errors(arrays, task, reference_mm_deg)
    largest = scale_end(errors[arrays["phase"] == PHASES.index("follow")])
    placed = object_mesh(scenery)
    places = arrays["T_base_tcp"][:, :3, 3]
    near = placed.vertices[cKDTree(places).query(placed.vertices)[0] < _AROUND_M]
    shown = near if len(near) else placed.vertices
    eye, target = fitted_camera(shown, towards, np.radians(_FIELD_DEG), _WIDTH / _HEIGHT, margin=0.04)
    meshes = [*path_meshes(arrays, errors, largest), *_left_out_meshes(left_out, placed)]
    picture = SceneRenderer(_WIDTH, _HEIGHT, [placed]).render(meshes, eye, target, _FIELD_DEG)
    figure, axes = figure_of(3, 1, (8, 8), heights=(5, 1, 1))
    _show_picture(axes[0], picture, largest, float(np.linalg.norm(eye - target)))
    axes[0].set_title("contact points, with estimated normals" + ("; black: left out" if len(left_out) else ""))
    _plot_errors(axes[1:], arrays, errors)
    save_figure(figure, path)


def position_errors(arrays: Mapping[str, np.ndarray], task: Task, reference_mm_deg: np.ndarray) -> np.ndarray:
    """Return how far the true contact is from the reference at each step, (n,) mm: in depth, and on edges also across."""
    difference = to_mm_deg(arrays["true"])[:, :3] - reference_mm_deg[:3]
    return np.linalg.norm(difference[:, [0, 2] if task == "edge" else [2]], axis=1)


def _show_picture(axis: "Axes", picture: np.ndarray, largest_mm: float, distance_m: float) -> None:
    """Show the path with a color bar and a scale bar, which holds at the distance of the object's middle."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    axis.imshow(picture, interpolation="antialiased")
    axis.axis("off")
    ramp = LinearSegmentedColormap.from_list("error", np.array(ERROR_RAMP) / 255)
    bar = axis.figure.colorbar(ScalarMappable(Normalize(0, largest_mm), ramp), ax=axis, shrink=0.8, extend="max")
    bar.set_label("distance from the commanded contact, mm")
    length = _SCALE_BAR_M * _HEIGHT / (2 * distance_m * np.tan(np.radians(_FIELD_DEG / 2)))
    left, height = 0.04 * _WIDTH, 0.95 * _HEIGHT
    axis.plot([left, left + length], [height, height], color="k", lw=2.5, solid_capstyle="butt")
    axis.text(left + length / 2, height - 15, f"{1e3 * _SCALE_BAR_M:.0f} mm", ha="center", va="bottom")


def _plot_errors(axes: "list[Axes]", arrays: Mapping[str, np.ndarray], errors_mm: np.ndarray) -> None:
    """Plot the errors of the steps that follow over the length of the path, a line for each pass."""
    following = arrays["phase"] == PHASES.index("follow")
    places, parts = arrays["T_base_tcp"][following][:, :3, 3], arrays["part"][following]
    lengths = 1e3 * np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])[: len(places)]
    rows = ((errors_mm[following], "contact, mm"), (angles_to_normal_deg(arrays["true"][following]), "normal, °"))
    for axis, (values, name) in zip(axes, rows, strict=True):
        for part in np.unique(parts):
            axis.plot(lengths[parts == part], values[parts == part], color=COLORS[0], lw=1.2)
        what, unit = name.split(", ")
        mean = f"mean {values.mean():.2f}{unit if unit == '°' else f' {unit}'}" if len(values) else "no steps"
        axis.set(ylabel=name, ylim=(0, None), title=f"error of the {what}, {mean}")
        axis.title.set_fontsize(9)
    axes[-1].set_xlabel("length of the path, mm")


def _left_out_meshes(left_out: Sequence[np.ndarray], placed: ColoredMesh) -> list[ColoredMesh]:
    """Return a mark on the object for each stretch (n, 3), m, that was left out."""
    solid = SignedDistanceMesh(placed.vertices, placed.triangles)
    places = [place for stretch in left_out for place in solid.nearest(stretch).place]
    dot = trimesh.creation.icosphere(2, _MARK_M)
    return [ColoredMesh(dot.vertices + p, dot.faces, np.asarray(dot.vertex_normals), LEFT_OUT_COLOR) for p in places]
