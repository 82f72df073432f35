"""Calibration of a sensor: a design and a rig fitted to real frames.

The neutral image gives lens, camera and pins (tactip_model/neutral_image.py). Pressed frames, of which only the rig's
commands are known, give the rest: each parameter has a value, bounds, a prior, and a place in the design or the rig.
"""

import json
import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.parallel.parent_watch import end_with_parent
from tactip_twin.sim2real.calibration.frames import Frames, sample_frames
from tactip_twin.sim2real.calibration.moves import FAST, can_predict
from tactip_twin.sim2real.calibration.parameters import UNKNOWN_CAMERA, Parameter, SensorOnRig, parameters
from tactip_twin.sim2real.calibration.real_set import RealSet, read_real_set
from tactip_twin.sim2real.calibration.rig import Rig
from tactip_twin.sim2real.calibration.rounds import Calibrator, first_azimuth
from tactip_twin.sim2real.calibration.settings import Settings
from tactip_twin.sim2real.calibration.state import read_state, write_state
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.design_file import design_as_dict
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import remove_leftovers
from tactip_twin.tactip_model.neutral_image import NeutralFit, camera_change, fit_neutral
from tactip_twin.tactip_model.optics import REFERENCE_PX
from tactip_twin.tactip_model.pin_detection import PinMatcher
from tactip_twin.tactip_model.sensor_of_image import sensor_of

_CAMERA_SPREAD = np.array([0.0005, 0.001, 0.001])
"""Minimum standard deviations of zoom and drift estimated from reflections."""


@dataclass(frozen=True)
class Result:
    """Result of a calibration, and its simulation of frames that it was not fitted to."""

    twin: SensorOnRig
    """The sensor and its rig, as fitted."""
    chosen: tuple[Parameter, ...]
    """(k) fitted parameters, in the order of `deviations`."""
    deviations: np.ndarray
    """(k,) float: standard deviation of each parameter, in its steps."""
    neutral: NeutralFit
    """Fit to the neutral image."""
    rounds: list[dict[str, Any]]
    """Figures of each round."""
    test_frames: Frames
    """Frames that the fit did not use."""
    pins_along_moves: np.ndarray
    """(n, MOVE_FRACTIONS, p, 2) float: simulated pins of the test frames at each fraction of their moves, px of 256."""
    forces_n: np.ndarray
    """(3,) float: normal forces at the depths of LOAD_CELL_N."""


def calibrate(
    real_dir: str | Path,
    design: Design | None,
    settings: Settings,
    state_path: str | Path,
    log: Callable[[str], object] = print,
) -> Result:
    """Fit a design, and the rig, to a folder of real frames.

    Args:
        real_dir: Folder of a real set (sim2real/calibration/real_set.py).
        design: Design to start from; None: a nominal one with the pins of the neutral image.
        settings: Settings of the calibration.
        state_path: File of the state, written after each round: an interrupted run resumes from there.
        log: Callback for messages to the user.

    Raises:
        TactipError: If frames do not fit the design, or state_path belongs to another run.
        Interrupted: On Ctrl-C.
    """
    state_path = Path(state_path)
    remove_leftovers(state_path.parent)
    real = read_real_set(real_dir, settings.angles)
    design = design or sensor_of(real.neutral)
    fitted_design, neutral = fit_neutral(design, real.neutral)
    log(
        f"neutral image: {design.name}, {neutral.before_px:.2f} px rms before the fit, {neutral.lattice_px:.2f} px with "
        "lens, camera and rotation fitted; the rest is fitted by offsets of the pins (256 px image)"
    )
    if not np.isfinite(neutral.pins_px).all():
        raise TactipError("every pin must be visible in the neutral image, but some are hidden")
    matcher = PinMatcher((neutral.pins_px + 0.5) * real.neutral.shape[1] / REFERENCE_PX - 0.5)
    rngs = np.random.default_rng(np.random.SeedSequence(settings.seed)).spawn(2)
    fit_frames = sample_frames(real, matcher, False, settings.fit_frames, rngs[0])
    chosen = parameters(design, _camera_prior(real, fit_frames, fitted_design, log))
    twin = _first_guess(real, fitted_design, chosen)
    fidelities = settings.rounds
    if FAST in fidelities and not can_predict(design):
        fidelities = settings.simulated_rounds
        log("the learned tip knows another shape or other fixed materials than this design: every contact is simulated")
    identity = {"real": str(Path(real_dir).name), "design": design_as_dict(design), "settings": asdict(settings)}
    identity["parameters"] = [p.name for p in chosen]
    identity = json.loads(json.dumps(identity))
    # The search takes many contacts: it is made with the learned tip if there is one.
    with_search = FAST if FAST in fidelities else settings.test_fidelity
    rounds: list[dict[str, Any]] = []
    deviations = np.full(len(chosen), np.nan)
    if state_path.exists():
        twin, deviations, rounds = read_state(state_path, identity, twin, chosen, neutral.pins_px)
        log(f"resuming after round {len(rounds)} of {len(fidelities)}")
    with ProcessPoolExecutor(min(2, os.cpu_count() or 1), initializer=_start_worker) as executor:
        calibrator = Calibrator(fit_frames, neutral.pins_px, executor)
        try:
            if not rounds:
                twin = first_azimuth(calibrator, twin, fidelities[0])
            for fidelity in fidelities[len(rounds) :]:
                twin, deviations, figures = calibrator.round(twin, chosen, fidelity)
                text = _round_text(figures)
                if fidelity == with_search:
                    twin, deviations, searched = calibrator.search(twin, chosen, deviations, fidelity)
                    figures["search"] = searched
                    text += f"; {searched['cost_after']:.3f} px² after the search for friction"
                rounds.append(figures)
                write_state(state_path, identity, twin, deviations, rounds, chosen)
                log(f"round {len(rounds)} of {len(fidelities)} ({fidelity}): {text}")
            test_frames = sample_frames(real, matcher, True, settings.test_frames, rngs[1])
            along = calibrator.pins_along_moves(twin, settings.test_fidelity, test_frames)
            forces = calibrator.forces(twin, settings.test_fidelity)
        except KeyboardInterrupt:
            executor.shutdown(wait=False, cancel_futures=True)
            raise Interrupted("finished rounds are kept, and the same command resumes after them") from None
        except BrokenProcessPool:
            raise TactipError(
                "a worker was killed; the machine may be out of memory; finished rounds are kept, and the same command "
                "resumes after them"
            ) from None
    return Result(twin, chosen, deviations, neutral, rounds, test_frames, along, forces)


def _camera_prior(
    real: RealSet, frames: Frames, design: Design, log: Callable[[str], object]
) -> tuple[np.ndarray, np.ndarray]:
    """Return zoom and drift since the neutral image, and their deviations, (3,) each, by the light at the rim of frames."""
    axis = np.array(design.optics.centre) * real.neutral.shape[1] - 0.5
    camera = camera_change(real.neutral, (real.frame(i) for i in frames.indices), axis)
    if camera is None:
        log("too little light at the rim to measure the camera's change since the neutral image")
        return UNKNOWN_CAMERA
    log(
        f"reflections at the rim: image scale {camera[0][0]:.4f} relative to the neutral image "
        f"(± {camera[1][0]:.4f} per frame)"
    )
    return camera[0], np.maximum(camera[1], _CAMERA_SPREAD)


def _first_guess(real: RealSet, design: Design, chosen: tuple[Parameter, ...]) -> SensorOnRig:
    """Return the SensorOnRig that the fit starts from, with a perfect rig."""
    press = real.tap[:3] / np.linalg.norm(real.tap[:3])
    x, y, z = (float(component) for component in press)
    twin = SensorOnRig(design, Rig(press_axis=(x, y, z)))
    for p in chosen:
        # Start values for what the neutral image does not determine, where a perfect sensor would be at a bound.
        if p.prior and (p.part == "optics" or p.name in ("kinetic_fraction", "slip_weakening")):
            twin = p.write(twin, p.prior[0])
    return twin


def _round_text(figures: dict[str, Any]) -> str:
    """Return a round's figures as readable text."""
    return (
        f"started at {figures['rms_px']:.2f} px rms, median frame {figures['median_px']:.2f} px; cost "
        f"{figures['cost_before']:.3f} to {figures['cost_after']:.3f} px² with {figures['share_of_step']:g} of the step"
    )


def _start_worker() -> None:
    """Prepare a worker process: the parent alone answers Ctrl-C, and its death ends the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
