"""Import of a laboratory's set into the project's format: checked, masked, reported and plotted."""

import csv
import dataclasses
import io
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from tactip_twin.sim.dataset.configuration import digest_of
from tactip_twin.sim.dataset.format import COLUMNS, FORMAT, VERSION, checksum, encode_image, image_name, read_meta, versions
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.frame_blobs import BLOBS, FRAMES, blobs_of, pack_blobs
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.importing.missing_neutral import neutral_from_frames
from tactip_twin.sim2real.importing.report import picture, report_of
from tactip_twin.sim2real.importing.source import Source, frame_reader, spread
from tactip_twin.sim2real.sensor.preprocess import MIN_PIN_FRACTION, FrameReader, load_neutral
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import remove_leftovers, write_file
from tactip_twin.tactip_model.input_files import read_file, read_json
from tactip_twin.tactip_model.input_images import read_image
from tactip_twin.tactip_model.neutral_image import camera_change, reference_pixels
from tactip_twin.tactip_model.pin_detection import find_blobs

NEUTRAL, NEUTRAL_TACTILE, REPORT, PICTURE = "neutral.png", "neutral_tactile.png", "import.json", "import.png"
"""Files of an imported set: the binary image of the undeformed tip, or its replacement, at the size of the frames and at the
size of the tactile images (thresholded separately if frames are grey); the report, and a picture of some frames."""

_MAX_LEFT_OUT_FRACTION = 0.5
"""Maximum fraction of frames left out; above it, the layout is more likely wrong than the frames."""

_MIN_OF_NEUTRAL_PINS = 0.7
"""Ratio of the median number of pins in the frames to that in the neutral image below which these are not thresholded
alike [?]."""

_KIND = "real data set"

_POSSIBLE = np.array([[50, 50, 15, 80, 80, 360], [50, 50, 50, 120, 120, 360]], float)
"""Largest magnitudes of a pose and a shear that a label can have, mm and degrees: a TacTip has a radius of 20 mm, and is not
pressed with its side. Poses in the frame of a robot's base, or in other units, have larger ones [?]."""


def import_set(
    source: Source,
    layout: Layout,
    out: str | Path,
    log: Callable[[str], object] = print,
    quiet: bool = False,
) -> dict[str, Any]:
    """Import a Source into a folder in the project's format, and return the report. A finished import is left as it is.

    Args:
        source: The laboratory's set.
        layout: Its conventions.
        out: Folder to write.
        log: Callback for messages to the user.
        quiet: Whether to hide the progress bar.

    Raises:
        TactipError: If the folder holds something else, or most frames do not fit.
        Interrupted: On Ctrl-C.
    """
    out = Path(out)
    record = {"task": layout.column_map.task, "layout": layout.as_dict()}
    if layout.column_map.video_frame == ColumnMap.video_frame:
        del record["layout"]["video_frame"]  # written only if it differs from its default, so older sets keep their digest
    if not layout.preprocessing.grey:
        del record["layout"]["grey"]
    record |= {"source": {"name": source.folder.resolve().name, "targets_sha256": source.digest}}
    record["source"]["neutral_sha256"] = source.neutral and checksum(read_file(source.neutral))
    missing = sum(path is None for path in source.paths)
    if missing:  # written only then, so older sets that are complete keep their digest
        record["source"]["frames_missing"] = missing
    if not (out / _WORK).exists() and check_resumable(out, _KIND, _recorded(out, record), record):
        report = read_report(out)
        if report and _is_complete(report):
            log(f"{out} already holds this set")
            return report
        log(f"{out} was imported by an earlier version, whose report is incomplete: importing it again")
    try:
        neutral = None if source.neutral is None else load_neutral(source.neutral)
        reader = frame_reader(source, layout.preprocessing, neutral)
        out.mkdir(parents=True, exist_ok=True)
        # The lock is written first, so the folder of a killed import is recognized.
        with locked(out / _WORK, f"importing a set into {out}"):
            return _import(source, layout, out, record, reader, neutral, quiet)
    except KeyboardInterrupt:
        raise Interrupted("an import keeps no partial results: run the same command to start again") from None


_WORK = ".importing"


def _recorded(out: Path, record: dict[str, Any]) -> dict[str, Any] | None:
    """Return what a folder's meta.json has for the keys of `record`; None if no set was imported into it.

    Raises:
        TactipError: If meta.json is damaged.
    """
    if not (out / "meta.json").exists():
        return None
    configuration = read_meta(out).get("configuration")
    if not isinstance(configuration, dict) or "layout" not in configuration:
        return None
    return {key: configuration.get(key) for key in record}


def pins_at_rest(folder: Path) -> np.ndarray | None:
    """Return the pins (n, 2), px of 256, in the neutral image of an imported set; None if the folder has none, or one that
    was made from frames that touch, whose press was not removed.

    Raises:
        TactipError: The image, or the report of the import, cannot be read.
    """
    report = read_report(folder)
    if not (folder / NEUTRAL).exists() or (report and not (report["neutral_image"] or _is_press_removed(report))):
        return None
    image = read_image(folder / NEUTRAL)
    centres = reference_pixels(find_blobs(image).centres, image.shape[1])
    return centres if len(centres) else None


def _is_complete(report: dict[str, Any]) -> bool:
    """Return whether a report has all that this version writes."""
    return {"camera", "pins_apart"} <= set(report) and (report["neutral_image"] or _is_press_removed(report) is not None)


def _is_press_removed(report: dict[str, Any]) -> bool | None:
    """Return whether the press was removed from the frames that replace a neutral image; None if the report does not say."""
    return report.get("stand_in", {}).get("press_removed")


def read_report(folder: str | Path) -> dict[str, Any] | None:
    """Return the report of an import into a folder; None if there is none.

    Raises:
        TactipError: If the file is damaged.
    """
    path = Path(folder) / REPORT
    if not path.exists():
        return None
    report = read_json(path)
    if not isinstance(report, dict) or not {"pins", "neutral_image"} <= set(report):
        raise TactipError(f"{path} is not an import report: import the set again")
    return report


def _import(
    source: Source,
    layout: Layout,
    out: Path,
    record: dict[str, Any],
    reader: FrameReader,
    neutral: np.ndarray | None,
    quiet: bool,
) -> dict[str, Any]:
    """Write the set into a locked folder, and return the report; see `import_set`."""
    remove_leftovers(out)
    (out / "meta.json").unlink(missing_ok=True)  # from an earlier version; not a set until meta.json exists
    shutil.rmtree(out / "images", ignore_errors=True)
    (out / "images").mkdir()
    images, pins, blobs, left_out = {}, {}, {}, []
    shown = set(spread(range(len(source.names)), FRAMES))
    bar = tqdm(source.names, unit="frame", file=sys.stderr, disable=quiet, mininterval=0.5 if sys.stderr.isatty() else 15)
    for i, name in enumerate(bar):
        try:
            _check_labels(source.poses[i], source.shears[i])
            frame = source.load(i)
            binary = reader.masked(frame)
            pins[i], images[i] = len(find_blobs(binary).centres), encode_image(reader.tactile(frame, binary))
            if i in shown:
                blobs[i] = blobs_of(reader.cropped(binary))
        except TactipError as error:
            left_out.append({"row": i, "frame": name, "why": str(error)})
    usual = float(np.median(list(pins.values()))) if pins else 0.0
    if neutral is not None and pins:
        _check_pins(reader, neutral, usual)
    for i in [i for i, count in pins.items() if count < MIN_PIN_FRACTION * usual or not count]:
        left_out.append({"row": i, "frame": source.names[i], "why": f"{pins[i]} pins detected, the median is {usual:g}"})
        del images[i]
    kept = np.array(sorted(images), int)
    if len(left_out) > _MAX_LEFT_OUT_FRACTION * len(source.names):
        first = left_out[0]
        what = (
            f"{len(left_out)} of {len(source.names)} frames cannot be used, for example {first['frame']!r}: {first['why']}"
        )
        raise TactipError(f"{what}; check the layout")
    for k, i in enumerate(kept):
        write_file(out / "images" / image_name(k), images[i])
    report = report_of(source, layout.column_map, kept, pins, left_out) | {"neutral_image": neutral is not None}
    report["camera"] = None if neutral is None else _camera(source, kept, reader, neutral)
    if neutral is None:
        at_rest, report["stand_in"] = neutral_from_frames(
            source, kept, reader, usual, layout.column_map.task, estimates_mechanics=True
        )
    else:
        at_rest = reader.masked(neutral)
    cropped, tactile = reader.cropped(at_rest), reader.shrunk(at_rest)
    report["pins_at_rest"], report["pins_apart"] = (len(find_blobs(image).centres) for image in (cropped, tactile))
    report["size_px"] = len(tactile)
    files = {"targets.csv": _targets(source, kept), REPORT: (json.dumps(report, indent=1) + "\n").encode()}
    files[BLOBS] = pack_blobs({k: blobs[i] for k, i in enumerate(kept.tolist()) if i in blobs})
    files[NEUTRAL], files[NEUTRAL_TACTILE] = encode_image(cropped), encode_image(tactile)
    files[PICTURE] = encode_image(picture(source, kept, pins, reader, neutral))
    for name, data in files.items():
        write_file(out / name, data)
    ranges = {
        "pose": _ranges(source.poses[kept], POSE_RANGES[layout.column_map.task]),
        "shear": _ranges(source.shears[kept], SHEAR_RANGES),
    }
    configuration = record | ranges
    meta = {
        "format": FORMAT,
        "version": VERSION,
        "digest": digest_of(configuration),
        "samples": {"asked": len(source.names), "kept": len(kept), "failed": len(left_out)},
        "failures": left_out,
        "configuration": configuration,
        "versions": versions(),
        "files": {name: checksum(data) for name, data in files.items()},
        "images": {image_name(k): checksum(images[i]) for k, i in enumerate(kept)},
    }
    write_file(out / "meta.json", (json.dumps(meta, indent=1) + "\n").encode())
    (out / _WORK).unlink()
    return report


def _check_labels(pose: np.ndarray, shear: np.ndarray) -> None:
    """Raise TactipError if a pose or a shear (6,), mm and degrees, is not finite, or not possible with a TacTip."""
    values = np.array([pose, shear])
    if not np.isfinite(values).all():
        raise TactipError("its row has a value that is not a finite number")
    beyond = np.argwhere(np.abs(values) > _POSSIBLE)
    if len(beyond):
        which, k = beyond[0]
        unit = "mm" if k < 3 else "°"
        raise TactipError(
            f"{(LABELS, SHEARS)[which][k]} must be between -{_POSSIBLE[which, k]:g} and {_POSSIBLE[which, k]:g} {unit}, got "
            f"{values[which, k]:g}: labels are relative to the undeformed contact, in mm and degrees (--columns)"
        )


def _check_pins(reader: FrameReader, neutral: np.ndarray, usual: float) -> None:
    """Raise TactipError if pins of the neutral image (h, w[, 3]) are cropped, or frames have far fewer, `usual` in the
    median."""
    binary = reader.masked(neutral)
    at_rest, cropped = (len(find_blobs(image).centres) for image in (binary, reader.cropped(binary)))
    if cropped < at_rest:
        raise TactipError(f"the crop must keep all pins, got {cropped} of the {at_rest} in the neutral image: see --crop")
    if usual < _MIN_OF_NEUTRAL_PINS * at_rest:
        raise TactipError(
            f"the frames must show about as many pins as the neutral image, got {usual:g} in the median instead of "
            f"{at_rest}: the --threshold suits one of them only, or they are of different sensors"
        )


def _camera(source: Source, kept: np.ndarray, reader: FrameReader, neutral: np.ndarray) -> dict[str, Any] | None:
    """Return zoom and drift since the neutral image, measured by the light at the rim; None if there is too little light."""
    before = reader.with_rim(neutral)
    middle = find_blobs(reader.cropped(reader.masked(neutral))).centres.mean(0)
    found = camera_change(before, (reader.with_rim(source.load(i)) for i in spread(list(kept))), middle)
    if found is None:
        return None
    (zoom, *drift), (zoom_of_one, *drift_of_one) = (values.tolist() for values in found)
    return {"zoom": zoom, "drift": drift, "of_one_frame": {"zoom": zoom_of_one, "drift": drift_of_one}}


def _ranges(values: np.ndarray, usual: Ranges) -> dict[str, list[float]]:
    """Return the range of each component of values (n, 6), mm and degrees, by the names of Ranges. A component that does not
    vary gets its usual range, which scales its errors."""
    low, high = values.min(0), values.max(0)
    ends = usual.bounds()
    both = np.stack(
        [np.minimum(np.floor(1e3 * low) / 1e3, ends[:, 0]), np.maximum(np.ceil(1e3 * high) / 1e3, ends[:, 1])], -1
    )
    names = [f.name for f in dataclasses.fields(Ranges)]
    return {name: pair.tolist() for name, pair in zip(names, both, strict=True)}


def _targets(source: Source, kept: np.ndarray) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS[:13], "source_image"])
    for k, i in enumerate(kept):
        numbers = [f"{x:.6f}" for x in (*source.poses[i], *source.shears[i])]
        writer.writerow([image_name(k), *numbers, source.names[i]])
    return text.getvalue().encode()
