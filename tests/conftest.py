"""Shared fixtures that are slow to build."""

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import hypothesis
import pytest

from helpers.quick_workers import forked_workers
from helpers.set_commands import make, run
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.robot import objects
from tactip_twin.tactip_model.presets import design_named

# No deadline: the first call of a cold library is slow, and timings are not tested here. The same examples every time.
hypothesis.settings.register_profile("steady", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("steady")


def pytest_collection_modifyitems(items):
    """Take the time limit off slow tests."""
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(0))


@pytest.fixture(scope="session", autouse=True)
def quick_workers():
    with forked_workers():
        yield


@pytest.fixture(scope="session", autouse=True)
def quick_repairs():
    """Check meshes of many triangles once, such as the project's own, however often they are loaded.

    It takes half a second each time. The same mesh gives the same result, so nothing else changes.
    """
    repaired, known = objects.repaired, {}

    def remembered(mesh, name):
        if len(mesh.faces) < 5000:
            return repaired(mesh, name)
        key = hashlib.sha256(name.encode() + mesh.vertices.tobytes() + mesh.faces.tobytes()).digest()
        if key not in known:
            known[key] = repaired(mesh, name)
        result, notes = known[key]
        return result.copy(), list(notes)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objects, "repaired", remembered)
        yield


@pytest.fixture(scope="session")
def design():
    """Return a nominal tip: symmetries hold for pins on their lattice, not for pins as built."""
    return design_named("nominal-127")


@pytest.fixture(scope="session")
def frictionless(design):
    return replace(design, materials=replace(design.materials, friction=0.0))


@pytest.fixture(scope="session")
def standard():
    return fidelity_named("standard")


@pytest.fixture(scope="session")
def on_surface(design, standard):
    return Press(ContactSimulator(design, "surface", standard))


@pytest.fixture(scope="session")
def on_edge(design, standard):
    return Press(ContactSimulator(design, "edge", standard))


@pytest.fixture(scope="session")
def on_ice(frictionless, standard):
    return Press(ContactSimulator(frictionless, "surface", standard))


class Press:
    """A simulator that takes labels in mm and degrees."""

    def __init__(self, simulator):
        self.simulator = simulator

    def __call__(self, pose, shear=(0, 0, 0, 0, 0, 0)):
        return self.simulator.simulate(from_mm_deg(pose), from_mm_deg(shear))


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Return a finished set of four samples, made by one worker."""
    folder = tmp_path_factory.mktemp("sets") / "whole"
    result = run(make(folder))
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture
def copy(whole, tmp_path):
    return Path(shutil.copytree(whole, tmp_path / "copy"))
