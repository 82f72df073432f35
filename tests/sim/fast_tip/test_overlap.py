"""The overlap of tip and object: turns, mirrors and depths."""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.stimuli import stimulus_named
from tactip_twin.sim.fast_tip.overlap import NEAR_M, OverlapModes, dome_points, overlap_harmonics
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact

RADIUS_M = 20e-3


def harmonics(stimulus, *poses_mm_deg):
    points, found = dome_points(RADIUS_M), []
    for pose in poses_mm_deg:
        T = sensor_in_contact(from_mm_deg(pose))
        found.append(stimulus_named(stimulus).distance(points @ T[:3, :3].T + T[:3, 3]))
    return overlap_harmonics(np.array(found))


def test_straight_press_overlaps_alike_all_round():
    found = harmonics("surface", [0, 0, -2, 0, 0, 0])[0]
    assert np.abs(found[:, 1:]).max() < 1e-5
    # The ring closest to the apex is nearly as deep as the apex; the outermost, at 62 degrees, is far away.
    assert found[0, 0].real > 0.98 * 1e3 * (2e-3 + NEAR_M) * np.sqrt(np.sin(np.radians(1.5)))
    assert found[-1, 0] == 0


def test_turned_tilt_turns_the_overlap_and_a_mirrored_one_conjugates_it():
    angle = 0.7
    tilt = np.array([8.0, 3.0, 0])
    turned = Rotation.from_rotvec([0, 0, angle]).apply(tilt)
    mirrored = tilt * [-1, 1, 1]  # an axial vector, in the plane of x and z
    first, second, third = harmonics("surface", *([0, 0, -3, *t] for t in (tilt, turned, mirrored)))
    orders = np.arange(first.shape[-1])
    # The pose turns in the contact frame; a tilt about a turned axis is a turned field.
    assert np.abs(second - first * np.exp(-1j * angle * orders)).max() < 2e-2
    assert np.abs(third - first.conj()).max() < 1e-5
    assert np.abs(first[:, 1]).max() > 0.1


def test_modes_reproduce_overlaps_and_turn_like_them():
    rng = np.random.default_rng(0)
    poses = [[rng.uniform(-4, 4), 0, rng.uniform(-5, -1), *rng.uniform(-12, 12, 2), rng.uniform(-40, 40)] for _ in range(60)]
    found = harmonics("edge", *poses)
    modes = OverlapModes.fit(found, 260)
    modes.check()
    coefficients = modes.coefficients(found)
    assert np.allclose((np.abs(coefficients) ** 2).sum(1), (np.abs(found) ** 2).sum((1, 2)), rtol=1e-4)
    angles = rng.uniform(-3, 3, 60)
    turned = found * np.exp(-1j * np.multiply.outer(angles, np.arange(found.shape[-1])))[:, None]
    assert np.allclose(modes.coefficients(turned), modes.turned(coefficients, angles), atol=1e-4)
