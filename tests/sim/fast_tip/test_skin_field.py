"""Modes of the skin: turns and mirrors are exact, and the pins are those of the deformed mesh."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.fast_tip.skin_field import Modes, SkinSampler
from tactip_twin.sim.pose import FACING
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.pins import PinReader, pin_lever_m


@pytest.fixture(scope="module")
def mesh(design):
    return build_mesh(design.shape, fidelity_named("standard").mesh)


@pytest.fixture(scope="module")
def skins(mesh):
    """Return smooth deformations (8, s, 3), m: random quadratic fields that vanish at the rim."""
    rng = np.random.default_rng(0)
    x = (mesh.vertices - mesh.centre)[: mesh.surface_count] / 20e-3
    terms = np.stack([np.ones(len(x)), *x.T, x[:, 0] * x[:, 1], x[:, 0] ** 2, x[:, 1] ** 2], 1) * x[:, 2:]
    return mesh.vertices[: mesh.surface_count] + 1e-3 * np.einsum("st,ktc->ksc", terms, rng.normal(size=(8, 7, 3)))


def turned(vectors, angle):
    """Return vectors (..., 3) of the sensor frame turned by an angle about z of the label axes."""
    return Rotation.from_rotvec([0, 0, angle]).apply((vectors @ FACING).reshape(-1, 3)).reshape(vectors.shape) @ FACING


@pytest.mark.parametrize("angle", [0.3, -1.9])
def test_turned_deformation_has_turned_coefficients(mesh, skins, angle):
    rotated = replace(mesh, vertices=turned(mesh.vertices, angle))
    modes = Modes.fit(SkinSampler(mesh).harmonics(skins), 60)
    plain = modes.coefficients(SkinSampler(mesh).harmonics(skins))
    of_turned = modes.coefficients(SkinSampler(rotated).harmonics(turned(skins, angle)))
    expected = modes.turned(plain, np.full(len(skins), angle))
    assert np.abs(of_turned - expected).max() < 5e-3 * np.abs(plain).max()


def test_mirrored_deformation_has_conjugate_coefficients(mesh, skins):
    mirror = np.diag([1.0, -1.0, 1.0])
    reflected = replace(mesh, vertices=mesh.vertices @ mirror, triangles=mesh.triangles[:, ::-1])
    modes = Modes.fit(SkinSampler(mesh).harmonics(skins), 60)
    plain = modes.coefficients(SkinSampler(mesh).harmonics(skins))
    of_mirrored = modes.coefficients(SkinSampler(reflected).harmonics(skins @ mirror))
    assert np.abs(of_mirrored - plain.conj()).max() < 5e-3 * np.abs(plain).max()


def test_pins_of_modes_are_those_of_the_mesh(design, mesh, skins):
    reader = PinReader(design, mesh)
    expected, _ = reader.read(skins)
    modes = Modes.fit(SkinSampler(mesh).harmonics(skins), 200)
    coefficients = modes.coefficients(SkinSampler(mesh).harmonics(skins))
    moved, changed = modes.at(-reader.directions)
    parts = np.concatenate([coefficients.real, coefficients.imag], 1)
    tips = reader.pin_tips + np.einsum("kn,npi->kpi", parts, moved - pin_lever_m(design) * changed)
    error = np.linalg.norm(tips - expected, axis=-1)
    assert error.mean() < 0.01e-3
    assert np.linalg.norm(expected - reader.pin_tips, axis=-1).mean() > 0.5e-3


def test_profiles_of_an_order_are_orthonormal(mesh, skins):
    modes = Modes.fit(SkinSampler(mesh).harmonics(skins), 60)
    for order in np.unique(modes.orders):
        profiles = modes.profiles[modes.orders == order]
        assert np.allclose(profiles @ profiles.T, np.eye(len(profiles)), atol=1e-9)
