"""Designs as JSON files: what a calibration writes and every command takes in place of a preset's name."""

import json
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import get_type_hints

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

FORMAT = "tactip-design 1"


def write_design(path, design, provenance):
    """Write a Design to a JSON file. provenance: dict, how it came about; kept for people and not read back.

    Raises OSError.
    """
    content = {"format": FORMAT, "provenance": provenance, "design": asdict(design)}
    write_file(Path(path), (json.dumps(content, indent=1) + "\n").encode())


def write_fitted(path, design, provenance):
    """Write a Design that was fitted to frames, with the camera as it was when the neutral image was taken.

    How the camera had changed when the frames were (Optics.zoom, drift) belongs to the recording and not to the sensor: it
    goes into the provenance, where `read_in_use` finds it.
    """
    with_camera_drift = {"zoom": design.optics.zoom, "drift": design.optics.drift}
    neutral = replace(design, optics=replace(design.optics, zoom=1.0, drift=(0.0, 0.0)))
    write_design(path, neutral, provenance | {"camera_in_use": with_camera_drift})


def read_in_use(path):
    """The Design in a JSON file with its camera as it was when the frames were taken that it was fitted to.

    Raises TactipError as read_design does, and where the file is not of a fitted design.
    """
    design, content = read_design(path), json.loads(Path(path).read_text())
    camera = content["provenance"].get("camera_in_use")
    if not isinstance(camera, dict) or set(camera) != {"zoom", "drift"}:
        raise TactipError(f"the design file {path} does not say how the camera was in use: only fitted ones do")
    return replace(design, optics=replace(design.optics, zoom=camera["zoom"], drift=_tuples(camera["drift"])))


def read_design(path):
    """The Design in a JSON file. Raises TactipError where it is missing, no JSON, or not a design."""
    path = Path(path)
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise TactipError(f"the design file {path} does not exist") from None
    except ValueError as error:
        raise TactipError(f"the design file {path} is not JSON: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT or not isinstance(content.get("provenance"), dict):
        raise TactipError(f"{path} is not a design file: its format must be {FORMAT!r}, with a provenance")
    return design_from(content.get("design"), f"{path}: design")


def design_from(value, where):
    """The Design of a dict as JSON has it. where: str, what it is of. Raises TactipError where it is not a design."""
    return built(Design, value, where)


def built(kind, value, where):
    """A dataclass of type `kind` from a dict; TactipError names a field that is unknown, missing or of the wrong type."""
    if not isinstance(value, dict):
        raise TactipError(f"{where} must be an object with the fields {', '.join(f.name for f in fields(kind))}")
    known = {f.name: f for f in fields(kind)}
    for name in value:
        if name not in known:
            raise TactipError(f"{where} has no field {name!r}: it has {', '.join(known)}")
    for name, f in known.items():
        if name not in value and f.default is MISSING and f.default_factory is MISSING:
            raise TactipError(f"{where} lacks the field {name!r}")
    hints = get_type_hints(kind)
    given = {}
    for name, item in value.items():
        if is_dataclass(hints[name]):
            given[name] = built(hints[name], item, f"{where}.{name}")
        else:
            given[name] = _tuples(item)
            text = hints[name] is str
            if text != isinstance(item, str) or isinstance(item, dict):
                raise TactipError(f"{where}.{name} is {item!r}: it must be {'a text' if text else 'a number or numbers'}")
    return kind(**given)


def _tuples(item):
    return tuple(_tuples(i) for i in item) if isinstance(item, list) else item
