"""Blocks whose top follows a profile."""

import numpy as np
import trimesh


def profiled_block(profile_mm, floor_mm=-40.0, width_mm=120.0):
    """Return a closed mesh, m, of a block along y whose top is a line of points (x, z), mm, with rising x."""
    top = np.array(profile_mm, float) / 1e3
    count = len(top)
    bottom = np.column_stack([top[:, 0], np.full(count, floor_mm / 1e3)])
    outline = np.concatenate([top, bottom])
    ends = [np.insert(outline, 1, y, axis=1) for y in (-width_mm / 2e3, width_mm / 2e3)]
    quads = [(k, k + 1, count + k + 1, count + k) for k in range(count - 1)]
    ring = [*range(count), *range(2 * count - 1, count - 1, -1)]
    after = np.roll(ring, -1)
    quads = [*quads, *(tuple(2 * count + i for i in reversed(quad)) for quad in quads)]
    quads += [(b, a, 2 * count + a, 2 * count + b) for a, b in zip(ring, after, strict=True)]
    faces = [half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))]
    mesh = trimesh.Trimesh(np.concatenate(ends), faces, process=False)
    mesh.fix_normals()
    assert mesh.is_watertight
    return mesh
