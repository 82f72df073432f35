"""A mesh as binary glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html): so viser shows colored vertices."""

import json

import numpy as np

from tactip_twin.sim.view.geometry import ColoredMesh
from tactip_twin.sim.view.palette import linear

_MAGIC, _VERSION, _JSON, _BIN = b"glTF", 2, b"JSON", b"BIN\0"

_FLOAT, _UNSIGNED = 5126, 5125
"""Types of components."""

_ARRAY, _ELEMENTS = 34962, 34963
"""Targets of buffers: of vertices and of indices."""


def glb(mesh: ColoredMesh, opacity: float = 1.0, roughness: float = 0.75) -> bytes:
    """Return a mesh as the bytes of a .glb file, its surface visible from both sides."""
    colors = np.broadcast_to(mesh.color, mesh.vertices.shape) if mesh.vertex_colors is None else mesh.vertex_colors
    arrays = [
        np.asarray(mesh.vertices, "<f4"),
        np.asarray(mesh.normals, "<f4"),
        np.asarray(linear(np.asarray(colors) / 255), "<f4"),
        np.asarray(mesh.triangles, "<u4").reshape(-1),
    ]
    starts = np.cumsum([0] + [a.nbytes for a in arrays])
    accessors = [
        {"bufferView": k, "componentType": _FLOAT, "count": len(a), "type": "VEC3"} for k, a in enumerate(arrays[:3])
    ]
    accessors[0] |= {"min": arrays[0].min(0).tolist(), "max": arrays[0].max(0).tolist()}
    accessors += [{"bufferView": 3, "componentType": _UNSIGNED, "count": len(arrays[3]), "type": "SCALAR"}]
    surface = {"baseColorFactor": [1, 1, 1, opacity], "metallicFactor": 0, "roughnessFactor": roughness}
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}]}
        ],
        "materials": [
            {"pbrMetallicRoughness": surface, "doubleSided": True, "alphaMode": "OPAQUE" if opacity == 1 else "BLEND"}
        ],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": a.nbytes, "target": _ELEMENTS if k == 3 else _ARRAY}
            for k, (start, a) in enumerate(zip(starts, arrays, strict=False))
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(a.tobytes() for a in arrays)  # of four bytes each, so chunks are aligned
    chunks = b"".join(_number(len(c)) + kind + c for kind, c in ((_JSON, text), (_BIN, data)))
    return _MAGIC + _number(_VERSION) + _number(12 + len(chunks)) + chunks


def _number(value: int) -> bytes:
    return value.to_bytes(4, "little")
