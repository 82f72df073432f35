"""Report of an import: figures, text, and a picture of some frames."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import unused_columns
from tactip_twin.sim2real.importing.source import Source
from tactip_twin.sim2real.sensor.preprocess import IMAGES, FrameReader
from tactip_twin.tactip_model.pin_detection import find_blobs


def report_of(
    source: Source, column_map: ColumnMap, kept: np.ndarray, pins: Mapping[int, int], left_out: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the figures of an import.

    Args:
        source: The set.
        column_map: Conventions of its table.
        kept: (n,) int, its rows that are kept.
        pins: Number of detected pins by row.
        left_out: Row, frame and reason of each frame that is left out.
    """
    counts = np.array([pins[i] for i in kept])
    spans = {}
    for names, values in ((LABELS, source.poses[kept]), (SHEARS, source.shears[kept])):
        for name, column in zip(names, values.T, strict=True):
            spans[name] = [round(float(column.min()), 6), round(float(column.max()), 6)]
    return {
        "frames": len(source.names),
        "kept": len(kept),
        "left_out": left_out,
        "pins": {"least": int(counts.min()), "median": float(np.median(counts)), "most": int(counts.max())},
        "ranges": spans,
        "repeated": len(kept) - len({source.paths[i] for i in kept}),
        "unused_columns": unused_columns(column_map, source.table),
        "unnamed_images": _unnamed(source),
    }


def _unnamed(source: Source) -> int:
    """Return the number of images beside the frames that the table does not name, the neutral image apart."""
    named = {path for path in source.paths if path is not None}
    if not any(path.suffix.lower() in IMAGES for path in named):
        return 0  # a table of videos
    beside = {p for place in {path.parent for path in named} for p in place.iterdir() if p.suffix.lower() in IMAGES}
    return len(beside - named - {source.neutral})


def _unlikely_units(ranges: Mapping[str, list[float]]) -> list[str]:
    """Return sentences about labels that seem to be in other units than mm and degrees."""
    depth = max(map(abs, ranges["pose_z"]))
    turn = max(abs(end) for name, ends in ranges.items() if name.startswith("pose_R") for end in ends)
    lines = []
    if 0 < depth < _MIN_DEPTH_MM:
        lines.append(
            f"pose_z is at most {depth:g} mm from zero: if the table is in metres, scale it (--columns pose_z=1000*COLUMN)"
        )
    if 0 < turn < _MIN_TURN_DEG:
        lines.append(
            f"rotations are at most {turn:g}°: if the table is in radians, scale them (--columns pose_Rx=57.29578*COLUMN)"
        )
    return lines


_MIN_DEPTH_MM, _MIN_TURN_DEG = 0.05, 0.8
"""Largest depth and rotation of a set below which its units are doubted: a TacTip resolves hardly less, and 0.8 radians are
45 degrees [?]."""


_MIN_APART_FRACTION = 0.8
"""Fraction of the pins that must be apart in the images, or a larger size is suggested [?]."""


_MAX_NAMED = 12
"""Maximum number of columns that a line names."""


def report_lines(report: Mapping[str, Any]) -> list[str]:
    """Return a report as lines of text."""
    pins = report["pins"]
    lines = [
        f"{report['kept']} of {report['frames']} frames imported; pins: median {pins['median']:g}, "
        f"{pins['least']} to {pins['most']}",
    ]
    for name, (low, high) in report["ranges"].items():
        if low or high:
            lines.append(f"{name}: {low:g} to {high:g} {'°' if '_R' in name else 'mm'}")
    if report["ranges"]["pose_z"][0] + report["ranges"]["pose_z"][1] > 0:
        lines.append("pose_z is mostly positive, but must be negative into the object: check its sign (--columns pose_z=-…)")
    lines += [*_unlikely_units(report["ranges"])]
    if report.get("unused_columns"):
        names = report["unused_columns"]
        more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
        lines.append(f"columns that vary, but are not used: {', '.join(names[:_MAX_NAMED])}{more}")
    if report.get("unnamed_images"):
        lines.append(f"{report['unnamed_images']} images beside the frames are not named in the table, so they are not used")
    if report["repeated"]:
        lines.append(f"{report['repeated']} rows name the frame of another row: training and test may share frames")
    if not report["neutral_image"]:
        low, high = report["stand_in"]["pose_z"]
        many = report["stand_in"]["frames"]
        what = (
            f"the median of the {many} frames that have moved least ({low:g} to {high:g} mm)"
            if many > 1
            else f"one frame at {low:g} mm"
        )
        press = "removed by a learned tip" if report["stand_in"]["press_removed"] else "not removed"
        lines.append(f"no neutral image: replaced by {what}, press {press}")
    elif report["camera"]:
        zoom, drift = report["camera"]["zoom"], report["camera"]["drift"]
        lines.append(
            f"reflections at the rim: image scale {zoom:.4f} relative to the neutral image, shift {drift[0]:+.4f} and "
            f"{drift[1]:+.4f} image widths"
        )
    else:
        lines.append("too little light at the rim to measure the camera's change since the neutral image")
    if report["pins_apart"] < _MIN_APART_FRACTION * report["pins_at_rest"]:
        lines.append(
            f"in images of {report['size_px']} px, {report['pins_apart']} of the {report['pins_at_rest']} pins can be told "
            f"apart: larger ones may be read better (--size-px {2 * report['size_px']})"
        )
    lines += [f"left out: {one['frame'] or 'row ' + str(one['row'])}: {one['why']}" for one in report["left_out"][:5]]
    if len(report["left_out"]) > 5:
        lines.append(f"and {len(report['left_out']) - 5} more: see import.json")
    return lines


_TILE = 240
"""Width of a frame in the picture, px."""


def picture(
    source: Source, kept: np.ndarray, pins: Mapping[int, int], reader: FrameReader, neutral: np.ndarray | None
) -> np.ndarray:
    """Return a picture (h, w, 3) uint8 of the neutral image and of frames by depth, before and after masking, with pins
    ringed.

    Args:
        source: The set.
        kept: (n,) int, its rows that are kept.
        pins: Number of detected pins by row.
        reader: Reader of its frames.
        neutral: (h, w[, 3]) uint8, the neutral image, if there is one.
    """
    order = kept[np.argsort(-source.poses[kept, 2], kind="stable")]
    chosen = order[np.unique(np.linspace(0, len(order) - 1, 5 if neutral is not None else 6).astype(int))]
    tiles = [] if neutral is None else [_tile(neutral, reader, "neutral")]
    for i in chosen:
        p = source.poses[i]
        caption = f"z {p[2]:.1f}  R {p[3]:.0f} {p[4]:.0f} {p[5]:.0f}  pins {pins[i]}"
        tiles.append(_tile(source.load(i), reader, caption))
    return np.concatenate(tiles, 1)


def _tile(frame: np.ndarray, reader: FrameReader, caption: str) -> np.ndarray:
    upright = reader.binary(frame)
    binary = reader.masked(frame)
    scale = _TILE / binary.shape[1]
    size = (_TILE, round(scale * binary.shape[0]))
    grey = cv2.resize(upright, size, interpolation=cv2.INTER_AREA)
    masked = cv2.cvtColor(cv2.resize(binary, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    for x, y in (find_blobs(binary).centres + 0.5) * scale:
        cv2.circle(masked, (round(x), round(y)), 5, (60, 160, 255), 1, cv2.LINE_AA)
    label = np.full((24, _TILE, 3), 255, np.uint8)
    cv2.putText(label, caption, (3, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), masked, label], 0)
