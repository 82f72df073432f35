"""A hidden twin is found from its frames and its rig's commands."""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from helpers.rig_sets import RIG, TAP, hidden_twin, write_set
from tactip_twin.commands import main as tactip
from tactip_twin.sim2real.calibration.fit import calibrate
from tactip_twin.sim2real.calibration.frames import Frames
from tactip_twin.sim2real.calibration.moves import (
    FAST,
    LOAD_CELL_N,
    MOVE_FRACTIONS,
    best_fraction,
    can_predict,
    distances,
    pin_pixels,
    simulate_along,
    simulate_at,
    simulate_forces,
)
from tactip_twin.sim2real.calibration.parameters import SensorOnRig, parameters
from tactip_twin.sim2real.calibration.report import figures_of, write_report
from tactip_twin.sim2real.calibration.rounds import Calibrator, robust_cost
from tactip_twin.sim2real.calibration.settings import Settings
from tactip_twin.tactip_model.design_file import read_design, read_design_with_drift
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px, with_pin_offsets
from tactip_twin.tactip_model.presets import design_named


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    folder = tmp_path_factory.mktemp("real") / "set"
    write_set(folder, hidden_twin(), 48)
    return folder


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """A set of as few frames as a fit and a test take."""
    folder = tmp_path_factory.mktemp("few") / "set"
    write_set(folder, hidden_twin(), 20)
    return folder


def start():
    return replace(design_named("nominal-127"), name="mine")


def test_parameter_reads_what_it_writes_within_bounds():
    twin = SensorOnRig(start(), RIG)
    twin = next(p for p in parameters(start()) if p.name == "kinetic_fraction").write(twin, 0.6)
    for p in parameters(start()):
        assert p.low <= p.read(twin) <= p.high
        moved = p.moved(twin, 0.5)
        assert p.read(moved) != p.read(twin)
        assert sum(q.read(moved) != q.read(twin) for q in parameters(start())) == 1
        assert p.read(p.write(twin, 1e9)) == p.high and p.read(p.write(twin, -1e9)) == p.low, p.name


def test_best_fraction_finds_interpolated_stage():
    stages = np.zeros((1, len(MOVE_FRACTIONS), 5, 2))
    stages[0, :, :, 0] = 10 * MOVE_FRACTIONS[:, None] ** 2
    seen = np.full((1, 5, 2), np.nan)
    seen[0, :3] = [[4.4, 0.0]] * 3  # between 0.6 (3.6) and 0.8 (6.4)
    fraction, pins, tangents = best_fraction(stages, seen)
    assert fraction[0] == pytest.approx(0.66, abs=0.011)
    assert np.allclose(tangents[0, :, 0], 6.4 - 3.6)
    assert distances(pins, seen)[0] < 0.15


def test_best_fraction_at_end_has_no_tangent():
    stages = np.zeros((1, len(MOVE_FRACTIONS), 5, 2))
    stages[0, :, :, 0] = 10 * MOVE_FRACTIONS[:, None]
    fraction, _, tangents = best_fraction(stages, np.full((1, 5, 2), 11.0))
    assert fraction[0] == 1
    assert not tangents.any()


def test_robust_cost_of_outliers_is_linear():
    assert robust_cost(np.array([0.5, 0.5])) == pytest.approx(0.25)
    assert robust_cost(np.array([3.0])) - robust_cost(np.array([2.0])) == pytest.approx(
        robust_cost(np.array([4.0])) - robust_cost(np.array([3.0]))
    )


@pytest.mark.slow
def test_calibrate_rounds_lower_cost_and_resume(real, tmp_path):
    """Two frames of each kind suffice to check the signs of the derivatives."""
    log = []
    settings = Settings(fit_frames=10, test_frames=10, rounds=("draft", "draft"), test_fidelity="draft")
    result = calibrate(real, start(), settings, tmp_path / "state.json", log.append)
    assert result.rounds[1]["rms_px"] < 0.7 * result.rounds[0]["rms_px"]
    for figures in result.rounds:
        assert figures["cost_after"] <= figures["cost_before"]
        assert figures["search"]["cost_after"] <= figures["search"]["cost_before"] <= figures["cost_after"] * (1 + 1e-9)
    assert abs((result.twin.rig.azimuth_deg - RIG.azimuth_deg + 180) % 360 - 180) < 4
    # Interrupted after the first round and resumed, it gives the same result.
    state = json.loads((tmp_path / "state.json").read_text())
    again = []
    same = calibrate(real, start(), settings, tmp_path / "state.json", again.append)
    assert "resuming after round 2 of 2" in again
    assert same.twin == result.twin
    assert json.loads((tmp_path / "state.json").read_text()) == state
    with pytest.raises(
        TactipError, match=r"holds a calibration with other settings \(settings.fit_frames is 10 there, 12 here\)"
    ):
        calibrate(real, start(), replace(settings, fit_frames=12), tmp_path / "state.json")
    (tmp_path / "state.json").write_text("{")
    with pytest.raises(TactipError, match="remove it"):
        calibrate(real, start(), settings, tmp_path / "state.json")


def test_predicted_moves_are_close_to_simulated_ones():
    commands = [(np.array([0, -1e-3, 0, 0, 0, 0.1]), np.array([2e-3, 0, 0, 0, 0, 0.05]))]
    design, tap = design_named("tactip-331"), np.asarray(TAP, float)
    jobs = {name: (design, RIG, name, commands, tap) for name in (FAST, "standard")}
    predicted, simulated = (pin_pixels(design, name, simulate_along(job)) for name, job in jobs.items())
    assert predicted.shape == simulated.shape
    assert distances(predicted, simulated).max() < 0.6  # px of 256; the move itself shifts pins by several
    assert np.linalg.norm(simulated[0, -1] - simulated[0, 0], axis=-1).mean() > 2
    again = simulate_at((design, RIG, FAST, commands, tap, [1.0]))
    assert np.allclose(pin_pixels(design, FAST, again)[0], predicted[0, -1], atol=1e-3)
    assert np.allclose(simulate_forces((design, FAST)), simulate_forces((design, "standard")), rtol=0.05)


def test_tips_of_another_shape_are_not_predicted():
    design = design_named("tactip-127")
    assert can_predict(design)
    assert not can_predict(replace(design, shape=replace(design.shape, radius_m=22e-3)))


@pytest.mark.slow
def test_calibrate_recovers_hidden_sensor(real, tmp_path):
    """It finds the mechanics from frames of which half were taken before the end of their move."""
    settings = Settings(fit_frames=24, test_frames=24, rounds=("draft",) * 4, test_fidelity="draft")
    result = calibrate(real, start(), settings, tmp_path / "state.json", print)
    found, hidden = result.twin, hidden_twin()
    figures = figures_of(result)
    assert figures["frames_px"]["fitted_fraction"]["median"] < 0.35
    assert figures["depth"]["rms_px"] < 0.2
    close = {"azimuth": 1.5, "depth_zero": 0.12e-3, "tcp_behind_apex": 3e-3, "tilt_zero_x": 0.6, "tilt_zero_y": 0.6}
    close |= {"friction": 0.12, "pin_length": 0.25e-3, "zoom": 0.003}
    for p in parameters(start()):
        if p.name in close:
            difference = p.read(found) - p.read(hidden)
            if p.name == "azimuth":
                difference = (difference + 180) % 360 - 180
            assert abs(difference) < close[p.name], (p.name, p.read(found), p.read(hidden))
    ratio = [t.design.materials.skin_young_pa / t.design.materials.gel_young_pa for t in (found, hidden)]
    assert 0.6 < ratio[0] / ratio[1] < 1.6
    write_report(result, "hidden", settings, tmp_path / "d.json", tmp_path / "report")
    assert read_design_with_drift(tmp_path / "d.json") == found.design
    assert read_design(tmp_path / "d.json").optics.zoom == 1
    assert {f.name for f in (tmp_path / "report").iterdir()} == {
        "calibration.json",
        "calibration.md",
        "pins.png",
        "curves.png",
    }


def test_calibrate_frames_of_other_tip_are_refused(few, tmp_path):
    with pytest.raises(TactipError, match=r"must show the 331 pins of the design .tactip-331., got 127"):
        calibrate(few, design_named("tactip-331"), Settings(), tmp_path / "state.json")


def test_calibrate_command_refused_writes_nothing(few, tmp_path, capsys):
    for command, words in (
        ([str(tmp_path / "none")], "is not a folder"),
        ([str(few), "--design", "tactip-331"], "must show the 331 pins of the design 'tactip-331', got 127"),
    ):
        assert tactip.main(["calibrate", *command, "--out", str(tmp_path / "mine.json")]) == 1
        assert words in capsys.readouterr().err
        assert not list(tmp_path.glob("mine*"))


def test_constants_are_sorted():
    assert list(LOAD_CELL_N) == sorted(LOAD_CELL_N)
    assert MOVE_FRACTIONS[0] == 0 and MOVE_FRACTIONS[-1] == 1


def test_calibrate_killed_worker_is_one_sentence(few, tmp_path, monkeypatch):
    monkeypatch.setattr(Calibrator, "misfit", lambda self, twin, fidelity: self._executor.submit(os._exit, 9).result())
    with pytest.raises(TactipError, match=r"^a worker was killed; .* the same command resumes after them$"):
        calibrate(few, start(), Settings(fit_frames=10, test_frames=10), tmp_path / "state.json", lambda line: None)


def test_calibrate_round_without_a_better_step_ends_as_a_resumed_one_begins(monkeypatch):
    """A resumed run fits the pins to the neutral image again, so a round that changes nothing does that, too."""
    twin = hidden_twin()
    frames = Frames(np.zeros(1, int), np.zeros((1, 127, 2)), [(np.zeros(6), np.zeros(6))], TAP)
    calibrator = Calibrator(frames, neutral_px(start()), ThreadPoolExecutor(1))
    monkeypatch.setattr(calibrator, "cost", lambda twin, chosen, fidelity: (1.0, None))
    moved = parameters(twin.design)[0]
    found, _, fraction = calibrator._lowest(twin, (moved,), {moved: 1.0}, "draft", 1.0)
    assert fraction == 0
    assert found.design == with_pin_offsets(twin.design, neutral_px(start())) != twin.design
