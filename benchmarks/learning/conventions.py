"""Whether the conventions of mislabelled sets are found: `tactip bench conventions`.

Hidden simulated sensors are pressed on a surface and on an edge, as a laboratory would publish it. Copies of each set get
other conventions at random: frames turned and mirrored, columns renamed, negated, in other units and mixed with others that
mean nothing, Euler angles in another order, axes of the table turned, depth before or after the tap. Others hold poses in
the frame of a robot's base, as controllers record them. The labels that `tactip import --find` gives are compared with the
truth. Writes docs/conventions.md and docs/conventions.json.
"""

import csv
import io
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.options import ConventionsOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim2real.importing.column_map import Angles, ColumnMap, Task
from tactip_twin.sim2real.importing.find_layout import find_layout
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.importing.source import read_recording, with_labels
from tactip_twin.sim2real.transfer.pseudo_real import make_pseudo_real
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_images import read_image

_SENSORS: tuple[tuple[Task, str, int], ...] = (
    ("surface", "nominal-127", 11),
    ("surface", "nominal-331", 13),
    ("edge", "nominal-127", 16),
    ("edge", "nominal-331", 12),
)
"""Task, preset and seed of each hidden sensor."""

TAP_MM = 5.0
"""Depth of the tap."""

_USUAL = (*(f"pose_{k}" for k in range(1, 7)), *(f"move_{k}" for k in range(1, 7)))
_MEANINGLESS = ("surge", "sway", "heave", "a1", "a2", "a3", "u1", "u2", "u3", "w1", "w2", "w3")
"""Names of the columns: usual ones, and others that say nothing."""

_MAX_ERRORS = {"depth_mm": 1.5, "offset_mm": 1.5, "tilt_deg": 2.0, "yaw_deg": 6.0, "gain": 0.1}
"""Largest errors of labels that count as right. Depth and offset include the zero, which no frame shows exactly."""


def mislabel(
    lab: Path, truth: tuple[np.ndarray, np.ndarray], task: Task, copy: Path, rng: np.random.Generator, *, base: bool = False
) -> np.ndarray:
    """Write a copy of a laboratory's set in random conventions, and return its true poses (n, 6), mm and degrees, in the
    axes of its frames.

    Args:
        lab: Folder of the set, with init_0.png and frames frame_0.png, ….
        truth: True poses and shears (n, 6), mm and degrees.
        task: Stimulus.
        copy: Folder to write.
        rng: Generator of the conventions.
        base: Whether the table holds poses in the frame of a robot's base alone.
    """
    poses, shears = truth
    quarter, mirrored = int(rng.integers(4)), bool(rng.random() < 0.5)
    (copy / "images").mkdir(parents=True)
    for path in [lab / "init_0.png", *(lab / "images").glob("*.png")]:
        frame = read_image(path)
        turned = np.rot90(frame[:, ::-1] if mirrored else frame, quarter)
        where = copy / ("init_0.png" if path.name.startswith("init") else f"images/{path.name}")
        write_file(where, cv2.imencode(".png", np.ascontiguousarray(turned))[1].tobytes())
    columns, before_tap = (in_base(poses, rng), False) if base else mislabel_table(poses, shears, task, rng)
    if before_tap:
        write_file(copy / "meta.json", json.dumps({"tap_move": [0, 0, TAP_MM, 0, 0, 0]}).encode())
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["image_name", *columns])
    for i in range(len(poses)):
        writer.writerow([f"frame_{i}.png", *(column[i] for column in columns.values())])
    write_file(copy / "targets.csv", text.getvalue().encode())
    return as_in_frames(poses, task, quarter, mirrored)


def mislabel_table(
    poses: np.ndarray, shears: np.ndarray, task: Task, rng: np.random.Generator
) -> tuple[dict[str, list[str]], bool]:
    """Return the columns of a table in random conventions, and whether its depth is that before a tap of TAP_MM.

    Args:
        poses: (n, 6) mm and degrees.
        shears: (n, 6) mm and degrees.
        task: Stimulus.
        rng: Generator of the conventions.
    """
    poses, shears = poses.copy(), shears.copy()
    turn = Rotation.from_euler("z", rng.uniform(-180, 180) if task == "surface" else rng.uniform(-30, 30), degrees=True)
    if task == "surface":  # the axes of the table are turned
        rotations = turn * Rotation.from_rotvec(poses[:, 3:], degrees=True) * turn.inv()
        poses[:, :3], shears[:, :3], shears[:, 3:] = (turn.apply(v) for v in (poses[:, :3], shears[:, :3], shears[:, 3:]))
    else:  # the zero of the yaw is another one
        rotations = Rotation.from_rotvec(poses[:, 3:], degrees=True) * turn
    angles = str(rng.choice(get_args(Angles)))
    poses[:, 3:] = rotations.as_rotvec(degrees=True) if angles == "vector" else rotations.as_euler(angles, degrees=True)
    before_tap = bool(rng.random() < 0.5)
    poses[:, 2] += TAP_MM if before_tap else 0.0
    metres, radians = rng.random(2) < 0.3
    names = _USUAL if rng.random() < 0.5 else _MEANINGLESS
    columns: dict[str, np.ndarray] = {}
    for k, column in enumerate(np.concatenate([poses, shears], 1).T):
        unit = (1e-3 if metres else 1.0) if k % 6 < 3 else (np.pi / 180 if radians else 1.0)
        columns[names[k]] = (-1.0 if rng.random() < 0.5 else 1.0) * unit * column
    count = len(poses)
    columns |= {"row": np.arange(count), "time_s": np.sort(rng.uniform(0, 3600, count)), "lamp": rng.normal(0, 1, count)}
    order = rng.permutation(list(columns))
    return {str(name): [f"{value:.8g}" for value in columns[name]] for name in order}, before_tap


def in_base(poses: np.ndarray, rng: np.random.Generator) -> dict[str, list[str]]:
    """Return the columns of a table of poses in the frame of a robot's base, as one of several makes of robots has them.

    The surface is level or a wall, in any direction. The tool's axis points along the sensor's axis or against it, and the
    tool is turned about it by any angle. The poses are those of the apex or of a flange behind it.

    Args:
        poses: (n, 6) mm and degrees, relative to the surface or edge.
        rng: Generator of robot and mounting.
    """
    wall = Rotation.from_euler("y", 90.0 * (rng.random() < _WALLS), degrees=True)
    turn, mounted = (Rotation.from_euler("z", angle, degrees=True) for angle in rng.uniform(-180, 180, 2))
    heading = Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True)
    work = heading * wall * turn
    tool = Rotation.from_euler("x", 180.0 * (rng.random() < _AGAINST), degrees=True) * mounted
    rotations = work * Rotation.from_rotvec(poses[:, 3:], degrees=True) * tool
    behind = rng.uniform(*_FLANGE_MM) * (rng.random() < _FLANGES)
    flanges = poses[:, :3] + Rotation.from_rotvec(poses[:, 3:], degrees=True).apply([0, 0, behind])
    places = work.apply(flanges) + rng.uniform([300, -400, 50], [600, 400, 400])
    form = str(rng.choice(_FORMS))
    if form == "UR":
        columns = dict(zip(("x", "y", "z"), 1e-3 * places.T, strict=True))
        columns |= dict(zip(("rx", "ry", "rz"), rotations.as_rotvec().T, strict=True))
    elif form == "ROS":
        columns = dict(zip(("pos_x", "pos_y", "pos_z"), 1e-3 * places.T, strict=True))
        columns |= dict(zip(("qx", "qy", "qz", "qw"), rotations.as_quat().T, strict=True))
    else:
        columns = dict(zip(("X", "Y", "Z"), places.T, strict=True))
        columns |= dict(zip(("q1", "q2", "q3", "q4"), rotations.as_quat(scalar_first=True).T, strict=True))
    columns |= {"row": np.arange(len(poses)), "lamp": rng.normal(0, 1, len(poses))}
    return {name: [f"{value:.8g}" for value in column] for name, column in columns.items()}


_FORMS = ("UR", "ROS", "ABB")
"""Rotation vectors, quaternions with the real part last, and with the real part first."""

_WALLS, _AGAINST, _FLANGES = 0.25, 0.75, 0.5
"""Fractions of surfaces that are a wall, of tools whose axis points into the surface, and of poses that are a flange's."""

_FLANGE_MM = (80.0, 200.0)
"""Distance of a flange behind the apex, mm."""


def as_in_frames(poses: np.ndarray, task: Task, quarter: int, mirrored: bool) -> np.ndarray:
    """Return poses (n, 6), mm and degrees, as they are in frames that were mirrored left to right, then turned."""
    out = poses.copy()
    if task == "surface":
        tilt = out[:, 3] + 1j * out[:, 4]
        tilt = (tilt.conj() if mirrored else tilt) * 1j**quarter
        out[:, 3], out[:, 4] = tilt.real, tilt.imag
        return out
    if mirrored:  # reflected in the plane across the edge, then turned by half a turn
        out[:, [1, 3, 5]] *= -1
    turn = Rotation.from_euler("z", -90 * quarter + 180 * mirrored, degrees=True)
    out[:, 3:] = (Rotation.from_rotvec(out[:, 3:], degrees=True) * turn).as_rotvec(degrees=True)
    return out


def judge(copy: Path, task: Task, truth: np.ndarray) -> dict[str, Any]:
    """Return whether the conventions of a copy are found, refused, or wrong, with the errors of its labels."""
    given = Layout(ColumnMap(task=task))
    recording = read_recording(copy, given.column_map)
    try:
        found = find_layout(recording, given, log=lambda line: None)
    except TactipError as error:
        return {"outcome": "refused", "why": str(error)}
    column_map = found.layout.column_map
    labels = with_labels(read_recording(copy, column_map), column_map).poses
    if task == "edge":
        # Frames that are turned once more have been turned in the truth too.
        quarter = round(found.layout.preprocessing.rotate_image_deg / 90)
        truth = as_in_frames(truth, task, quarter, False)
    one, other = (Rotation.from_rotvec(part[:, 3:], degrees=True) for part in (labels, truth))
    apart = np.abs(labels[:, 3:5] - truth[:, 3:5]).mean() if task == "surface" else np.nan
    yaw = (other.inv() * one).magnitude() if task == "edge" else np.zeros(1)
    gain = np.polyfit(truth[:, 2], labels[:, 2], 1)[0]
    errors = {"depth_mm": float(np.abs(labels[:, 2] - truth[:, 2]).mean()), "gain": float(abs(gain - 1))}
    if task == "surface":
        errors["tilt_deg"] = float(apart)
    else:
        errors["offset_mm"] = float(np.abs(labels[:, 0] - truth[:, 0]).mean())
        errors["yaw_deg"] = float(np.degrees(yaw).mean())
    right = all(value <= _MAX_ERRORS[name] for name, value in errors.items())
    return {"outcome": "right" if right else "wrong", "errors": errors, "options": found.options()}


def run(options: ConventionsOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write the page, and return the results. Rerun to resume.

    Raises:
        TactipError: If the data folder holds something else.
        Interrupted: On Ctrl-C.
    """
    keep = options.data / "conventions.json"
    results = read_results(keep)
    workers = worker_count(options.workers)
    for (task, name, seed), base in itertools.product(_SENSORS, (False, True)):
        folder = options.data / f"{task}-{name.removeprefix('nominal-')}"
        key = folder.name + (_BASE if base else "")
        make_pseudo_real(folder, task, name, options.frames, seed, workers, log)  # type: ignore[arg-type]
        dataset = read_dataset(folder / "contacts")
        done = results.setdefault(key, [])
        for k in tqdm(range(len(done), options.copies), f"{key}", unit="copy", initial=len(done), total=options.copies):
            rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(seed, k, 1) if base else (seed, k)))
            copy = folder / f"copy-{k}"
            _remove(copy)
            truth = mislabel(folder / "lab", (dataset.poses, dataset.shears), task, copy, rng, base=base)
            done.append(judge(copy, task, truth))
            _remove(copy)
            write_file(keep, (json.dumps(results, indent=1) + "\n").encode())
    result = {"copies": options.copies, "frames": options.frames, "sets": results, "machine": machine()}
    write_results("conventions", result, tables(result), options.out)
    return result


_BASE = "-base"
"""End of the names of sets in the frame of a robot's base."""


def _remove(folder: Path) -> None:
    import shutil

    if folder.exists():
        shutil.rmtree(folder)


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of the page."""
    rows = []
    for key, outcomes in result["sets"].items():
        count = {kind: sum(one["outcome"] == kind for one in outcomes) for kind in ("right", "refused", "wrong")}
        errors = [one["errors"] for one in outcomes if one["outcome"] == "right"]
        cells = []
        for name in ("depth_mm", "tilt_deg", "offset_mm", "yaw_deg"):
            values = [error[name] for error in errors if name in error]
            cells.append(f"{np.median(values):.2f}" if values else "")
        what = key.removesuffix(_BASE).replace("-", ", ") + " pins" + (", in a robot's base" if key.endswith(_BASE) else "")
        rows.append([what, *count.values(), *cells])
    head = ["set", "right", "refused", "wrong", "depth, mm", "tilt, °", "offset, mm", "yaw, °"]
    return {"outcomes": table(head, rows), "machine": machine_text(result["machine"])}
