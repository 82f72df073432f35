"""Designs as JSON files: calibration writes them, and every command accepts them instead of a preset's name."""

import json
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_origin, get_type_hints

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

FORMAT = "tactip-design 2"


def write_design(path: str | Path, design: Design, provenance: dict[str, Any]) -> None:
    """Write a design to a JSON file.

    Args:
        path: File to write.
        design: The design.
        provenance: How the design was obtained, for people; it is not read back.

    Raises:
        OSError: The file cannot be written.
    """
    content = {"format": FORMAT, "provenance": provenance, "design": asdict(design)}
    write_file(Path(path), (json.dumps(content, indent=1) + "\n").encode())


def write_fitted_design(path: str | Path, design: Design, provenance: dict[str, Any]) -> None:
    """Write a design that was fitted to frames, with the camera as it was when the neutral image was taken.

    The camera's change between that image and the frames (Optics.zoom, drift) belongs to the recording and not to the
    sensor, so it is written to the provenance, from which `read_design_with_drift` reads it.
    """
    camera_drift = {"zoom": design.optics.zoom, "drift": design.optics.drift}
    neutral = replace(design, optics=replace(design.optics, zoom=1.0, drift=(0.0, 0.0)))
    write_design(path, neutral, provenance | {"camera_in_use": camera_drift})


def read_design_with_drift(path: str | Path) -> Design:
    """Return the design in a JSON file with the zoom and drift of the camera in the frames of the fit.

    Raises:
        TactipError: `read_design` fails, or the design was not fitted to frames.
    """
    design, content = read_design(path), json.loads(Path(path).read_text())
    camera = content["provenance"].get("camera_in_use")
    if not isinstance(camera, dict) or set(camera) != {"zoom", "drift"}:
        raise TactipError(f"the design file {path} lacks provenance.camera_in_use, which only designs fitted to frames have")
    return replace(design, optics=replace(design.optics, zoom=camera["zoom"], drift=_tuples(camera["drift"])))


def read_design(path: str | Path) -> Design:
    """Return the design in a JSON file; raise TactipError if the file is missing, not JSON or not a design."""
    path = Path(path)
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise TactipError(f"the design file {path} does not exist") from None
    except ValueError as error:
        raise TactipError(f"the design file {path} is not JSON: {error}") from error
    if isinstance(content, dict) and content.get("format") == "tactip-design 1":
        raise TactipError(
            f"{path} has the format 'tactip-design 1', but this program reads {FORMAT!r}: fit the design again by "
            "`tactip calibrate`, or rename kinetic_share to kinetic_fraction and kinetic_after_m to slip_weakening_m in it"
        )
    if not isinstance(content, dict) or content.get("format") != FORMAT or not isinstance(content.get("provenance"), dict):
        raise TactipError(f"{path} is not a design file: it must have the format {FORMAT!r} and a provenance")
    return design_from_dict(content.get("design"), f"{path}: design")


def design_from_dict(value: object, where: str) -> Design:
    """Return the design of a JSON object; `where` is its origin, for the message of a TactipError if it is not a design."""
    return from_dict(Design, value, where)


def from_dict(kind: type[T], value: object, where: str) -> T:
    """Return a dataclass made from a JSON object.

    Args:
        kind: The dataclass.
        value: The object's fields by name; objects and lists become dataclasses and tuples.
        where: Origin of the object, for the message.

    Raises:
        TactipError: A field is unknown, missing or of the wrong type; the message names it.
    """
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
            given[name] = from_dict(hints[name], item, f"{where}.{name}")
        else:
            given[name] = _tuples(item)
            text = hints[name] is str or get_origin(hints[name]) is Literal
            if text != isinstance(item, str) or isinstance(item, dict):
                raise TactipError(f"{where}.{name} must be {'a string' if text else 'a number or numbers'}, got {item!r}")
    return kind(**given)


def _tuples(item: Any) -> Any:
    """Return a JSON value with tuples instead of lists."""
    return tuple(_tuples(i) for i in item) if isinstance(item, list) else item
