"""A laboratory's conventions for its table and its frames, as one record and as a JSON file. Light to import."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_json

_TABLE_KEYS = tuple(f.name for f in fields(ColumnMap))
_FRAME_KEYS = tuple(f.name for f in fields(ImagePreprocessing))


@dataclass(frozen=True)
class Layout:
    """Conventions of a laboratory's set: table and frames."""

    column_map: ColumnMap = field(default_factory=ColumnMap)
    """Columns of the table."""
    preprocessing: ImagePreprocessing = field(default_factory=ImagePreprocessing)
    """Steps from a frame to a tactile image."""

    def as_dict(self) -> dict[str, Any]:
        """Return both parts as one flat dict of JSON types, as layout files and sets record them."""
        whole = json.loads(json.dumps(asdict(self.column_map) | asdict(self.preprocessing)))
        # Sets of versions that did not know these remain the same sets.
        later = ("base_pose", "tool_offset_mm")
        return {key: value for key, value in whole.items() if key not in later or self.column_map.base_pose}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], name: str = "the layout") -> "Layout":
        """Return the Layout of flat `values` with some or all of the keys of `as_dict`; others keep their defaults.

        Args:
            values: The values.
            name: What they are, for messages.

        Raises:
            TactipError: If a key is unknown, or a value has another type or is not allowed.
        """
        table = {key: values[key] for key in _TABLE_KEYS if key in values}
        frames = {key: value for key, value in values.items() if key not in table}
        return cls(from_dict(ColumnMap, table, name), from_dict(ImagePreprocessing, frames, name))


def read_layout(path: str | Path) -> Layout:
    """Return the Layout in a JSON file: an object of the fields that differ from their defaults.

    Raises:
        TactipError: If the file does not exist, is not JSON, or has an unknown field or a wrong value.
    """
    content = read_json(path, f"the layout file {path}")
    known = {*_TABLE_KEYS, *_FRAME_KEYS}
    if not isinstance(content, dict) or set(content) - known:
        unknown = sorted(set(content) - known) if isinstance(content, dict) else [type(content).__name__]
        raise TactipError(
            f"unknown field {', '.join(unknown)} in the layout file {path}: its fields are {', '.join(sorted(known))}"
        )
    return Layout.from_dict(content, f"the layout file {path}")
