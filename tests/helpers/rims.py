"""Files of rims."""

import numpy as np
import trimesh

from tactip_twin.assets.meshes.make import write


def write_coarse_rim(name, rim, folder):
    """Write the mesh of a rim, and its edge, with a tenth of the triangles of the project's own."""
    turn = np.linspace(0, 2 * np.pi, 181)
    edge = np.column_stack([rim.edge(turn), rim.frames(turn)[1]])
    write(name, trimesh.Trimesh(*rim.mesh(sectors=60), process=False), edge, folder)
