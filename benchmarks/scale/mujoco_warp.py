"""MuJoCo's GPU engine on the soft tip, compared with MuJoCo itself: `tactip bench performance --groups gpu-engine`.

A flat is pressed 3 mm into the tip at `standard`'s steps, by mj_step in double precision and by MuJoCo Warp in single
precision at its tightest tolerance. Without a GPU, Warp runs on the CPU, which shows whether it is correct but not how fast
it is. Neither includes what our own step adds to MuJoCo's (sim/contact/scene.py).
"""

import time
from importlib.util import find_spec
from typing import Any

import mujoco
import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.tactip_model.presets import load_design

TIGHTEST = 1e-6
"""Smallest tolerance of MuJoCo Warp's solver, - (MuJoCo's manual, "MuJoCo Warp", Differences from MuJoCo)."""

_ON_PROCESSOR = "processor"
"""Name of the device in rows measured without a GPU."""

_STEPS, _MOVING = 14, 8
"""Number of time steps of the press, and of those that move down."""

_UP_M, _DEEP_M = 0.2e-3, 3e-3
"""Initial distance of the flat from the apex, and depth of the press, m."""

_WORLDS = {"cpu": (1, 4), "cuda": (1, 64, 1024)}
"""Numbers of tips at a time, by kind of device."""


def missing() -> str | None:
    """Return a message if MuJoCo Warp is not installed, or None."""
    if find_spec("mujoco_warp"):
        return None
    return "MuJoCo's GPU engine is not installed: pip install 'tactip-twin[gpu]'"


def rows() -> list[dict[str, Any]]:
    """Return rows: steps per second, and distances of the final vertices from those of mj_step at the tightest tolerance."""
    import mujoco_warp  # pyright: ignore[reportMissingImports]  # noqa: F401  (it sets warp up, so it is imported first)
    import warp  # pyright: ignore[reportMissingImports]

    resting = fidelity_named("standard").solver.settle_tolerance
    reference, _ = _mj_step(resting)
    out = []
    for tolerance in (resting, TIGHTEST):
        places, rate = _mj_step(tolerance)
        what = f"mj_step, tolerance {tolerance:g}, one thread"
        out.append({"what": what, "worlds": 1, "steps/s": rate, **_off(places, reference)})

    warp.config.quiet = True
    device = warp.get_device()
    for worlds in _WORLDS["cuda" if device.is_cuda else "cpu"]:
        places, rate = _warp(worlds)
        what = f"MuJoCo Warp, tolerance {TIGHTEST:g}, {device.name if device.is_cuda else _ON_PROCESSOR}"
        out.append({"what": what, "worlds": worlds, "steps/s": rate, **_off(places, reference)})
    return out


def _off(places: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return the distances between vertices (3 n,) m, rms and maximum, µm."""
    difference = np.linalg.norm((places - reference).reshape(-1, 3), axis=1)
    return {
        "deviation, µm rms": 1e6 * float(np.sqrt((difference**2).mean())),
        "deviation, µm max": 1e6 * float(difference.max()),
    }


def _model(tolerance: float) -> mujoco.MjModel:
    """Return the compiled scene of the tip and the flat, with a tolerance of the solver, -."""
    model = ContactSimulator(load_design("tactip-127"), "surface", fidelity_named("standard")).scene.model
    # MuJoCo Warp refuses this flag; nothing diverges here.
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    model.opt.tolerance = tolerance
    return model


def _flat(k: int, model: mujoco.MjModel) -> tuple[list[float], list[float]]:
    """Return position (7,) and velocity (6,) of the flat before time step k."""
    here, there = (_UP_M - (_UP_M + _DEEP_M) * min(1.0, j / _MOVING) for j in (k, k + 1))
    return [0, 0, here, 0, 1, 0, 0], [0, 0, (there - here) / model.opt.timestep, 0, 0, 0]


def _mj_step(tolerance: float) -> tuple[np.ndarray, float]:
    """Return free vertices (3 n,) m after the press by mj_step, and steps per second."""
    model = _model(tolerance)
    data, seconds = mujoco.MjData(model), []
    for k in range(_STEPS):
        data.qpos[:7], data.qvel[:6] = _flat(k, model)
        start = time.perf_counter()
        mujoco.mj_step(model, data)
        seconds.append(time.perf_counter() - start)
    return data.qpos[7:].copy(), 1 / float(np.median(seconds))


def _warp(worlds: int) -> tuple[np.ndarray, float]:
    """Return the same by MuJoCo Warp for a number of tips at a time: vertices of the last one, steps per second of all."""
    import mujoco_warp  # pyright: ignore[reportMissingImports]
    import warp  # pyright: ignore[reportMissingImports]

    model = _model(TIGHTEST)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    there = mujoco_warp.put_model(model)
    many = mujoco_warp.put_data(model, data, nworld=worlds, nconmax=600, njmax=2000)
    seconds = []
    for k in range(_STEPS):
        place, speed = _flat(k, model)
        for array, values in ((many.qpos, place), (many.qvel, speed)):
            whole = array.numpy()
            whole[:, : len(values)] = values
            array.assign(whole)
        warp.synchronize()
        start = time.perf_counter()
        mujoco_warp.step(there, many)
        warp.synchronize()
        seconds.append(time.perf_counter() - start)
    return many.qpos.numpy()[-1, 7:].astype(float), worlds / float(np.median(seconds))
