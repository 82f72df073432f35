"""A laboratory's set, published or one's own, brought into the project's format: checked, masked, reported and pictured."""

import contextlib
import csv
import dataclasses
import io
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from tactip_twin.sim.dataset.configuration import digest_of
from tactip_twin.sim.dataset.format import COLUMNS, FORMAT, VERSION, checksum, encode_image, image_name, read_meta, versions
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels, image_column
from tactip_twin.sim2real.importing.layout import Layout
from tactip_twin.sim2real.importing.report import picture, report_of
from tactip_twin.sim2real.sensor.preprocess import IMAGES, FrameReader, check_frame, load, load_neutral
from tactip_twin.sim2real.sensor.video_frames import FILMS
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.neutral_image import camera_change
from tactip_twin.tactip_model.pin_detection import find_blobs

FOLDERS = ("images", "frames", "frames_bw", "videos", "")
"""Where frames are looked for, inside the set's folder."""

NEUTRAL, NEUTRAL_TACTILE, REPORT, PICTURE = "neutral.png", "neutral_tactile.png", "import.json", "import.png"
"""Files of an imported set: the undeformed tip, or what stands for it, as large as the frames have it, binary, and as its
tactile images are (other pixels, where frames are grey); what was found, and how it looks."""

_NEUTRALS = ("init*", "neutral*")

_UNTOLD = 40
"""Frames by which it is told where the pins are, if there is no neutral image, and how the camera has changed since it."""

FEW = 0.8
"""A frame with fewer of the pins than this share of the usual number does not fit."""

_SHALLOW, _LEAST_SHALLOW, _STAND_IN = 0.05, 5, 21
"""Where there is no neutral image, the middle of some frames stands for it: of this share, the shallowest, but not fewer
than five, those that are tilted least, 21 at most. (A tilted dome that hardly touches, as a table has it, may be deep in.)
In two real sets, with depths from 0 and from 1 mm on, the twin's pins are then 0.4 and 0.2 px of 256 (rms) from where they
are (sim2real/transfer/neutral_calibration.py takes the press off), and 0.9 and 0.8 with nothing fitted
(benchmarks/learning/missing_neutral_image.py)."""

_ERASED = 0.97
"""Where that middle has fewer pins than this share of the usual number, the frames are too unlike: the shallowest of them
stands for the neutral image. An estimate [?]."""

_MOST_LEFT_OUT = 0.5
"""Share of the frames that may be left out: with more, it is not the frames that are wrong."""


@dataclass(frozen=True)
class Source:
    """A laboratory's folder. (n frames)"""

    folder: Path
    """Where it is."""
    names: tuple[str, ...]
    """(n) what the table calls the frames."""
    paths: tuple[Path | None, ...]
    """(n) where they are; None where they are not."""
    poses: np.ndarray
    """(n, 6) mm and degrees, in our conventions; NaN where it is not told."""
    shears: np.ndarray
    """(n, 6) the same."""
    neutral: Path | None
    """The undeformed tip, if there is an image of it."""
    digest: str
    """Checksum of the table."""
    film_frame: int = -1
    """Which frame of a film is meant (ColumnMap.film_frame)."""

    def load(self, i):
        """Frame i, (h, w, 3) uint8. Raises TactipError where it is not there or cannot be read."""
        path = self.paths[i]
        if path is None:
            raise TactipError("the frame is not there")
        return load(path, self.film_frame)


def read_source(folder, column_map: ColumnMap, targets=None, neutral=None):
    """The Source in a folder (path). targets: path of the table; if None, targets.csv in the folder, or the
    only table there is. neutral: path of the neutral image; one that begins with init or neutral if None.

    Raises TactipError.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise TactipError(f"{folder} is no folder: it must hold a table targets.csv and frames")
    path = Path(targets) if targets else _table_in(folder)
    try:
        data = path.read_bytes()
        rows = list(csv.DictReader(io.StringIO(data.decode("utf-8-sig"))))
    except FileNotFoundError:
        raise TactipError(f"the table {path} does not exist: name it by --targets") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise TactipError(f"the table {path} cannot be read: {error}") from error
    if not rows:
        raise TactipError(f"the table {path} has no rows")
    table = {name: [row[name] for row in rows] for name in rows[0] if name}
    names = tuple(name or "" for name in table[image_column(column_map, list(table))])
    poses, shears = convert_labels(column_map, table)
    if neutral is not None and not Path(neutral).is_file():
        raise TactipError(f"the neutral image {neutral} does not exist")
    found = [p for pattern in _NEUTRALS for p in sorted(folder.glob(pattern)) if p.suffix.lower() in IMAGES]
    paths = tuple(_found(folder, name) for name in names)
    if not any(paths):
        places = ", ".join(str(folder / f) for f in FOLDERS)
        raise TactipError(f"no frame of the table is there: {names[0]!r} was looked for in {places}")
    neutral = Path(neutral) if neutral else next(iter(found), None)
    return Source(folder, names, paths, poses, shears, neutral, checksum(data), column_map.film_frame)


def _table_in(folder):
    """Path of the table in a folder (Path): targets.csv, or the only one there is. Raises TactipError."""
    tables = sorted(folder.glob("*.csv"))
    path = folder / "targets.csv"
    if path in tables or not tables:
        return path
    if len(tables) > 1:
        raise TactipError(f"{folder} has no targets.csv: name its table by --targets, {' or '.join(map(str, tables))}")
    return tables[0]


def _found(folder, name):
    name = name.replace("\\", "/")
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        return None
    for place in FOLDERS:
        for tail in dict.fromkeys((name, Path(name).name)):
            for suffix in ("", ".png", ".jpg", *FILMS):
                path = folder / place / f"{tail}{suffix}"
                if path.is_file():
                    return path
    return None


def _some(source):
    """_UNTOLD frames, spread over those of a Source that are there, can be read, and are as large as the first of them."""
    frames = []
    for i in _spread([i for i, path in enumerate(source.paths) if path]):
        with contextlib.suppress(TactipError):  # it is left out, and said, when its turn comes
            frames.append(source.load(i))
    return [frame for frame in frames if frame.shape == frames[0].shape]


def _spread(items):
    """_UNTOLD of a list, or all if they are fewer."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, _UNTOLD).astype(int))]


def import_set(source, layout: Layout, out, say=print, quiet=False):
    """Bring a Source into a folder (path) of the project's format. Returns the report (dict).

    say: called with lines for the user. quiet: bool, without a progress bar. What was imported before,
    alike, is left as it is. Raises TactipError where the folder holds something else and where most frames do not fit,
    and Interrupted at Ctrl-C.
    """
    out = Path(out)
    record = {"task": layout.column_map.task, "layout": layout.as_dict()}
    if layout.column_map.film_frame == ColumnMap.film_frame:
        del record["layout"]["film_frame"]  # sets that were imported before there were films are the same still
    record |= {"source": {"name": source.folder.resolve().name, "targets_sha256": source.digest}}
    record["source"]["neutral_sha256"] = source.neutral and checksum(source.neutral.read_bytes())
    there = _there(out, record)
    if there and ("camera" in there and (there["neutral_image"] or "stand_in" in there)):
        say(f"{out} holds this set, imported already")
        return there
    if there:
        say(f"{out} was imported by an earlier version, which looked at less: it is imported anew")
    elif out.exists() and not (out / _WORK).exists() and any(out.iterdir()):
        raise TactipError(f"the folder {out} is not empty: name another one")
    try:
        return _import(source, layout, out, record, quiet)
    except KeyboardInterrupt:
        raise Interrupted("nothing is kept of an import that was stopped: the same command begins anew") from None


_WORK = ".importing"


def _there(out, record):
    """The report (dict) of what was imported alike into a folder before; None if nothing was.

    Raises TactipError where its meta.json is damaged, or of something else.
    """
    if not (out / "meta.json").exists():
        return None
    there = read_meta(out).get("configuration")
    if not isinstance(there, dict) or any(there.get(k) != v for k, v in record.items()):
        return None
    return read_report(out)


def read_report(folder):
    """What was found (dict) as a set was imported into a folder (path); None if none was.

    Raises TactipError where the file is damaged.
    """
    path = Path(folder) / REPORT
    if not path.exists():
        return None
    try:
        report = json.loads(path.read_text())
    except ValueError as error:
        raise TactipError(f"{path} cannot be read as JSON: {error}; import the set anew") from error
    if not isinstance(report, dict) or not {"pins", "neutral_image"} <= set(report):
        raise TactipError(f"{path} is no report of an import: import the set anew")
    return report


def _import(source, layout, out, record, quiet):
    neutral = None if source.neutral is None else load_neutral(source.neutral)
    reader = _reader(source, layout.preprocessing, neutral)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / _WORK, b"")  # first of all, so that what a kill leaves is known for ours
    (out / "meta.json").unlink(missing_ok=True)  # of an earlier version's import: until the last file it is no set
    shutil.rmtree(out / "images", ignore_errors=True)
    (out / "images").mkdir()
    images, pins, left_out = {}, {}, []
    bar = tqdm(source.names, unit="frame", file=sys.stderr, disable=quiet, mininterval=0.5 if sys.stderr.isatty() else 15)
    for i, name in enumerate(bar):
        try:
            if not (np.isfinite(source.poses[i]).all() and np.isfinite(source.shears[i]).all()):
                raise TactipError("its row has a cell that is no finite number")
            binary = reader.masked(source.load(i))
            pins[i], images[i] = len(find_blobs(binary).centres), encode_image(reader.shrunk(binary))
        except TactipError as error:
            left_out.append({"row": i, "frame": name, "why": str(error)})
    usual = float(np.median(list(pins.values()))) if pins else 0.0
    for i in [i for i, count in pins.items() if count < FEW * usual or not count]:
        left_out.append({"row": i, "frame": source.names[i], "why": f"{pins[i]} pins are seen, {usual:g} in most"})
        del images[i]
    kept = np.array(sorted(images), int)
    if len(left_out) > _MOST_LEFT_OUT * len(source.names):
        first = left_out[0]
        what = f"{len(left_out)} of {len(source.names)} frames do not fit, as {first['frame']!r}: {first['why']}"
        raise TactipError(f"{what}; is the layout right?")
    for k, i in enumerate(kept):
        write_file(out / "images" / image_name(k), images[i])
    report = report_of(source, kept, pins, left_out) | {"neutral_image": neutral is not None}
    report["camera"] = None if neutral is None else _camera(source, kept, reader, neutral)
    if neutral is None:
        at_rest, report["stand_in"] = _stand_in(source, kept, reader, usual)
    else:
        at_rest = reader.masked(neutral)
    files = {"targets.csv": _targets(source, kept), REPORT: (json.dumps(report, indent=1) + "\n").encode()}
    files[NEUTRAL], files[NEUTRAL_TACTILE] = encode_image(reader.cropped(at_rest)), encode_image(reader.shrunk(at_rest))
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


def _reader(source, options, neutral):
    """The FrameReader of a Source, tried on a frame. Raises TactipError where the options do not fit that one."""
    others = [] if neutral is not None else _some(source)
    first = neutral if neutral is not None else next(iter(others), None)
    try:
        if first is not None:
            check_frame(first, options)
        reader = FrameReader(options, neutral, others)
        if first is not None:
            reader.read(first)
    except TactipError as error:
        raise TactipError(f"the {'frames do' if neutral is None else 'neutral image does'} not fit: {error}") from error
    return reader


def _stand_in(source, kept, reader, usual):
    """What stands for the neutral image of a Source: binary, (h, w) uint8; and of which frames it is (dict).

    kept: (n,) int, rows of it. reader: FrameReader. usual: float, pins in most frames.
    """
    poses = source.poses
    shallow = kept[np.argsort(-poses[kept, 2], kind="stable")][: max(_LEAST_SHALLOW, round(_SHALLOW * len(kept)))]
    chosen = shallow[np.argsort(np.linalg.norm(poses[shallow, 3:5], axis=1), kind="stable")][:_STAND_IN]
    frames = [reader.masked(source.load(i)) for i in chosen]
    # What most of them show: a pin is where it is in the half of them that do not press it.
    image = np.where(np.mean([frame > 127 for frame in frames], 0) > 0.5, 255, 0).astype(np.uint8)
    if len(find_blobs(image).centres) < _ERASED * usual:
        first = np.argmax(poses[chosen, 2])
        chosen, image = chosen[[first]], frames[first]
    depths = poses[chosen, 2]
    return image, {"frames": len(chosen), "pose_z": [round(float(d), 6) for d in (depths.max(), depths.min())]}


def _camera(source, kept, reader, neutral):
    """What the light at the rim tells of zoom and drift since the neutral image: dict; None where there is too little."""
    before = reader.with_rim(neutral)
    middle = find_blobs(reader.cropped(reader.masked(neutral))).centres.mean(0)
    found = camera_change(before, (reader.with_rim(source.load(i)) for i in _spread(list(kept))), middle)
    if found is None:
        return None
    (zoom, *drift), (zoom_of_one, *drift_of_one) = (values.tolist() for values in found)
    return {"zoom": zoom, "drift": drift, "of_one_frame": {"zoom": zoom_of_one, "drift": drift_of_one}}


def _ranges(values, usual):
    """Range of each component (dict of sampling.Ranges) of values (n, 6), mm and degrees; at least the usual one, which is
    what errors are weighed by where nothing varies."""
    low, high = values.min(0), values.max(0)
    ends = usual.bounds()
    both = np.stack(
        [np.minimum(np.floor(1e3 * low) / 1e3, ends[:, 0]), np.maximum(np.ceil(1e3 * high) / 1e3, ends[:, 1])], -1
    )
    names = [f.name for f in dataclasses.fields(Ranges)]
    return {name: pair.tolist() for name, pair in zip(names, both, strict=True)}


def _targets(source, kept):
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS[:13], "source_image"])
    for k, i in enumerate(kept):
        numbers = [f"{x:.6f}" for x in (*source.poses[i], *source.shears[i])]
        writer.writerow([image_name(k), *numbers, source.names[i]])
    return text.getvalue().encode()
