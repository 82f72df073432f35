"""A set's layout, found from its frames (find_conventions.py), and the picture that shows on what it rests."""

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.sim2real.importing.base_pose import find_base_pose, with_tool_columns
from tactip_twin.sim2real.importing.column_map import TOOL_COLUMNS, ColumnMap
from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts, estimate_contacts
from tactip_twin.sim2real.importing.find_conventions import find_conventions, tap_of
from tactip_twin.sim2real.importing.find_tool_offset import find_tool_offset
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.importing.missing_neutral import neutral_from_frames
from tactip_twin.sim2real.importing.source import Recording, frame_reader, with_labels
from tactip_twin.sim2real.sensor.preprocess import load_neutral
from tactip_twin.tactip_model.optics import REFERENCE_PX

CONVENTIONS = "conventions.png"
"""File of the picture."""

_ARROWS = 3
"""Enlargement of the pins' motion in the picture."""


@dataclass(frozen=True)
class FoundLayout:
    """A layout, and why."""

    layout: Layout
    """The layout."""
    evidence: tuple[str, ...]
    """A sentence for each choice."""
    contacts: EstimatedContacts
    """The estimated contacts with which the table was compared."""

    def options(self) -> str:
        """Return the options of `tactip import` that give this layout without another search."""
        table, frames = self.layout.column_map, self.layout.preprocessing
        base = f" --base-pose {shlex.join(table.base_pose)}" if table.base_pose else ""
        if any(table.tool_offset_mm):
            base += f" --tool-offset-mm {' '.join(f'{x:g}' for x in table.tool_offset_mm)}"
        out = f"--task {table.task}{base} --columns {shlex.join(table.columns)} --angles {table.angles}"
        out += f" --camera-rotation-deg {table.camera_rotation_deg:g} --tcp-behind-apex-mm {table.tcp_behind_apex_mm:g}"
        if any(table.tcp_beside_axis_mm):
            out += f" --tcp-beside-axis-mm {' '.join(f'{x:g}' for x in table.tcp_beside_axis_mm)}"
        return out + (f" --rotate-image-deg {frames.rotate_image_deg:g}" if frames.rotate_image_deg else "")

    def write_picture(self, folder: Path) -> Path:
        """Write CONVENTIONS into a folder: measured and simulated motion of the pins. Return its path."""
        path = folder / CONVENTIONS
        _write_picture(self.contacts, path)
        return path


_TOOL = f"{TOOL_COLUMNS[0]} to {TOOL_COLUMNS[-1]}, in the axes of the upright tool"


def find_layout(recording: Recording, given: Layout, log: Callable[[str], object] = print) -> FoundLayout:
    """Find the layout of a set.

    Args:
        recording: The set.
        given: What is known: the task, columns, and how frames are read.
        log: Callback for messages to the user.

    Raises:
        TactipError: If the frames cannot be read, contradict a given column, or do not tell one reading from another.
    """
    base_pose = given.column_map.base_pose or find_base_pose(recording.table)
    if base_pose and not given.column_map.base_pose:
        log(f"{', '.join(base_pose)}: a pose in the frame of the robot's base (--base-pose), read as {_TOOL}")
        given = replace(given, column_map=replace(given.column_map, base_pose=base_pose))
    neutral = None if recording.neutral is None else load_neutral(recording.neutral)
    reader = frame_reader(recording, given.preprocessing, neutral)
    log("estimating the contacts of some frames from their pins")
    contacts = estimate_contacts(recording, reader, neutral, given.column_map.task)
    tap_mm = tap_of(recording.folder, log)
    found = _layout_of(recording, given, contacts, tap_mm)
    if neutral is not None:
        return found
    # The labels that were found tell where the pins are at rest, and with these, the frames tell more of the labels.
    reader = frame_reader(recording, found.layout.preprocessing, None)
    source = with_labels(_with_tool(recording, found.layout.column_map), found.layout.column_map)
    usual, task = len(contacts.at_rest_px), given.column_map.task
    image, figures = neutral_from_frames(source, contacts.rows, reader, usual, task, estimates_mechanics=False)
    if not figures["press_removed"]:
        return found
    log("estimating them again, with the pins at rest that follow from the labels found so far")
    turned = replace(given, preprocessing=found.layout.preprocessing)
    contacts = estimate_contacts(recording, reader, None, task, at_rest=reader.cropped(image))
    return _layout_of(recording, turned, contacts, tap_mm)


def _layout_of(recording: Recording, given: Layout, contacts: EstimatedContacts, tap_mm: float | None) -> FoundLayout:
    """Return the layout that agrees with estimated contacts, whose frames were read as the given layout says."""
    asked, told = given.column_map, []
    if asked.base_pose and not any(asked.tool_offset_mm):
        asked, told = find_tool_offset(recording.table, contacts, asked)
    # The columns that are read instead of a pose in the base's frame are a rotation vector, whatever that pose's angles are.
    plain = replace(asked, angles="vector") if asked.base_pose else asked
    found = find_conventions(_with_tool(recording, asked).table, contacts, plain, tap_mm)
    turned = (given.preprocessing.rotate_image_deg + found.rotate_image_deg + 180) % 360 - 180
    preprocessing = replace(given.preprocessing, rotate_image_deg=turned)
    column_map = found.column_map
    if asked.base_pose and asked.angles != "auto":
        column_map = replace(column_map, angles=asked.angles)
    return FoundLayout(Layout(column_map, preprocessing), (*told, *found.evidence), contacts)


def _with_tool(recording: Recording, column_map: ColumnMap) -> Recording:
    """Return a Recording with the columns that are read instead of a pose in the frame of a robot's base, if it has one."""
    return replace(recording, table=with_tool_columns(recording.table, column_map)) if column_map.base_pose else recording


def _write_picture(contacts: EstimatedContacts, path: Path) -> None:
    """Write a picture of six frames: how pins moved since rest, measured and as simulated for the estimated contacts."""
    order = np.argsort(contacts.poses[:, 2])
    chosen = order[np.linspace(0, len(order) - 1, 6).astype(int)]
    figure, axes = figure_of(2, 3, (9.6, 6.8))
    rest = contacts.at_rest_px
    for axis, i in zip(axes, chosen, strict=True):
        for name, pins, colour, width in (
            ("simulated", contacts.simulated_px[i], COLORS[1], 8e-3),
            ("measured", contacts.detected_px[i], COLORS[0], 3e-3),
        ):
            move = _ARROWS * (pins - rest)
            style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": width, "color": colour}
            axis.quiver(*rest.T, *move.T, label=name, **style)
        pose, shear = contacts.poses[i], contacts.shears[i]
        axis.set_title(
            f"row {contacts.rows[i]}: z {pose[2]:.1f} mm, tilt {pose[3]:.0f}°, {pose[4]:.0f}°, "
            f"shear {shear[0]:.1f}, {shear[1]:.1f} mm\n{contacts.residuals_px[i]:.2f} px apart",
            fontsize=8,
        )
        axis.set(xlim=(-16, REFERENCE_PX + 16), ylim=(REFERENCE_PX + 16, -16), aspect="equal")
        axis.axis("off")
    axes[0].legend(fontsize=8, loc="upper left")
    figure.suptitle(f"Motion of the pins since rest, {_ARROWS} times enlarged", fontsize=10)
    save_figure(figure, path)
