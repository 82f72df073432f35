"""Teaching of a sliding tip: resuming, its file, and contacts that slide as it predicts."""

import numpy as np
import pytest
import torch

from helpers.set_commands import contents
from tactip_twin.commands import main as tactip
from tactip_twin.learning import sliding_tip_training
from tactip_twin.learning.sliding_paths import read_paths
from tactip_twin.learning.sliding_tip_settings import SlidingTipSettings
from tactip_twin.learning.sliding_tip_training import SLIDING_TIP, sliding_tip_errors, train_sliding_tip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.interactive import InteractiveContact
from tactip_twin.sim.contact.stimuli import stimulus_named
from tactip_twin.sim.dataset.format import read_meta, read_rows
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.sim.dataset.sliding import SlidingPath
from tactip_twin.sim.fast_tip.corrected_contacts import MAX_STEPS
from tactip_twin.sim.fast_tip.fast_interactive import FastInteractiveContact
from tactip_twin.sim.fast_tip.fast_tip import shipped_fast_tip
from tactip_twin.sim.fast_tip.sliding_contact import SlidingContact, TouchedObject
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.presets import design_named

SETTINGS = SlidingTipSettings(modes=20, state_modes=10, overlap_modes=8, width=24, steps=150, batch=64, trusted_fraction=1.0)
MAKE = ["dataset", "make", "--fidelity", "draft", "--renderer", "raster", "--workers", "2"]
OPTIONS = [
    *("--modes", "20", "--state-modes", "10", "--overlap-modes", "8", "--width", "24", "--steps", "150"),
    *("--batch", "64", "--trusted-fraction", "1", "--threads", "1"),
]


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    slides = ["--snapshots-per-contact", "5", "--keep-mesh"]
    curved = ["--curvature-per-m", "-20", "60", "--varying-curvature-fraction", "0.5"]
    for name, samples, options in (("train", 30, []), ("curved", 15, curved), ("val", 15, ["--split", "val"])):
        assert tactip.main([*MAKE, *slides, *options, "--samples", str(samples), "--out", str(folder / name)]) == 0
    return folder


@pytest.fixture(scope="module")
def taught(sets, tmp_path_factory):
    out = tmp_path_factory.mktemp("tip") / "tip"
    arguments = [str(sets / "train"), str(sets / "curved"), "--val", str(sets / "val"), "--out", str(out), *OPTIONS]
    assert tactip.main(["sliding-tip", *arguments]) == 0
    return out / SLIDING_TIP


def test_tip_is_closer_to_the_simulation_than_the_state_before(taught, sets):
    tip, paths = read_sliding_tip(taught), read_paths([sets / "val"])
    errors = tip.provenance["errors"]
    before = tip.modes.coefficients(paths.harmonics[:, 1]) - tip.modes.coefficients(paths.harmonics[:, 0])
    still = np.sqrt((np.abs(before) ** 2).sum(1).mean() / 15)
    assert 0 < errors["step_mm"] < still
    assert errors["slide_mm"] < 0.6
    assert errors["force"] < 0.5
    assert sliding_tip_errors(tip, paths) == pytest.approx(errors)


def test_interrupted_teaching_resumes_to_the_same_bytes(taught, sets, tmp_path, monkeypatch):
    train, calls = sliding_tip_training._train, []

    def stopped(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise Interrupted("stopped")
        return train(*arguments)

    torch.set_num_threads(1)
    monkeypatch.setattr(sliding_tip_training, "_train", stopped)
    arguments = [sets / "train", sets / "curved"], [sets / "val"], SETTINGS, tmp_path / "tip"
    with pytest.raises(Interrupted):
        train_sliding_tip(*arguments, quiet=True)
    train_sliding_tip(*arguments, quiet=True)
    assert len(calls) == 4  # two, of which one was interrupted, then the two that were missing
    assert (tmp_path / "tip" / SLIDING_TIP).read_bytes() == taught.read_bytes()


def test_sets_without_paths_are_refused(sets, tmp_path, capsys):
    plain = tmp_path / "plain"
    assert tactip.main([*MAKE, "--samples", "2", "--keep-mesh", "--out", str(plain)]) == 0
    assert tactip.main(["sliding-tip", str(plain), "--val", str(plain), "--out", str(tmp_path / "tip")]) == 1
    assert "make it with --snapshots-per-contact of at least 2" in capsys.readouterr().err
    assert tactip.main(["sliding-tip", "--val", str(plain), "--out", str(tmp_path / "tip")]) == 1
    assert "training sets must be at least one (name their folders), got 0" in capsys.readouterr().err


def contact_of(path, **changes):
    tip, draft = read_sliding_tip(path), fidelity_named("draft")
    stimulus = stimulus_named("surface")
    pose = from_mm_deg([0, 0, -3, 2, -4, 0])
    walk = SlidingPath("surface", None, POSE_RANGES["surface"], pose, np.random.default_rng(3))
    design = changes.pop("design", design_named("tactip-127"))
    contact = SlidingContact(tip, design, TouchedObject(stimulus, walk.truth, stimulus.distance), draft, **changes)
    return contact, walk, pose


def above(pose):
    return sensor_in_contact(pose + from_mm_deg([0, 0, 3.5, 0, 0, 0]))


def test_predicted_slide_stays_near_the_simulated_one(taught, monkeypatch):
    predicted, walk, pose = contact_of(taught)
    simulated, _, _ = contact_of(taught)
    monkeypatch.setattr(simulated, "_tip", Untrusted(read_sliding_tip(taught)))
    for contact in (predicted, simulated):
        contact.reset_to(above(pose))
        assert contact.contact.steps == 0
    poses = [sensor_in_contact(pose), *(sensor_in_contact(walk.stride()) for _ in range(5))]
    apart, moved = [], []
    for T in poses:
        a, b = predicted.move(T), simulated.move(T)
        apart.append(np.linalg.norm(a.pin_tips - b.pin_tips, axis=1).mean())
        moved.append(np.linalg.norm(b.pin_tips - predicted._undeformed.pin_tips, axis=1).mean())
        assert b.steps > 0
        assert np.isfinite(b.penetration_m)
    assert simulated.simulated_motions == simulated.motions >= 6
    assert predicted.simulated_motions < predicted.motions
    assert np.mean(apart) < 0.5 * np.mean(moved)
    lifted = predicted.move(above(pose))
    assert np.array_equal(lifted.pin_tips, predicted._undeformed.pin_tips)
    assert not lifted.force_n.any()


class Untrusted:
    """A sliding tip none of whose predictions can be trusted."""

    def __init__(self, tip):
        self._tip = tip

    def __getattr__(self, name):
        return getattr(self._tip, name)

    def step(self, steps, states):
        return self._tip.step(steps, states)._replace(trusted=np.zeros(len(states), bool))


def test_corrected_slide_passes_its_checks(taught):
    contact, walk, pose = contact_of(taught, corrected=True)
    contact.reset_to(above(pose))
    contact.move(sensor_in_contact(pose))
    for _ in range(3):
        state = contact.move(sensor_in_contact(walk.stride()))
        assert state.steps > 0
        assert state.penetration_m < 0.15e-3


@pytest.mark.slow
def test_predicted_set_of_slides_is_the_same_with_any_worker_count(taught, tmp_path):
    make = ["dataset", "make", "--fast-tip", str(taught), "--renderer", "raster", "--samples", "48"]
    make += ["--snapshots-per-contact", "3", "--curvature-per-m", "-20", "60", "--augment-symmetry"]
    for name, fidelity, workers in (("a", "fast", "1"), ("b", "fast", "2"), ("c", "corrected", "1")):
        assert tactip.main([*make, "--fidelity", fidelity, "--workers", workers, "--out", str(tmp_path / name)]) == 0
        assert tactip.main(["dataset", "verify", str(tmp_path / name)]) == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    predicted, corrected = (
        [int(row["steps"]) for row in read_rows(tmp_path / name, read_meta(tmp_path / name))] for name in "ac"
    )
    assert min(len(predicted), len(corrected)) > 24
    assert min(predicted) == 0 < min(corrected) <= MAX_STEPS


def test_slides_need_a_tip_that_slides(tmp_path, capsys):
    tip = str(shipped_fast_tip("surface", "tactip-127"))
    make = ["dataset", "make", "--fidelity", "fast", "--fast-tip", tip, "--snapshots-per-contact", "3"]
    assert tactip.main([*make, "--out", str(tmp_path / "set")]) == 1
    assert "must be a file of the format 'tactip-twin sliding tip'" in capsys.readouterr().err


def test_tip_of_another_design_is_refused(taught):
    with pytest.raises(TactipError, match="the learned tip belongs to"):
        contact_of(taught, design=design_named("tactip-331"))


def test_live_contact_moves_as_predicted(taught):
    target = from_mm_deg([0, 0, -3, 2, -4, 0])
    live = FastInteractiveContact(read_sliding_tip(taught), design_named("tactip-127"), fidelity_named("draft"), target)
    above = live.tip_state()
    assert not live.at_rest
    assert not above.force.any()
    for _ in range(60):
        state = live.advance(3)
        if live.at_rest:
            break
    assert live.at_rest
    assert np.linalg.norm(state.force) > 0.5
    simulated = InteractiveContact(design_named("tactip-127"), "surface", fidelity_named("draft"), target)
    while not simulated.at_rest:
        true = simulated.advance(3)
    moved = np.linalg.norm(true.pin_tips - above.pin_tips, axis=1).mean()
    assert np.linalg.norm(state.pin_tips - true.pin_tips, axis=1).mean() < 0.5 * moved
    live.lift()
    assert np.array_equal(live.tip_state().pin_tips, above.pin_tips)
