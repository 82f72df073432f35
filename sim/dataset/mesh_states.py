"""Deformed meshes of the contacts of a data set: mesh.npz, in sets made with --keep-mesh.

    numbers    (k,) int64           numbers of the contacts, ascending; failed contacts have none
    states     (k, 1 + s, n, 3)     float32, m, sensor frame: vertices after the approach, then at each of the s images
    digest     ()                   checksum of the set's configuration

Symmetric copies have no mesh of their own. The undeformed mesh is that of the set's design and fidelity
(tactip_model/mesh.py).
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_parts, read_unaltered
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import MAX_BYTES, parse_arrays
from tactip_twin.tactip_model.mesh import build_mesh

MAX_MESH_BYTES = MAX_BYTES - 2**20
"""Maximum size of the meshes of a set without shards, or of a shard, bytes."""


@dataclass(frozen=True)
class MeshStates:
    """Meshes of the contacts of a set."""

    numbers: np.ndarray
    """(k,) int64, numbers of the contacts."""
    states: np.ndarray
    """(k, 1 + images per contact, n, 3) float32, m, sensor frame: after the approach, then at each image."""

    def by_contact(self) -> dict[int, np.ndarray]:
        """Return the states (1 + images per contact, n, 3) by the number of the contact."""
        return dict(zip(self.numbers.tolist(), self.states, strict=True))


def mesh_states_bytes(configuration: Configuration) -> int:
    """Return the size of the meshes of a contact in mesh.npz, bytes."""
    return 4 * int(np.prod(_shape(configuration)))


def _shape(configuration: Configuration) -> tuple[int, int, int]:
    mesh = build_mesh(configuration.design.shape, configuration.fidelity.mesh)
    return 1 + configuration.snapshots_per_contact, len(mesh.vertices), 3


def pack_mesh_states(configuration: Configuration, numbers: Sequence[int], states: Sequence[np.ndarray]) -> bytes:
    """Return the content of mesh.npz.

    Args:
        configuration: Configuration of the set or shard.
        numbers: Numbers of the contacts, ascending.
        states: Their states, (1 + images per contact, n, 3) m each.
    """
    data = io.BytesIO()
    np.savez(
        data,
        numbers=np.array(numbers, np.int64),
        states=np.array(states, np.float32).reshape(-1, *_shape(configuration)),
        digest=np.array(configuration.digest()),
    )
    return data.getvalue()


def parse_mesh_states(arrays: dict[str, np.ndarray], meta: dict[str, Any], path: Path) -> MeshStates:
    """Return the meshes in the arrays of a mesh.npz.

    Args:
        arrays: Its arrays.
        meta: meta.json of the set or shard.
        path: The file, for messages.

    Raises:
        TactipError: An array is missing, of another shape or type, or not finite; or it belongs to another configuration.
    """
    numbers, states, digest = (arrays.get(name) for name in ("numbers", "states", "digest"))
    if numbers is None or states is None or digest is None:
        raise TactipError(f"{path} lacks an array: it must have numbers, states and digest")
    expected = (len(numbers) if np.ndim(numbers) == 1 else 0, 1 + meta["configuration"]["snapshots_per_contact"])
    if states.dtype != np.float32 or states.ndim != 4 or states.shape[:2] != expected or states.shape[3] != 3:
        raise TactipError(f"{path}: states must be float32 of shape {(*expected, 'vertices', 3)}, got {states.shape}")
    if numbers.dtype != np.int64 or (np.diff(numbers) <= 0).any():
        raise TactipError(f"{path}: numbers must be ascending integers")
    if not np.isfinite(states).all():
        raise TactipError(f"{path}: states must be finite")
    if str(digest) != meta["digest"]:
        raise TactipError(f"{path} belongs to a set of another configuration")
    return MeshStates(numbers, states)


def read_mesh_states(folder: str | Path, meta: dict[str, Any]) -> MeshStates:
    """Return the meshes of a finished set, those of all its shards. Raises TactipError if it has none or was altered."""
    parts = []
    for part, own in read_parts(folder, meta):
        path = part / "mesh.npz"
        if "mesh.npz" not in own["files"]:
            raise TactipError(f"the set in {folder} has no mesh.npz: make it with --keep-mesh")
        parts.append(parse_mesh_states(parse_arrays(read_unaltered(path, own["files"]["mesh.npz"]), str(path)), own, path))
    shapes = {part.states.shape[1:] for part in parts}
    if len(shapes) > 1:
        raise TactipError(f"the shards of the set in {folder} must have meshes of the same shape, got {sorted(shapes)}")
    return MeshStates(np.concatenate([p.numbers for p in parts]), np.concatenate([p.states for p in parts]))
