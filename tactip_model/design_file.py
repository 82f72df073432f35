"""Designs as JSON files: calibration writes them, and every command accepts them instead of a preset's name."""

import contextlib
import json
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from tactip_twin.tactip_model.design import Design, Optics
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import read_json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

FORMAT = "tactip-design 2"


def write_design(path: str | Path, design: Design, provenance: dict[str, Any]) -> None:
    """Write a design to a JSON file.

    Args:
        path: File to write.
        design: The design.
        provenance: How the design was obtained; `read_design` ignores it.

    Raises:
        OSError: The file cannot be written.
    """
    content = {"format": FORMAT, "provenance": provenance, "design": design_as_dict(design)}
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
    design, content = read_design(path), read_json(path)
    camera = content["provenance"].get("camera_in_use")
    if not isinstance(camera, dict) or set(camera) != {"zoom", "drift"}:
        raise TactipError(f"the design file {path} lacks provenance.camera_in_use, which only designs fitted to frames have")
    optics = from_dict(Optics, asdict(design.optics) | camera, f"{path}: provenance.camera_in_use")
    return replace(design, optics=optics)


def read_design(path: str | Path) -> Design:
    """Return the design in a JSON file; raise TactipError if the file is missing, not JSON or not a design."""
    content = read_json(path, f"the design file {path}")
    if isinstance(content, dict) and content.get("format") == "tactip-design 1":
        raise TactipError(
            f"{path} has the format 'tactip-design 1', but this program reads {FORMAT!r}: fit the design again by "
            "`tactip calibrate`, or rename kinetic_share to kinetic_fraction and kinetic_after_m to slip_weakening_m in it"
        )
    if not isinstance(content, dict) or content.get("format") != FORMAT or not isinstance(content.get("provenance"), dict):
        raise TactipError(f"{path} is not a design file: it must have the format {FORMAT!r} and a provenance")
    return design_from_dict(content.get("design"), f"{path}: design")


def design_as_dict(design: Design) -> dict[str, Any]:
    """Return a design as a JSON object; what was added to designs later is left out where it is the default."""
    values = asdict(design)
    if not design.image.grey:
        del values["image"]["grey"]
    return values


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
    try:
        return kind(**{name: _value_of(hints[name], item, f"{where}.{name}") for name, item in value.items()})
    except _WrongTypeError as error:
        raise TactipError(str(error)) from None


class _WrongTypeError(Exception):
    """A JSON value does not have the type of its field."""


def _value_of(hint: Any, item: Any, where: str) -> Any:
    """Return a JSON value as the type of its field: a dataclass, tuple, number, string, bool or None."""
    if is_dataclass(hint):
        return from_dict(cast("type[DataclassInstance]", hint), item, where)
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if item is None and NoneType in choices:
            return None
        for choice in (choice for choice in choices if choice is not NoneType):
            with contextlib.suppress(_WrongTypeError):
                return _value_of(choice, item, where)
    elif origin is tuple and isinstance(item, list | tuple):
        kinds = choices[:1] * len(item) if choices[-1] is Ellipsis else choices
        if len(item) == len(kinds):
            return tuple(_value_of(kind, i, where) for kind, i in zip(kinds, item, strict=True))
    elif origin is Literal:
        if item in choices:
            return item
    elif type(item) in ((int, float) if hint is float else (hint,)):
        return item
    shown = repr(item) if len(repr(item)) < _MAX_SHOWN else repr(item)[:_MAX_SHOWN] + "…"
    raise _WrongTypeError(f"{where} must be {_words(hint)}, got {shown}")


_MAX_SHOWN = 60
"""Length to which a wrong value is cut in a message."""


def _words(hint: Any) -> str:
    """Return the type of a field in words."""
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join("null" if choice is NoneType else _words(choice) for choice in choices)
    if origin is Literal:
        return f"one of {', '.join(map(str, choices))}"
    if origin is tuple:
        if choices[-1] is Ellipsis:
            return "a list of lists" if get_origin(choices[0]) is tuple else f"a list of {_PLURALS[choices[0]]}"
        same = len(set(choices)) == 1
        return (
            f"a list of {len(choices)} {_PLURALS[choices[0]]}" if same else f"a list: {' and '.join(map(_words, choices))}"
        )
    return {str: "a string", bool: "true or false", int: "a whole number", float: "a number"}[hint]


_PLURALS = {str: "strings", int: "whole numbers", float: "numbers"}
