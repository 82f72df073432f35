"""What a replay says about a step, in words."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from tactip_twin.sim.robot.recording import PHASES


def status_lines(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray], k: int) -> list[str]:
    """Return the lines about step k of a recording: step, force, time of computing, events, and why it ended."""
    last, seconds = len(arrays["phase"]) - 1, 1e3 * arrays["seconds"][k]
    lines = [
        f"step {k} of {last}, {PHASES[int(arrays['phase'][k])]}{_pass_text(arrays, k)}",
        f"force {np.linalg.norm(arrays['force_n'][k]):.2f} N, {penetration_text(arrays['penetration_m'][k])}",
    ]
    if seconds.sum() > 0:
        parts = f"simulation {seconds[0]:.0f}, image {seconds[1]:.0f}, network {seconds[2]:.0f}"
        lines.append(f"computed in {seconds.sum():.0f} ms: {parts}")
    lines += [f"{e['kind']}: {e['what']}" for e in record["events"] if e["step"] == k]
    if k == last:
        lines.append(f"ended: {record.get('stopped_because', 'the recording is incomplete')}")
    return lines


def penetration_text(penetration_m: float) -> str:
    """Return a text about a penetration; NaN where the contact was predicted."""
    if np.isfinite(penetration_m):
        return f"penetration {1e3 * penetration_m:.3f} mm"
    return "contact predicted by the learned tip"


def _pass_text(arrays: Mapping[str, np.ndarray], k: int) -> str:
    """Return the pass at a step that follows a route, else an empty text. The even parts of a route are its passes."""
    if PHASES[int(arrays["phase"][k])] != "follow":
        return ""
    number, odd = divmod(int(arrays["part"][k]), 2)
    count = int(arrays["part"].max() + 1) // 2 + 1
    return f", between passes {number + 1} and {number + 2}" if odd else f", pass {number + 1} of {count}"
