"""MuJoCo's GPU engine on the soft tip, beside MuJoCo itself: `tactip bench performance --groups gpu-engine`.

A flat is pressed 3 mm into the tip at `standard`'s steps, by mj_step in double precision and by MuJoCo Warp in single, as
tight as it goes; on the processor where there is no GPU, which tells what it gets right and nothing of its speed. What our
own step adds to MuJoCo's (sim/contact/scene.py) is in neither.
"""

import time
from importlib.util import find_spec

import mujoco
import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.tactip_model.presets import load_design

TIGHTEST = 1e-6
"""Smallest tolerance of MuJoCo Warp's solver, - (MuJoCo's manual, "MuJoCo Warp", Differences from MuJoCo)."""

_ON_PROCESSOR = "processor"
"""How rows name the device where there is no GPU."""

_STEPS, _MOVING = 14, 8
"""Time steps of the press, and of these the ones that go down."""

_UP_M, _DEEP_M = 0.2e-3, 3e-3
"""Where the flat begins, off the apex, and how deep it goes, m."""

_WORLDS = {"cpu": (1, 4), "cuda": (1, 64, 1024)}
"""Tips at once, by the kind of device."""


def missing():
    """A sentence (str) on what is missing to measure, or None."""
    if find_spec("mujoco_warp"):
        return None
    return "MuJoCo's GPU engine is not installed: pip install 'tactip-twin[gpu]'"


def rows():
    """Rows (list of dict): steps a second, and how far vertices end from those of mj_step at the tightest tolerance."""
    import mujoco_warp  # pyright: ignore[reportMissingImports]  # noqa: F401  (it sets warp up, so it goes first)
    import warp  # pyright: ignore[reportMissingImports]

    resting = fidelity_named("standard").solver.settle_tolerance
    truth, _ = _mj_step(resting)
    out = []
    for tolerance in (resting, TIGHTEST):
        places, rate = _mj_step(tolerance)
        what = f"mj_step, tolerance {tolerance:g}, one thread"
        out.append({"what": what, "worlds": 1, "steps/s": rate, **_off(places, truth)})

    warp.config.quiet = True
    device = warp.get_device()
    for worlds in _WORLDS["cuda" if device.is_cuda else "cpu"]:
        places, rate = _warp(worlds)
        what = f"MuJoCo Warp, tolerance {TIGHTEST:g}, {device.name if device.is_cuda else _ON_PROCESSOR}"
        out.append({"what": what, "worlds": worlds, "steps/s": rate, **_off(places, truth)})
    return out


def note(rows):
    """What the rows (list of dict) do not say: str."""
    on_gpu = any("Warp" in row["what"] and not row["what"].endswith(f", {_ON_PROCESSOR}") for row in rows)
    if on_gpu:
        unsaid = "our own. What those would cost on a GPU is not in the table: it has MuJoCo's step alone."
    else:
        unsaid = (
            "our own, and what it gains on a GPU has not been measured, for want of one. On a processor the table tells "
            "that it is right, not how fast it is."
        )
    return (
        "MuJoCo Warp takes the tip as it is: neo-Hookean flex, discrete integrator, elliptic cones, conjugate gradients. "
        "Sets are not made on it: the margin, the correction of sliding friction and the memory of slides come between "
        f"the halves of a step (sim/contact/scene.py) and would have to become kernels of {unsaid}"
    )


def _off(places, truth):
    difference = np.linalg.norm((places - truth).reshape(-1, 3), axis=1)
    return {"off, µm rms": 1e6 * float(np.sqrt((difference**2).mean())), "off, µm most": 1e6 * float(difference.max())}


def _model(tolerance):
    model = ContactSimulator(load_design("tactip-127"), "surface", fidelity_named("standard")).scene.model
    # MuJoCo Warp refuses this flag; nothing diverges here.
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    model.opt.tolerance = tolerance
    return model


def _flat(k, model):
    """Positions (7,) and velocities (6,) of the flat before time step k."""
    here, there = (_UP_M - (_UP_M + _DEEP_M) * min(1.0, j / _MOVING) for j in (k, k + 1))
    return [0, 0, here, 0, 1, 0, 0], [0, 0, (there - here) / model.opt.timestep, 0, 0, 0]


def _mj_step(tolerance):
    """Free vertices' places (3 n,) m after the press, and steps a second."""
    model = _model(tolerance)
    data, seconds = mujoco.MjData(model), []
    for k in range(_STEPS):
        data.qpos[:7], data.qvel[:6] = _flat(k, model)
        start = time.perf_counter()
        mujoco.mj_step(model, data)
        seconds.append(time.perf_counter() - start)
    return data.qpos[7:].copy(), 1 / float(np.median(seconds))


def _warp(worlds):
    """The same by MuJoCo Warp, of `worlds` tips at once: places of the last one."""
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
