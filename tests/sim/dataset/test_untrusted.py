"""Contacts that fail their checks are simulated again, then listed; too steep motions are not simulated."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest

from helpers.set_commands import configuration
from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named, finer
from tactip_twin.sim.contact.limits import exceeds_max_tilt
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.retries import TRIES, RetryingSimulator
from tactip_twin.sim.dataset import contact_sample
from tactip_twin.sim.dataset import generate as generation
from tactip_twin.sim.dataset.generate import Job
from tactip_twin.sim.dataset.sampling import SHEAR_RANGES, Ranges, generator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError


def test_failing_contact_is_repeated_then_listed(design, tmp_path):
    """No contact meets a penetration limit of a nanometre: all are repeated, left out, and listed with the reason."""
    job = Job(configuration(design, bounds=QualityLimits(penetration_m=1e-9)), tmp_path / "failed")
    (result,) = generation.make([job], workers=1, log=lambda line: None)
    assert result["kept"] == 0
    meta = json.loads((job.folder / "meta.json").read_text())
    assert [f["index"] for f in meta["failures"]] == [0, 1, 2]
    assert all(len(f["tries"]) == TRIES and "inside the skin" in f["tries"][-1][0] for f in meta["failures"])
    assert list((job.folder / "images").iterdir()) == []
    assert tactip.main(["dataset", "verify", str(job.folder)]) == 0


def test_second_attempt_has_finer_steps(design):
    """With a limit between the penetrations of the two tries, the contact passes, and its row says that it took two
    tries."""
    draft = fidelity_named("draft")
    pose, shear = from_mm_deg([0, 0, -5, 10, 0, 0]), np.zeros(6)
    coarse, fine = (
        RetryingSimulator(design, "surface", f, QualityLimits()).simulate(pose, shear)[0] for f in (draft, finer(draft))
    )
    between = (coarse.penetration_m + fine.penetration_m) / 2
    contact, violations = RetryingSimulator(design, "surface", draft, QualityLimits(penetration_m=between)).simulate(
        pose, shear
    )
    assert len(violations) == 1
    assert contact.penetration_m == fine.penetration_m


def warn():
    """Have MuJoCo warn in this thread."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[0] = np.nan
    mujoco.mj_step(model, data)


def test_warnings_are_those_of_the_thread_that_counts_them():
    """Two threads count at the same time, and the first to begin ends first: each gets its own warnings, and the previous
    handler is restored."""
    others, theirs, both, ours_over = [], [], threading.Barrier(2, timeout=60), threading.Event()

    def count():
        with counted_warnings() as messages:
            both.wait()
            warn()
            both.wait()
            assert ours_over.wait(60)
            warn()
            theirs.extend(messages)

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(others.append)
    try:
        thread = threading.Thread(target=count)
        with counted_warnings() as ours:
            thread.start()
            both.wait()
            warn()
            warn()
            both.wait()
        ours_over.set()
        thread.join()
        assert (len(ours), len(theirs), len(others)) == (2, 2, 0)
        warn()
        assert len(others) == 1
    finally:
        mujoco.set_mju_user_warning(before)


def test_warnings_of_a_thread_that_counts_none_are_everybodys():
    begun, over = threading.Barrier(3, timeout=60), threading.Event()

    def count():
        with counted_warnings() as messages:
            begun.wait()
            assert over.wait(60)
            return len(messages)

    with ThreadPoolExecutor(2) as pool:
        counts = [pool.submit(count) for _ in range(2)]
        begun.wait()
        warn()
        over.set()
        assert [c.result() for c in counts] == [1, 1]


def test_diverged_state_is_a_violation(on_surface):
    from dataclasses import replace

    contact = on_surface([0, 0, -2, 0, 0, 0])
    assert contact.violations(QualityLimits()) == []
    broken = replace(contact, pin_tips=np.where(contact.pin_tips == contact.pin_tips.max(), np.nan, contact.pin_tips))
    assert "not finite" in broken.violations(QualityLimits())[0]
    assert "shrank" in replace(contact, volume_ratio=-0.2).violations(QualityLimits())[0]
    assert "mm/s" in replace(contact, speed_m_s=1.0).violations(QualityLimits())[0]


def test_exploding_state_is_detected(design, monkeypatch):
    """A NaN in one vertex during a press must appear in the record; the simulation must not restart from the undeformed
    tip."""
    simulator = RetryingSimulator(design, "surface", fidelity_named("draft"), QualityLimits())
    scene = simulator._simulators[0].scene
    place, steps = scene.place, []

    def poisoned(*where):
        place(*where)
        steps.append(where)
        if len(steps) == 4:
            scene.data.qpos[100] = np.nan

    monkeypatch.setattr(scene, "place", poisoned)
    contact, violations = simulator.simulate(from_mm_deg([0, 0, -3, 0, 0, 0]), np.zeros(6))
    assert violations == [["the state is not finite"]]
    assert contact.violations(QualityLimits()) == []  # the second try is another scene, and good


def test_too_steep_motion_is_sampled_again(design):
    """±20 degrees about both axes and the shear exceed the cone of 30 degrees in the corners only; samples inside it are
    unchanged, so sets with narrower ranges keep their bytes."""
    wide = Ranges(depth_mm=(-5, -1), roll_deg=(-20, 20), pitch_deg=(-20, 20))
    c = configuration(design, pose=wide)
    again = 0
    for number in range(400):
        draw, given = generator(0, "surface", "train", number), contact_sample.sample_contact(c, number)
        assert not exceeds_max_tilt(given.pose, given.shear)
        pose, shear = wide.sample(draw), SHEAR_RANGES.sample(draw)
        again += exceeds_max_tilt(pose, shear)
        assert exceeds_max_tilt(pose, shear) or ((given.pose == pose).all() and (given.shear == shear).all())
    assert 0 < again < 20
    gentle = configuration(design)
    assert not any(
        exceeds_max_tilt(d.pose, d.shear) for d in (contact_sample.sample_contact(gentle, number) for number in range(50))
    )


def test_ranges_that_are_too_steep_throughout_are_refused(design, tmp_path):
    c = configuration(design, pose=Ranges(depth_mm=(-3, -1), roll_deg=(25, 28), pitch_deg=(25, 28)))
    with pytest.raises(TactipError, match="sampled from the ranges tilt by more than 30 degrees"):
        generation.make([Job(c, tmp_path / "steep")], workers=1, log=lambda line: None)
    assert not (tmp_path / "steep").exists()
