"""Training of policies with Stable-Baselines3's soft actor-critic, resumable between chunks of steps.

Every chunk starts with seeds of its own and a new episode, so a training that was interrupted gives the policy of one that
was not. Checkpoints hold tensors alone: the library's own files hold pickles.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box

from tactip_twin.control.policy import Policy, read_policy, write_policy
from tactip_twin.learning.model import tensors_from_bytes, weights_bytes
from tactip_twin.sim.labels import LEARNED
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import read_file

_CHECKPOINT, _MAX_CHECKPOINT_BYTES, _POLICY = "checkpoint.pt", 2**28, "policy-{}.npz"

_ERROR_SCALE = {"x": 1.0, "z": 1.0, "Rx": 5.0, "Ry": 5.0, "Rz": 5.0}
"""What observed errors are divided by, mm and degrees [?]."""

_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of the replay buffer."""

Score = Callable[[Policy], dict[str, float]]


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training."""

    steps: int = within(1, 10**8, default=6000)
    """Steps of the environment."""
    chunk_steps: int = within(100, 10**6, default=500)
    """Steps between checkpoints and points of the curve."""
    seed: int = within(0, 2**31 - 1, default=0)
    """Seed."""
    width: int = within(4, 1024, default=64)
    """Units of each of the two hidden layers."""
    learning_rate: float = within(1e-6, 1e-1, default=1e-3)
    """Learning rate."""
    discount: float = within(0, 0.9999, default=0.9)
    """Discount factor per step: ten steps count, because errors are corrected within a few [?]."""
    updates: int = within(1, 100, default=2)
    """Updates of the networks per step: they cost less than the step."""
    batch: int = within(1, 65536, default=256)
    """Samples of an update."""
    random_steps: int = within(0, 10**6, default=500)
    """Steps of random actions before learning begins."""

    def __post_init__(self) -> None:
        check(self)


class _Vector(gymnasium.ObservationWrapper):
    """The single vector of an observation, scaled."""

    def __init__(self, environment: gymnasium.Env) -> None:
        super().__init__(environment)
        (space,) = environment.observation_space.spaces.values()  # type: ignore[attr-defined]
        self.observation_space = Box(-np.inf, np.inf, space.shape, np.float32)
        self.scale = scale_of(environment)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        (vector,) = observation.values()
        return (vector / self.scale).astype(np.float32)


def scale_of(environment: gymnasium.Env) -> np.ndarray:
    """Return what the observed vector (n,) of a following environment, in mode oracle or pose, is divided by."""
    inner: Any = environment.unwrapped
    errors = [_ERROR_SCALE[c] for c in LEARNED[inner.task]]
    (space,) = inner.observation_space.spaces.values()
    return np.concatenate([errors, np.ones(space.shape[0] - len(errors))]).astype(np.float32)


def train(
    name: str, options: dict[str, Any], settings: TrainingSettings, folder: Path, score: Score, log: Callable[[str], None]
) -> tuple[Policy, list[dict[str, float]]]:
    """Train a policy; continue a training in the same folder, also to more steps.

    Args:
        name: Name of the environment.
        options: Its keyword arguments.
        settings: Settings.
        folder: Folder of the checkpoint.
        score: Called with the policy after each chunk, for the curve.
        log: Callback for messages to the user.

    Returns:
        The policy of the point of the curve with the best `return`, and the curve: the scores with the number of `steps`.

    Raises:
        TactipError: Stable-Baselines3 is not installed, or the folder has a training with other settings.
    """
    try:
        from stable_baselines3 import SAC  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise TactipError(
            "training needs stable-baselines3: install it in the clone with `.venv/bin/pip install -e '.[rl-training]'`"
        ) from error
    environment = _Vector(gymnasium.make(name, **options))
    layers = {"net_arch": [settings.width, settings.width]}
    model = SAC(
        "MlpPolicy",
        environment,
        learning_rate=settings.learning_rate,
        buffer_size=settings.steps,
        learning_starts=settings.random_steps,
        batch_size=settings.batch,
        gamma=settings.discount,
        gradient_steps=settings.updates,
        policy_kwargs=layers,
        seed=settings.seed,
        device="cpu",
    )
    # Without the number of steps: a training may continue to more of them.
    known = {key: value for key, value in asdict(settings).items() if key != "steps"}
    about = {"environment": name, "options": options, "settings": known}
    curve = _resume(model, folder / _CHECKPOINT, about)
    while model.num_timesteps < settings.steps:
        model.set_random_seed(int(np.random.SeedSequence([settings.seed, model.num_timesteps]).generate_state(1)[0]))
        model._last_obs = None  # a new episode, as after a checkpoint
        model.learn(min(settings.chunk_steps, settings.steps - model.num_timesteps), reset_num_timesteps=False)
        policy = _policy(model, about, environment.scale)
        curve.append({"steps": model.num_timesteps, **score(policy)})
        write_policy(replace(policy, provenance=about | {"curve": list(curve)}), folder / _POLICY.format(curve[-1]["steps"]))
        log(f"{name}, {model.num_timesteps} of {settings.steps} steps: {curve[-1]}")
        _save(model, folder / _CHECKPOINT, about, curve)
    environment.close()
    best = max(curve, key=lambda point: point["return"])
    return read_policy(folder / _POLICY.format(best["steps"])), curve


def _policy(model: Any, about: dict[str, Any], scale: np.ndarray) -> Policy:
    """Return the present policy of a training."""
    actor = model.policy.actor
    layers = [layer for layer in (*actor.latent_pi, actor.mu) if isinstance(layer, torch.nn.Linear)]
    weights = tuple(w.detach().numpy().copy() for layer in layers for w in (layer.weight, layer.bias))
    return Policy(about["environment"], about["options"], scale, weights, about)


def _save(model: Any, path: Path, about: dict[str, Any], curve: list[dict[str, float]]) -> None:
    buffer, count = model.replay_buffer, model.num_timesteps
    state = {
        "about": about,
        "curve": curve,
        "steps": count,
        "updates": model._n_updates,
        "parameters": model.get_parameters(),
        "log_ent_coef": model.log_ent_coef.detach(),
        "buffer": {name: torch.from_numpy(getattr(buffer, name)[:count]) for name in _BUFFER},
    }
    write_file(path, weights_bytes(state))


def _resume(model: Any, path: Path, about: dict[str, Any]) -> list[dict[str, float]]:
    """Load a checkpoint into a model, if there is one; return its curve. Raises TactipError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        return []
    try:
        state = tensors_from_bytes(read_file(path, _MAX_CHECKPOINT_BYTES))
    except ValueError as error:
        raise TactipError(f"{path} is damaged: remove it to train anew") from error
    if state["about"] != about:
        raise TactipError(f"{path.parent} has a training with other settings: choose another folder, or remove it")
    model.set_parameters(state["parameters"])
    with torch.no_grad():
        model.log_ent_coef.copy_(state["log_ent_coef"])
    count = model.num_timesteps = model.replay_buffer.pos = state["steps"]
    model._n_updates = state["updates"]
    for name in _BUFFER:
        getattr(model.replay_buffer, name)[:count] = state["buffer"][name].numpy()
    if count == len(model.replay_buffer.observations):
        model.replay_buffer.pos, model.replay_buffer.full = 0, True
    return state["curve"]
