"""The state of a calibration on disk: written after each round, so an interrupted run resumes from there."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.sim2real.calibration.parameters import Parameter, SensorOnRig
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import has_checksum, read_json, with_checksum
from tactip_twin.tactip_model.neutral_image import with_pin_offsets


def write_state(
    path: Path,
    identity: dict[str, Any],
    twin: SensorOnRig,
    deviations: np.ndarray,
    rounds: list[dict[str, Any]],
    chosen: Sequence[Parameter],
) -> None:
    """Write the state after a round.

    Args:
        path: The state file.
        identity: Settings (a JSON object) that a resumed run must share.
        twin: Sensor and rig, as fitted so far.
        deviations: (k,) standard deviations of the parameters, in their steps.
        rounds: Figures of each round.
        chosen: The k parameters.
    """
    values = {p.name: p.read(twin) for p in chosen}
    state = {"of": identity, "values": values, "deviations": deviations.tolist(), "rounds": rounds}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(with_checksum(state), indent=1).encode())


def read_state(
    path: Path, identity: dict[str, Any], twin: SensorOnRig, chosen: Sequence[Parameter], neutral_px: np.ndarray
) -> tuple[SensorOnRig, np.ndarray, list[dict[str, Any]]]:
    """Return the sensor and rig, deviations (k,) and rounds of `write_state`.

    Args:
        path: The state file.
        identity: As for `write_state`.
        twin: Sensor and rig, for everything that is not a parameter.
        chosen: The k parameters.
        neutral_px: (p, 2) px of 256, pins of the neutral image.

    Raises:
        TactipError: If the file cannot be read, or belongs to a calibration with other settings.
    """
    try:
        state = read_json(path)
        if not isinstance(state, dict) or not isinstance(state.get("of"), dict):
            raise TactipError("it must be an object with the settings under `of`")
        if not has_checksum(state):
            raise TactipError("it does not match its own checksum")
    except TactipError as error:
        raise TactipError(f"{path} is not the state of a calibration ({error}): remove it to start again") from error
    check_resumable(path.parent, "calibration", state["of"], identity)
    for p in chosen:
        twin = p.write(twin, state["values"][p.name])
    twin = replace(twin, design=with_pin_offsets(twin.design, neutral_px))
    return twin, np.array(state["deviations"]), state["rounds"]
