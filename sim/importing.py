"""A laboratory's set, published or one's own, brought into the project's format: checked, masked, reported and pictured."""

import contextlib
import csv
import dataclasses
import io
import json
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from sim.dataset import (
    COLUMNS,
    FORMAT,
    VERSION,
    checksum,
    digest_of,
    encode_image,
    image_name,
    read_meta,
    versions,
)
from sim.names import LABELS, SHEARS
from sim.relabel import image_column, labels
from sim.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_model.blobs import find_blobs
from tactip_model.design import TactileImage
from tactip_model.errors import Stopped, TactipError
from tactip_model.files import write_file
from tactip_model.image import binary_frame, tactile_image
from tactip_model.mask import pin_area
from tactip_model.neutral import camera_change

FOLDERS = ("images", "frames", "frames_bw", "")
"""Where frames are looked for, inside the set's folder."""

NEUTRAL, NEUTRAL_TACTILE, REPORT, PICTURE = "neutral.png", "neutral_tactile.png", "import.json", "import.png"
"""Files of an imported set: the undeformed tip as large as the frames have it, binary, and as its tactile images are (other
pixels, where frames are grey); what was found, and how it looks."""

_NEUTRALS = ("init*", "neutral*")

_UNTOLD = 40
"""Frames by which it is told where the pins are, if there is no neutral image, and how the camera has changed since it."""

FEW = 0.8
"""A frame with fewer of the pins than this share of the usual number does not fit."""

_OBLONG = 0.05
"""How far from square what is used of a frame may be; published crops are off by 1.5 % [M]."""

_MOST_LEFT_OUT = 0.5
"""Share of the frames that may be left out: with more, it is not the frames that are wrong."""


class FrameReader:
    """Binary tactile images of a laboratory's frames: mirrored, turned, thresholded, masked and cropped, in this order."""

    def __init__(self, layout, neutral=None, others=()):
        """layout: Layout. neutral: (h, w[, 3]) uint8, the undeformed tip, or None; then others, frames, tell where pins are.

        Raises TactipError where that cannot be told and is needed.
        """
        self._layout, self._mask = layout, None
        # Nothing is thresholded twice, and a crop is of the frame as it comes out of the turn.
        self._image = TactileImage(crop=layout.crop, threshold=None, size_px=layout.size_px)
        self.shape = None if neutral is None else neutral.shape[:2]
        """Height and width of a frame, px; None until one was seen."""
        if layout.mask == "pins":
            # In pressed frames the pins have gone outward already.
            told, margin = ([neutral], 1.0) if neutral is not None else (others, 0.5)
            self._mask = pin_area((self.binary(frame) for frame in told), margin)

    def binary(self, frame):
        """Binary frame (h, w) uint8, pins white, upright; not cropped and not masked. frame: (h, w[, 3]) uint8."""
        frame = frame[:, ::-1] if self._layout.mirrored else frame
        frame = _turned(np.ascontiguousarray(frame), self._layout.image_turn_deg)
        if self._layout.dark:
            frame = 255 - frame
        return binary_frame(frame, self._layout.threshold)

    def masked(self, frame):
        """Binary frame (h, w) with what is outside of the pins black. Raises TactipError on a frame of another size."""
        if self.shape is None:
            self.shape = frame.shape[:2]
        if frame.shape[:2] != self.shape:
            one, other = (f"{w} by {h} px" for h, w in (frame.shape[:2], self.shape))
            raise TactipError(f"it is {one}, the others are {other}")
        binary = self.binary(frame)
        return binary if self._mask is None else np.where(self._mask, binary, 0).astype(np.uint8)

    def read(self, frame):
        """The tactile image (size, size) of a frame. Raises TactipError where it does not fit."""
        return self.shrunk(self.masked(frame))

    def shrunk(self, binary):
        """The tactile image (size, size) of a `masked` frame."""
        return self._square(binary, self._image.size_px)

    def whole(self, frame):
        """As `read`, as large as the frame has it."""
        return self._as_large(self.masked(frame))

    def with_rim(self, frame):
        """As `whole`, with what is outside of the pins."""
        return self._as_large(self.binary(frame))

    def _as_large(self, binary):
        left, top, right, bottom = self._image.crop or (0, 0, *binary.shape[::-1])
        return self._square(binary, min(right - left, bottom - top))

    def _square(self, binary, size):
        left, top, right, bottom = self._image.crop or (0, 0, *binary.shape[::-1])
        if abs((right - left) / max(bottom - top, 1) - 1) > _OBLONG:
            raise TactipError(
                f"what is used of it is {right - left} by {bottom - top} px, and should be square: give a crop"
            )
        return tactile_image(binary, replace(self._image, size_px=size))


def _turned(frame, degrees):
    """A frame turned counter-clockwise; by quarters exactly."""
    if degrees % 90 == 0:
        return np.ascontiguousarray(np.rot90(frame, round(degrees / 90)))
    height, width = frame.shape[:2]
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)
    return cv2.warpAffine(frame, turn, (width, height), flags=cv2.INTER_LINEAR)


@dataclass(frozen=True)
class Source:
    """A laboratory's folder. (n frames)"""

    folder: Path
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


def read_source(folder, layout, targets=None, neutral=None):
    """The Source in a folder (path). layout: Layout. targets: path of the table, targets.csv in the folder if None. neutral:
    path of the neutral image; one that begins with init or neutral if None. Raises TactipError."""
    folder = Path(folder)
    if not folder.is_dir():
        raise TactipError(f"{folder} is no folder: it must hold a table targets.csv and frames")
    path = Path(targets) if targets else folder / "targets.csv"
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
    names = tuple(name or "" for name in table[image_column(layout, list(table))])
    poses, shears = labels(layout, table)
    if neutral is not None and not Path(neutral).is_file():
        raise TactipError(f"the neutral image {neutral} does not exist")
    found = [p for pattern in _NEUTRALS for p in sorted(folder.glob(pattern)) if p.suffix.lower() in IMAGES]
    paths = tuple(_found(folder, name) for name in names)
    if not any(paths):
        places = ", ".join(str(folder / f) for f in FOLDERS)
        raise TactipError(f"no frame of the table is there: {names[0]!r} was looked for in {places}")
    return Source(folder, names, paths, poses, shears, Path(neutral) if neutral else next(iter(found), None), checksum(data))


IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def _found(folder, name):
    name = name.replace("\\", "/")
    if not name or Path(name).is_absolute() or ".." in Path(name).parts:
        return None
    for place in FOLDERS:
        for tail in dict.fromkeys((name, Path(name).name)):
            for suffix in ("", ".png", ".jpg"):
                path = folder / place / f"{tail}{suffix}"
                if path.is_file():
                    return path
    return None


def load(path):
    """A frame (h, w, 3) uint8. Raises TactipError where it cannot be read."""
    frame = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if frame is None:
        raise TactipError("it cannot be read as an image")
    return frame


def load_neutral(path):
    """The neutral image (h, w, 3) uint8. Raises TactipError where it cannot be read."""
    try:
        return load(path)
    except TactipError as error:
        raise TactipError(f"the neutral image {path}: {error}") from error


def _some(paths):
    """_UNTOLD frames, spread over those of `paths` that are there, can be read, and are as large as the first of them."""
    frames = []
    for path in _spread([path for path in paths if path]):
        with contextlib.suppress(TactipError):  # it is left out, and said, when its turn comes
            frames.append(load(path))
    return [frame for frame in frames if frame.shape == frames[0].shape]


def _spread(items):
    """_UNTOLD of a list, or all if they are fewer."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, _UNTOLD).astype(int))]


def import_set(source, layout, out, say=print, quiet=False):
    """Bring a Source into a folder (path) of the project's format. Returns the report (dict).

    layout: Layout. say: called with lines for the user. quiet: bool, without a progress bar. What was imported before,
    alike, is left as it is. Raises TactipError where the folder holds something else and where most frames do not fit,
    and Stopped at Ctrl-C.
    """
    out = Path(out)
    record = {"task": layout.task, "layout": json.loads(json.dumps(dataclasses.asdict(layout)))}
    record |= {"source": {"name": source.folder.resolve().name, "targets_sha256": source.digest}}
    record["source"]["neutral_sha256"] = source.neutral and checksum(source.neutral.read_bytes())
    there = _there(out, record)
    if there and "camera" in there:
        say(f"{out} holds this set, imported already")
        return there
    if there:
        say(f"{out} was imported by an earlier version, which did not look at the camera: it is imported anew")
    elif out.exists() and not (out / _WORK).exists() and any(out.iterdir()):
        raise TactipError(f"the folder {out} is not empty: name another one")
    try:
        return _import(source, layout, out, record, quiet)
    except KeyboardInterrupt:
        raise Stopped("nothing is kept of an import that was stopped: the same command begins anew") from None


_WORK = ".importing"


def _there(out, record):
    """The report (dict) of what was imported alike into a folder before; None if nothing was.

    Raises TactipError where its meta.json is damaged, or of something else.
    """
    if not (out / "meta.json").exists():
        return None
    there = read_meta(out).get("configuration")
    same = isinstance(there, dict) and all(there.get(k) == v for k, v in record.items())
    return json.loads((out / REPORT).read_text()) if same else None


def _import(source, layout, out, record, quiet):
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / _WORK, b"")  # first of all, so that what a kill leaves is known for ours
    (out / "meta.json").unlink(missing_ok=True)  # of an earlier version's import: until the last file it is no set
    shutil.rmtree(out / "images", ignore_errors=True)
    (out / "images").mkdir()
    neutral = None if source.neutral is None else load_neutral(source.neutral)
    reader = FrameReader(layout, neutral, [] if neutral is not None else _some(source.paths))
    images, pins, left_out = {}, {}, []
    bar = tqdm(source.names, unit="frame", file=sys.stderr, disable=quiet, mininterval=0.5 if sys.stderr.isatty() else 15)
    for i, name in enumerate(bar):
        try:
            if not (np.isfinite(source.poses[i]).all() and np.isfinite(source.shears[i]).all()):
                raise TactipError("its row has a cell that is no finite number")
            path = source.paths[i]
            if path is None:
                raise TactipError("the frame is not there")
            binary = reader.masked(load(path))
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
    report = _report(source, kept, pins, left_out, neutral is not None)
    report["camera"] = None if neutral is None else _camera(source, kept, reader, neutral)
    files = {"targets.csv": _targets(source, kept), REPORT: (json.dumps(report, indent=1) + "\n").encode()}
    if neutral is not None:
        files[NEUTRAL] = encode_image(reader.whole(neutral))
        files[NEUTRAL_TACTILE] = encode_image(reader.read(neutral))
    files[PICTURE] = encode_image(_picture(source, kept, pins, reader, neutral))
    for name, data in files.items():
        write_file(out / name, data)
    ranges = {
        "pose": _ranges(source.poses[kept], POSE_RANGES[layout.task]),
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


def _camera(source, kept, reader, neutral):
    """What the light at the rim tells of zoom and drift since the neutral image: dict; None where there is too little."""
    before = reader.with_rim(neutral)
    middle = find_blobs(reader.whole(neutral)).centres.mean(0)
    found = camera_change(before, (reader.with_rim(load(source.paths[i])) for i in _spread(list(kept))), middle)
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


def _report(source, kept, pins, left_out, neutral):
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
        "neutral_image": neutral,
        "ranges": spans,
    }


def report_lines(report):
    """A report (dict) in words: a list of lines."""
    pins = report["pins"]
    lines = [
        f"{report['kept']} of {report['frames']} frames; {pins['median']:g} pins in most, {pins['least']} to {pins['most']}",
    ]
    for name, (low, high) in report["ranges"].items():
        if low or high:
            lines.append(f"{name}: {low:g} to {high:g} {'°' if '_R' in name else 'mm'}")
    if not report["neutral_image"]:
        lines.append("there is no neutral image: where the pins are was told from frames")
    elif report["camera"]:
        zoom, drift = report["camera"]["zoom"], report["camera"]["drift"]
        lines.append(
            f"by the light at the rim the image is {zoom:.4f} times the neutral one, and moved by {drift[0]:+.4f} and "
            f"{drift[1]:+.4f} of its width"
        )
    else:
        lines.append("too little light at the rim to tell by it how the camera has changed since the neutral image")
    lines += [f"left out: {one['frame'] or 'row ' + str(one['row'])}: {one['why']}" for one in report["left_out"][:5]]
    if len(report["left_out"]) > 5:
        lines.append(f"and {len(report['left_out']) - 5} more: see {REPORT}")
    return lines


_TILE = 240
"""Width of a frame in the picture, px."""


def _picture(source, kept, pins, reader, neutral):
    """The neutral image and frames over the depths, each as it came beside what is left, pins ringed: (h, w, 3) uint8."""
    order = kept[np.argsort(-source.poses[kept, 2], kind="stable")]
    chosen = order[np.unique(np.linspace(0, len(order) - 1, 5 if neutral is not None else 6).astype(int))]
    tiles = [] if neutral is None else [_tile(neutral, reader, "neutral")]
    for i in chosen:
        p = source.poses[i]
        told = f"z {p[2]:.1f}  R {p[3]:.0f} {p[4]:.0f} {p[5]:.0f}  pins {pins[i]}"
        tiles.append(_tile(load(source.paths[i]), reader, told))
    return np.concatenate(tiles, 1)


def _tile(frame, reader, told):
    upright = reader.binary(frame)
    binary = reader.masked(frame)
    scale = _TILE / binary.shape[1]
    size = (_TILE, round(scale * binary.shape[0]))
    grey = cv2.resize(upright, size, interpolation=cv2.INTER_AREA)
    seen = cv2.cvtColor(cv2.resize(binary, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    for x, y in (find_blobs(binary).centres + 0.5) * scale:
        cv2.circle(seen, (round(x), round(y)), 5, (60, 160, 255), 1, cv2.LINE_AA)
    words = np.full((24, _TILE, 3), 255, np.uint8)
    cv2.putText(words, told, (3, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), seen, words], 0)
