"""Simulation of a rig's moves: pins at fractions of each move, and the fraction at which they match a frame best.

An image is not always taken at the pose of its label: cameras lag, so some frames show the tip before or during the move.
The finished fraction of the move is therefore estimated from each frame.

The functions `simulate_…` run in other processes: they get everything as one argument, and they keep their simulators,
because meshing is slow. At the fidelity FAST, a learned tip that knows any materials predicts the contacts.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder, any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.materials import check_mechanics, material_inputs
from tactip_twin.sim.fast_tip.mesh_decoder import MeshDecoder
from tactip_twin.sim.pose import before_shear, path, shear_between
from tactip_twin.sim2real.calibration.rig import Rig, RigMotion
from tactip_twin.tactip_model.design import Design, TipGeometry
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.neutral_image import reference_pixels
from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.pins import PinReader

FAST = "fast"
"""Fidelity of contacts that a learned tip predicts, on the mesh of `standard`."""

MOVE_FRACTIONS = np.linspace(0, 1, 6)
"""Fractions of a move at which a contact is simulated; in between, pins are interpolated linearly."""

LOAD_CELL_N = {1e-3: 0.21, 2e-3: 0.8, 3e-3: 1.85}
"""Normal force, N, of a TacTip on a flat surface by depth, m [R: a load cell under an aerial TacTip]. Images determine the
ratio of the two moduli but not their magnitude; forces do."""

Commands = Sequence[tuple[np.ndarray, np.ndarray]]
"""Pairs of pose and move, (6,) each, m and rad, in the rig's frame."""


@lru_cache(maxsize=4)
def _simulator(design: Design, fidelity: str) -> ContactSimulator:
    return ContactSimulator(design, "surface", fidelity_named(fidelity))


def _mechanical(design: Design) -> Design:
    """Return a design reduced to what the mechanics depend on, so simulators can be shared."""
    return Design(design.name, shape=design.shape, materials=design.materials)


def _skin(simulator: ContactSimulator) -> np.ndarray:
    return simulator.scene.vertices()[: simulator.scene.mesh.surface_count]


@lru_cache(maxsize=1)
def _learned_tip() -> FastTip:
    return read_fast_tip(any_materials("surface"))


def can_predict(design: Design) -> bool:
    """Return whether the learned tip predicts contacts of a design, whatever its moduli, thickness and friction."""
    learned = _learned_tip().mechanics
    try:
        check_mechanics(learned, design)
    except TactipError:
        return False
    return True


@lru_cache(maxsize=1)
def _skin_decoder(shape: TipGeometry) -> MeshDecoder:
    resolution = fidelity_named("standard").mesh
    return MeshDecoder(build_mesh(shape, resolution), resolution.poisson_limit, _learned_tip().modes)


def _learned_materials(design: Design) -> np.ndarray:
    """Return the inputs (6,) of a design's materials, or the nearest that the learned tip knows."""
    tip = _learned_tip()
    if tip.materials is None:
        raise ValueError("the learned tip must know any materials")
    return np.clip(material_inputs(design.materials), *tip.materials.T)


def _predicted(design: Design, contacts: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the skins (n, s, 3) m of contacts, pairs of pose and shear (6,)."""
    poses, shears = (np.array(part) for part in zip(*contacts, strict=True))
    coefficients, _ = _learned_tip().coefficients(poses, shears, _learned_materials(design))
    return _skin_decoder(design.shape).skin(coefficients)


def simulate_at(job: tuple[Design, Rig, str, Commands, np.ndarray, Sequence[float] | np.ndarray]) -> np.ndarray:
    """Return the skins (n, s, 3) m of contacts.

    Args:
        job: Design, rig, fidelity, n commands, tap (6,), and the finished fraction of each move (n,).
    """
    design, rig, fidelity, commands, tap, fractions = job
    motion = RigMotion(rig)
    contacts = [
        motion.contact(pose, move, tap, fraction) for (pose, move), fraction in zip(commands, fractions, strict=True)
    ]
    if fidelity == FAST:
        return _predicted(design, contacts)
    simulator, skins = _simulator(_mechanical(design), fidelity), []
    for contact in contacts:
        simulator.simulate(*contact)
        skins.append(_skin(simulator))
    return np.array(skins)


def simulate_along(job: tuple[Design, Rig, str, Commands, np.ndarray]) -> np.ndarray:
    """Return the skins (n, MOVE_FRACTIONS, s, 3) m of contacts at each fraction of the move.

    Args:
        job: As of `simulate_at`, without the fractions.
    """
    design, rig, fidelity, commands, tap = job
    motion = RigMotion(rig)
    contacts = [motion.contact(pose, move, tap) for pose, move in commands]
    if fidelity == FAST:
        return predict_along(design, contacts)
    simulator = _simulator(_mechanical(design), fidelity)
    return np.array(
        [[_skin(simulator) for _ in simulator.simulate_partial_shears(*contact, MOVE_FRACTIONS)] for contact in contacts]
    )


def predict_along(design: Design, contacts: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the skins (n, MOVE_FRACTIONS, s, 3) m at each fraction of the shear, as the learned tip predicts them.

    Args:
        design: Design that the learned tip knows (`can_predict`).
        contacts: n pairs of pose and shear (6,), m and rad.
    """
    partial = [part for contact in contacts for part in _partial_shears(*contact)]
    return _predicted(design, partial).reshape(len(contacts), len(MOVE_FRACTIONS), -1, 3)


def _partial_shears(pose: np.ndarray, shear: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the pose and the shear so far, (6,) each, at each fraction of a contact's shear."""
    start = before_shear(pose, shear)
    return [(label, shear_between(start, label)) for label in path(start, pose, MOVE_FRACTIONS)]


def simulate_forces(job: tuple[Design, str]) -> np.ndarray:
    """Return the normal forces (3,) N at the depths of LOAD_CELL_N.

    Args:
        job: Design and fidelity.
    """
    if job[1] == FAST:
        poses = np.array([[0, 0, -depth, 0, 0, 0] for depth in LOAD_CELL_N])
        decoder = PinDecoder(job[0], _learned_tip().modes)
        return _learned_tip().predict(decoder, poses, np.zeros((3, 6)), _learned_materials(job[0])).normal_forces_n
    simulator = _simulator(_mechanical(job[0]), job[1])
    return np.array([simulator.simulate([0, 0, -depth, 0, 0, 0], np.zeros(6)).normal_force_n for depth in LOAD_CELL_N])


def pin_pixels(design: Design, fidelity: str, skins: np.ndarray) -> np.ndarray:
    """Return the image positions (..., p, 2), px of 256, of a design's pins, given skins (..., s, 3) m of the mesh of a
    fidelity."""
    lens = Lens(design)
    resolution = fidelity_named("standard" if fidelity == FAST else fidelity).mesh
    tips, _ = PinReader(design, build_mesh(design.shape, resolution)).read(skins)
    return reference_pixels(lens.project(tips), lens.width)


def distances(predicted: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the root mean square distance (...,) px of predicted from detected pins (..., p, 2), over the detected ones."""
    return np.sqrt(np.nanmean(((predicted - seen) ** 2).sum(-1), -1))


def best_fraction(along: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the fraction of each move at which simulated pins are nearest to detected ones.

    Args:
        along: (n, MOVE_FRACTIONS, p, 2) px, simulated pins at each fraction of each move.
        seen: (n, p, 2) px, detected pins; NaN where one is not detected.

    Returns:
        The fractions (n,), the simulated pins there (n, p, 2) px, and their derivative by the fraction (n, p, 2) px, which
        is 0 where the fraction is at an end of its range.
    """
    fine = np.linspace(0, 1, 51)
    left = np.minimum((fine * (len(MOVE_FRACTIONS) - 1)).astype(int), len(MOVE_FRACTIONS) - 2)
    weight = (fine * (len(MOVE_FRACTIONS) - 1) - left)[:, None, None]
    fractions, pins, tangents = np.empty(len(seen)), np.empty_like(seen), np.zeros_like(seen)
    for i, stage in enumerate(along):
        between = (1 - weight) * stage[left] + weight * stage[left + 1]
        best = distances(between, seen[i]).argmin()
        fractions[i], pins[i] = fine[best], between[best]
        if 0 < best < len(fine) - 1:
            tangents[i] = stage[left[best] + 1] - stage[left[best]]
    return fractions, pins, tangents
