"""A replay as one HTML file that needs neither a server nor a network: scene, tactile image and curves, with its own player.

The file holds a description (JSON) and the arrays that it names (zlib, base64); replay.html is the page around them.
"""

import base64
import json
import zlib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.curves import BAND, Curve, curves_of, position_errors_mm
from tactip_twin.sim.view.geometry import ColoredMesh, SceneGeometry, object_moves, path_lines, skin_displacements_mm
from tactip_twin.sim.view.palette import (
    ERROR_RAMP,
    ESTIMATED_COLOR,
    FORCE_COLOR,
    PIN_COLOR,
    SKIN_RAMP,
    TRUE_COLOR,
    scale_end,
)
from tactip_twin.sim.view.status import status_lines
from tactip_twin.sim.view.tactile_picture import pin_projection
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

MAX_BYTES = 20 * 10**6
"""Maximum size of a file, bytes: what can still be sent by mail."""

_UNIT_M = 2e-6
"""Unit of the coordinates of skin and pins, m: 16 bits reach over 65 mm from the apex."""

_UNIT_PX = 1 / 64
"""Unit of the places of pins on the image, px."""


def write_replay_html(
    path: Path, record: Mapping[str, Any], arrays: Mapping[str, np.ndarray], scenery: RecordedScene, stride: int = 1
) -> None:
    """Write a recording as a page.

    Args:
        path: File to write, .html.
        record: Record of the recording (tactip_twin.sim.robot.recording.read_recording).
        arrays: Its arrays.
        scenery: Its scene.
        stride: Steps of the recording per step of the page. The last step is always on it.

    Raises:
        TactipError: If there is no step to show, or the file would be larger than MAX_BYTES.
    """
    page = replay_html(record, arrays, scenery, stride).encode()
    if len(page) > MAX_BYTES:
        raise TactipError(
            f"the page must be at most {MAX_BYTES / 1e6:g} MB, got {len(page) / 1e6:.1f} MB: give --stride {2 * stride}"
        )
    write_file(path, page)


def replay_html(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray], scenery: RecordedScene, stride: int = 1) -> str:
    """Return a recording as a page; see write_replay_html."""
    if not record["steps"]:
        raise TactipError("the recording has no steps to show")
    steps = np.unique([*range(0, record["steps"], stride), record["steps"] - 1])
    geometry, pack = SceneGeometry(scenery, object_moves(arrays)), _Pack()
    task, curves = record["task"], curves_of(arrays, record["task"])
    errors, displacements = position_errors_mm(arrays, task), skin_displacements_mm(arrays)
    bodies = [*geometry.links]
    meshes = [(len(bodies), geometry.object), (-1, geometry.table)]
    meshes += [(n, mesh) for n, body in enumerate(bodies) for mesh in geometry.links[body]]
    meshes += [(len(bodies) + 1, mesh) for mesh in geometry.sensor]
    description = {
        "title": f"{record['object']}, {task}",
        "steps": steps.tolist(),
        "meshes": [pack.add_mesh(f"mesh{n}", body, mesh) for n, (body, mesh) in enumerate(meshes)],
        "bodies": len(bodies) + 2,
        "status": [status_lines(record, arrays, int(k)) for k in steps],
        "events": sorted({int(np.searchsorted(steps, min(e["step"], steps[-1]))) for e in record["events"]}),
        "curves": [_curve(curve, steps) for curve in curves],
        "force": np.round(arrays["force_n"][steps], 4).tolist(),
        "skin_end_mm": scale_end(displacements),
        "error_end_mm": scale_end(errors),
        "unit_m": _UNIT_M,
        "unit_px": _UNIT_PX,
        "image_px": int(arrays["images"].shape[1]) if arrays["images"].size else 0,
        "skin_ramp": SKIN_RAMP,
        "error_ramp": ERROR_RAMP,
        "pin_color": PIN_COLOR,
        "force_color": FORCE_COLOR,
        "colors": {"true": TRUE_COLOR, "estimated": ESTIMATED_COLOR},
    }
    pack.add("poses", _poses(geometry, bodies, arrays, steps).astype("<f4"))
    pack.add("skin_triangles", np.asarray(geometry.skin_triangles, "<u4"))
    pack.add_changes("skin", arrays["skin_m"][steps] / _UNIT_M)
    pack.add_changes("pins", arrays["pin_tips_m"][steps] / _UNIT_M)
    lines, colors, counts = path_lines(arrays, errors, description["error_end_mm"])
    pack.add("path", lines.astype("<f4"))
    pack.add("path_colors", colors)
    pack.add("path_counts", counts[steps].astype("<u4"))
    if description["image_px"]:
        pack.add("images", np.packbits(arrays["images"][steps] > 127, axis=-1))
        project = pin_projection(record)
        if project is not None:
            pack.add_changes("pins_px", project(arrays["pin_tips_m"][steps].astype(float)) / _UNIT_PX)
    description["arrays"] = pack.names
    # In a script element, only `<` could end it.
    text = json.dumps(description, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = files("tactip_twin.sim.view").joinpath("replay.html").read_text(encoding="utf-8")
    data = base64.b64encode(zlib.compress(bytes(pack.data), 9)).decode()
    return page.replace("@DESCRIPTION@", text).replace("@DATA@", data)


class _Pack:
    """Arrays one after another in one block, each at a multiple of four bytes."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.names: dict[str, list[Any]] = {}
        """Kind, offset in bytes and number of elements of each array."""

    def add(self, name: str, values: np.ndarray) -> None:
        """Add an array of little-endian numbers."""
        self.names[name] = [values.dtype.str[1:], len(self.data), values.size]
        self.data += np.ascontiguousarray(values).tobytes()
        self.data += bytes(-len(self.data) % 4)

    def add_changes(self, name: str, values: np.ndarray) -> None:
        """Add rounded values (steps, ...) as 16-bit changes from step to step, the first from 0, which compress well."""
        whole = np.clip(np.nan_to_num(values), -(2**15), 2**15 - 1).round().astype(np.int32)
        # Changes wrap around, and so do their sums.
        self.add(name, np.diff(whole, axis=0, prepend=0).astype(np.int16).astype("<i2"))

    def add_mesh(self, name: str, body: int, mesh: ColoredMesh) -> dict[str, Any]:
        """Add a mesh, and return its description: body -1 is the base, others are rows of `poses`."""
        low, span = mesh.vertices.min(0), max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-9)
        places = ((mesh.vertices - low) / span * (2**16 - 1)).round().astype("<u2")
        normals = (127 * mesh.normals).round().astype("i1")
        both, index = np.unique(
            np.concatenate([places.astype(np.int32), normals.astype(np.int32)], 1), axis=0, return_inverse=True
        )
        self.add(f"{name}/places", both[:, :3].astype("<u2"))
        self.add(f"{name}/normals", both[:, 3:].astype("i1"))
        self.add(f"{name}/triangles", index.reshape(-1)[mesh.triangles].astype("<u4"))
        return {"name": name, "body": body, "low": low.tolist(), "unit": span / (2**16 - 1), "color": mesh.color}


def _poses(geometry: SceneGeometry, bodies: list[str], arrays: Mapping[str, np.ndarray], steps: np.ndarray) -> np.ndarray:
    """Return the poses (n, b + 2, 3, 4) of the arm's bodies, the object and the tip at steps, base frame."""
    out = []
    for k in steps:
        angles = arrays["angles_rad"][k]
        links = geometry.body_poses(angles) if bodies and np.isfinite(angles).all() else {}
        poses = [links.get(body, np.eye(4)) for body in bodies]
        poses += [arrays["T_base_object"][k], arrays["T_base_tcp"][k]]
        out.append(np.stack(poses)[:, :3])
    return np.stack(out)


def _curve(curve: Curve, steps: np.ndarray) -> dict[str, Any]:
    """Return a curve at steps as JSON values."""
    out: dict[str, Any] = {"name": curve.name, "unit": curve.unit, "span": curve.span, "true": _numbers(curve.true[steps])}
    if curve.estimated is not None:
        out["estimated"] = _numbers(curve.estimated[steps])
        if curve.deviations is not None:
            out["band"] = _numbers(BAND * curve.deviations[steps])
    return out


def _numbers(values: np.ndarray) -> list[float | None]:
    """Return values as JSON: four digits after the point, null for NaN."""
    return [round(float(x), 4) if np.isfinite(x) else None for x in values]
