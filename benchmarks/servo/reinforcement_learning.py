"""Policies trained in the environments, against the PI servo, and cost and error of each fidelity:
`tactip bench reinforcement-learning`. Writes docs/reinforcement_learning.json, .md and .png."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from scipy.spatial.transform import Rotation

import tactip_twin.control.environments  # noqa: F401  (registers the environments)
from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.benchmarks.servo.options import ReinforcementLearningOptions, ReinforcementLearningPart
from tactip_twin.benchmarks.servo.policy_training import TrainingSettings, train
from tactip_twin.control.policy import Policy, write_policy
from tactip_twin.control.servo import DEPTHS_MM, FREE_AXES, Servo, gains_named, reference_mm_deg
from tactip_twin.sim.labels import LABELS, LEARNED, Task
from tactip_twin.sim.pose import from_mm_deg, to_mm_deg
from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure

NAME = "reinforcement_learning"

ENVIRONMENTS: dict[Task, str] = {"edge": "tactip_twin/EdgeFollow-v0", "surface": "tactip_twin/SurfaceFollow-v0"}

_TRAINED: dict[Task, tuple[str, ...]] = {"edge": ("rim-round", "rim-square"), "surface": ("sphere", "saddle")}
"""Objects to train on."""

_OPTIONS: dict[Task, dict[str, Any]] = {"edge": {"movement_mode": "TxRz", "max_turn_deg": 3.0}, "surface": {}}
"""Other options: along edges, a policy moves in the plane of the edge, as in Tactile Gym."""

_TESTED: dict[Task, tuple[str, ...]] = {
    "edge": ("rim-round", "rim-square", "rim-uneven"),
    "surface": ("sphere", "saddle", "bust"),
}
"""Objects to test on: the last of each was not trained on."""

_ALIGNED = 10
"""Steps at the start of an episode that are not scored, because the first pose has an error."""

_CURVE_EPISODES, _CURVE_SEED, _TEST_SEED = 4, 50_000, 100_000
"""Episodes of a point of the curve, its seed, and that of the tests; trainings have others."""

_FIDELITIES = ("fast", "draft", "standard", "reference")

Act = Callable[[dict[str, np.ndarray]], np.ndarray]


class ServoPolicy:
    """The PI servo as a policy: it moves by what it observes, within the limits of an action."""

    def __init__(self, task: Task, environment: gymnasium.Env) -> None:
        """Take the task, and an environment in observation mode oracle or pose."""
        inner: Any = environment.unwrapped
        self._servo = Servo(gains_named("paper", task), DEPTHS_MM[task], FREE_AXES[task])
        self._rows = [LABELS.index(f"pose_{c}") for c in LEARNED[task]]
        self._reference = reference_mm_deg(DEPTHS_MM[task])
        self._limits = np.array([inner.options.max_move_mm] * 3 + [inner.options.max_turn_deg] * 3)
        self._axes = list(inner.movement.axes)

    def reset(self) -> None:
        """Forget the errors of the last episode."""
        self._servo.reset()

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return the action for an observation."""
        (vector,) = observation.values()
        label = self._reference.copy()
        label[self._rows] += vector[: len(self._rows)]
        T = self._servo.move(from_mm_deg(label))
        motion = to_mm_deg(np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()]))
        return np.clip(motion / self._limits, -1, 1)[self._axes].astype(np.float32)


def score_episodes(environment: gymnasium.Env, act: Act, episodes: int, seed: int) -> dict[str, float]:
    """Return mean errors and the rate of success of a policy over episodes of seeds from `seed` on."""
    errors, returns, reached = [], [], 0
    for k in range(episodes):
        observation, _ = environment.reset(seed=seed + k)
        if isinstance(act, ServoPolicy):
            act.reset()
        total, over, step, info = 0.0, False, 0, {}
        while not over:
            observation, reward, terminated, truncated, info = environment.step(act(observation))
            total, over, step = total + float(reward), terminated or truncated, step + 1
            if step > _ALIGNED:
                errors.append(info["error_mm_deg"])
        returns.append(total)
        reached += bool(info.get("is_success"))
    e = np.abs(np.array(errors).reshape(-1, 6))
    mean = e.mean(0) if len(e) else np.full(6, np.nan)
    return {
        "return": float(np.mean(returns)),
        "reached": reached / episodes,
        "depth_mm": float(mean[2]),
        "lateral_mm": float(mean[0]),
        "angle_deg": float(np.linalg.norm(e[:, 3:5], axis=1).mean()) if len(e) else float("nan"),
        "yaw_deg": float(mean[5]),
    }


def run(options: ReinforcementLearningOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Train, test and measure; write the page, and return the results. Raises TactipError."""
    settings = TrainingSettings(steps=options.steps)
    result = read_results(options.out / f"{NAME}.json")

    def chosen(part: ReinforcementLearningPart) -> bool:
        return not options.parts or part in options.parts

    for task in filter(chosen, ENVIRONMENTS):
        policy, curve = _train(task, settings, options.runs / task, log)
        if options.release is not None:
            options.release.mkdir(parents=True, exist_ok=True)
            write_policy(policy, options.release / f"{task}-follow.npz")
        rows = _tests(task, policy, options.episodes, log)
        result |= {task: {"curve": curve, "rows": rows, "settings": policy.provenance["settings"], "machine": machine()}}
    if chosen("fidelities"):
        measured = {task: _fidelities(task, options.fidelity_steps, log) for task in ENVIRONMENTS}
        result |= {"fidelities": measured, "fidelity_steps": options.fidelity_steps, "fidelity_machine": machine()}
    write_results(NAME, result, tables(result), options.out)
    if not result.keys().isdisjoint(ENVIRONMENTS):
        _plot(result, options.out / f"{NAME}.png")
    return result


def _train(
    task: Task, settings: TrainingSettings, folder: Path, log: Callable[[str], None]
) -> tuple[Policy, list[dict[str, float]]]:
    options: dict[str, Any] = {"observation_mode": "oracle", "objects": list(_TRAINED[task])} | _OPTIONS[task]
    environment = gymnasium.make(ENVIRONMENTS[task], **options)

    def score(policy: Policy) -> dict[str, float]:
        return score_episodes(environment, policy, _CURVE_EPISODES, _CURVE_SEED)

    return train(ENVIRONMENTS[task], options, settings, folder, score, log)


def _tests(task: Task, policy: Policy, episodes: int, log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the scores of the policy and of the servo on each object, with true and with estimated poses."""
    rows = []
    for name in _TESTED[task]:
        for mode in ("oracle", "pose"):
            environment = gymnasium.make(
                ENVIRONMENTS[task], **policy.options | {"observation_mode": mode, "objects": (name,)}
            )
            for controller, act in (("policy", policy), ("PI servo", ServoPolicy(task, environment))):
                row = {"object": name, "observed": mode, "controller": controller}
                rows.append(row | score_episodes(environment, act, episodes, _TEST_SEED))
                log(f"{task}: {rows[-1]}")
            environment.close()
    return rows


def _fidelities(task: Task, steps: int, log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the steps per second of each fidelity, and its errors against `reference` for the same actions."""
    recorded: dict[str, tuple[np.ndarray, np.ndarray, float, int]] = {}
    actions: list[np.ndarray] = []
    for fidelity in ("reference", *_FIDELITIES[:-1]):
        environment = gymnasium.make(ENVIRONMENTS[task], fidelity=fidelity, objects=_TRAINED[task][:1])
        inner: Any = environment.unwrapped
        servo = ServoPolicy(task, environment)
        observation, _ = environment.reset(seed=_TEST_SEED)
        pins, forces = [inner.touch.pin_tips], [inner.touch.force]
        learned = getattr(inner.tip, "sliding", None)  # of fidelity fast
        before = learned.simulated_motions if learned else 0
        start = time.process_time()  # of this process alone, which is single-threaded
        for k in range(steps):
            if fidelity == "reference":
                actions.append(servo(observation))
            observation, *_ = environment.step(actions[k])
            pins.append(inner.touch.pin_tips)
            forces.append(inner.touch.force)
        rate = steps / (time.process_time() - start)
        recorded[fidelity] = np.array(pins), np.array(forces), rate, learned.simulated_motions - before if learned else steps
        environment.close()
        log(f"{task}, {fidelity}: {rate:.1f} steps/s")
    best_pins, best_forces, *_ = recorded["reference"]
    return [
        {
            "fidelity": fidelity,
            "steps_per_s": rate,
            "simulated_motions": simulated,
            "pins_mm": float(1e3 * np.linalg.norm(pins - best_pins, axis=-1).mean()),
            "force": float(np.linalg.norm(forces - best_forces, axis=1).mean() / np.linalg.norm(best_forces, axis=1).mean()),
        }
        for fidelity, (pins, forces, rate, simulated) in ((name, recorded[name]) for name in _FIDELITIES)
    ]


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/reinforcement_learning.md from reinforcement_learning.json."""
    head = ["task", "object", "poses", "controller", "reached", "depth, mm", "lateral, mm", "angle, °", "yaw, °", "return"]
    rows = [[task, *_cells(task, row)] for task in ENVIRONMENTS if task in result for row in result[task]["rows"]]
    fidelity_head = ["task", "fidelity", "steps/s", "simulated motions", "pin tips, mm", "force"]
    fidelities = [
        [task, r["fidelity"], f"{r['steps_per_s']:.1f}", r["simulated_motions"], f"{r['pins_mm']:.3f}", f"{r['force']:.1%}"]
        for task, found in result.get("fidelities", {}).items()
        for r in found
    ]
    machines = sorted({machine_text(result[task]["machine"]) for task in ENVIRONMENTS if task in result})
    note = "".join(f"\n\nMachine: {one}." for one in machines)
    cost = ""
    if fidelities:
        cost = f"\n\n{result['fidelity_steps']} steps each. Machine: {machine_text(result['fidelity_machine'])}."
    return {"scores": table(head, rows) + note, "fidelities": table(fidelity_head, fidelities) + cost}


def _cells(task: Task, row: dict[str, Any]) -> list[str]:
    """Return the cells of a row of scores."""
    edge, poses = task == "edge", {"oracle": "true", "pose": "estimated"}[row["observed"]]
    lateral, yaw = (f"{row[name]:.2f}" if edge else "" for name in ("lateral_mm", "yaw_deg"))
    errors = [f"{row['depth_mm']:.2f}", lateral, f"{row['angle_deg']:.2f}", yaw]
    return [row["object"], poses, row["controller"], f"{row['reached']:.0%}", *errors, f"{row['return']:.1f}"]


_PLOTTED: tuple[tuple[str, dict[Task, str]], ...] = (
    ("position error, mm", {"surface": "depth_mm", "edge": "lateral_mm"}),
    ("angle error, °", {"surface": "angle_deg", "edge": "yaw_deg"}),
)
"""What the plots show of each task: the errors that its actions can change."""


def _plot(result: dict[str, Any], path: Path) -> None:
    """Plot the curves of the trainings."""
    figure, axes = figure_of(1, 2, (8.0, 3.0))
    for axis, (label, names) in zip(axes, _PLOTTED, strict=True):
        for k, (task, name) in enumerate(names.items()):
            if task in result:
                curve, what = result[task]["curve"], name.rpartition("_")[0]
                steps, errors = [p["steps"] for p in curve], [p[name] for p in curve]
                axis.plot(steps, errors, color=COLORS[k], marker=".", label=f"{task}: {what}")
        axis.set(xlabel="steps of the environment", ylabel=label)
        log_axis(axis, "y")
        axis.legend()
    save_figure(figure, path)
