"""What the environments have in common: actions, observations, images of the scene, and pickling."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from scipy.spatial.transform import Rotation

from tactip_twin.control.environments.options import EnvironmentOptions, movement_named
from tactip_twin.control.environments.page import EnvironmentPage
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.pose import from_mm_deg, matrix
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.mounted_tip import TipOnArm
from tactip_twin.sim.view.geometry import ColoredMesh
from tactip_twin.sim.view.offscreen import SceneRenderer
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.renderer import renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image

Observation = dict[str, np.ndarray]

_FAILURE_REWARD = -10.0
"""Reward of a step that ends an episode by a failure, - [?]: more than an episode's later steps are worth."""

_STARTS = 20
"""Number of tries to find a start from which the tip reaches its first pose."""

_MAX_VALUE = 1e3
"""Bound of observed numbers, mm and degrees."""

_VIEW_PX, _IMAGE_PX = (480, 480), 160
"""Height and width of the view of the scene, and width of the tactile image in it, px."""

_EYE_M, _FIELD_DEG = np.array([0.11, -0.17, 0.1]), 40.0
"""Position of the eye relative to the middle of the view, m, base frame, and its field of view, degrees."""

_PORT = 8080
"""Port of the page of render_mode="human"; the next free one is taken."""


class Failure(Exception):
    """An episode cannot continue; the message says why."""


class TouchEnvironment(gymnasium.Env[Observation, np.ndarray], ABC):
    """An environment in which a soft tip touches something.

    What is slow to build is built when it is first needed, and is left out of a pickle; an unpickled environment must be
    reset before its next step.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012 (gymnasium's)

    def __init__(self, options: EnvironmentOptions, default_movement: str, state: int, render_mode: str | None) -> None:
        """Define the spaces.

        Args:
            options: Options.
            default_movement: Movement mode of the task.
            state: Number of components that `_state` returns.
            render_mode: None, rgb_array, or human: a page in the browser.

        Raises:
            TactipError: An option is invalid.
        """
        self.options = options
        if render_mode is not None:
            lookup("render mode", render_mode, dict.fromkeys(self.metadata["render_modes"]))
        self.render_mode = render_mode
        self.movement = movement_named(options.movement_mode or default_movement)
        design = load_design(options.design)
        self.design = replace(design, image=replace(design.image, size_px=options.image_size_px))
        count = len(self.movement.axes)
        self.action_space = Box(-1.0, 1.0, (count,), np.float32)
        features = self._feature_count() + count
        vector = {name: Box(-_MAX_VALUE, _MAX_VALUE, (n,), np.float32) for name, n in
                  (("oracle", state + features), ("pose", state + features), ("extended_feature", features))}  # fmt: skip
        image = Box(0, 255, (options.image_size_px, options.image_size_px, 1), np.uint8)
        observed = {
            "oracle": {"oracle": vector["oracle"]},
            "pose": {"pose": vector["pose"]},
            "tactile": {"tactile": image},
            "tactile_and_feature": {"tactile": image, "extended_feature": vector["extended_feature"]},
        }[options.observation_mode]
        self._observed = tuple(observed)
        self.observation_space = Dict(observed)
        self._forget()

    def _forget(self) -> None:
        """Drop what is built lazily, and the episode."""
        self._rendered: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
        self._view: SceneRenderer | None = None
        self._page: EnvironmentPage | None = None
        self._touch: TipState | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what is built lazily."""
        state, kept = self.__dict__.copy(), self._kept()
        return {name: value for name, value in state.items() if name in kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over a state."""
        self.__dict__.update(state)
        self._forget()

    def _kept(self) -> set[str]:
        """Names of the attributes that a pickle contains."""
        return {
            "options", "render_mode", "movement", "design", "action_space", "observation_space", "_np_random",
            "_np_random_seed", "_observed", "spec",
        }  # fmt: skip

    @property
    @abstractmethod
    def tip(self) -> TipOnArm:
        """The tip of the present episode."""

    @abstractmethod
    def _start(self) -> TipState:
        """Sample an episode and move to its first pose. Raises Failure if that is impossible."""

    @abstractmethod
    def _forward(self) -> np.ndarray:
        """Return the direction (3,) of the environment's own step, a unit vector in the sensor's frame."""

    @abstractmethod
    def _state(self, estimated: bool) -> np.ndarray:
        """Return the state to observe: true, or as the shipped network estimates it."""

    @abstractmethod
    def _feature_count(self) -> int:
        """Return the number of components of `_features`."""

    @abstractmethod
    def _features(self) -> np.ndarray:
        """Return what a robot knows of the task, without the last action."""

    @abstractmethod
    def _outcome(self) -> tuple[float, bool]:
        """Return the dense reward of a step, and whether the goal is reached. Raises Failure."""

    @abstractmethod
    def _info(self) -> dict[str, Any]:
        """Return the information on a step, beside that of every environment."""

    @abstractmethod
    def _meshes(self) -> tuple[list[ColoredMesh], list[ColoredMesh], np.ndarray]:
        """Return meshes of the scene, base frame: those that stay for an episode, and those that move; and the middle
        (3,), m, of the view."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; see gymnasium.Env. `options` are not used.

        Raises:
            TactipError: No start was found.
        """
        super().reset(seed=seed)
        self._view = None
        self._steps, self._action = 0, np.zeros(len(self.movement.axes))
        problem = ""
        for _ in range(_STARTS):
            try:
                self._touch = self._start()
                self._outcome()
                break
            except (Failure, Unreachable, Diverged) as error:
                problem = str(error)
        else:
            raise TactipError(f"no episode could be started in {_STARTS} tries: {problem}")
        self._commanded = self.tip.arm_model.measured_pose()
        observation = self._observe()
        if self.render_mode == "human":
            self.render()
        return observation, self._all_info(False)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the sensor; see gymnasium.Env.

        Raises:
            TactipError: There is no episode: the environment was not reset.
        """
        if self._touch is None:
            raise TactipError("the environment has no episode: call reset first")
        self._action = np.clip(np.asarray(action, float), -1, 1)
        self._steps += 1
        reward, reached, failed = _FAILURE_REWARD, False, ""
        try:
            self._move()
            dense, reached = self._outcome()
            reward = dense if self.options.reward_mode == "dense" else float(reached)
        except (Failure, Unreachable, Diverged) as error:
            failed = str(error)
            reward = _FAILURE_REWARD if self.options.reward_mode == "dense" else 0.0
        terminated = reached or bool(failed)
        truncated = not terminated and self._steps >= self.options.max_steps
        info = self._all_info(reached) | ({"failure": failed} if failed else {})
        observation = self._observe()
        if self.render_mode == "human":
            self.render()
        return observation, float(reward), terminated, truncated, info

    def _move(self) -> None:
        """Move by the present action. Raises Failure, Unreachable or Diverged."""
        o, motion = self.options, np.zeros(6)
        motion[list(self.movement.axes)] = self._action
        motion = from_mm_deg(motion * ([o.max_move_mm] * 3 + [o.max_turn_deg] * 3))
        if self.movement.forward:
            motion[:3] += o.step_mm / 1e3 * self._forward()
        # A velocity is integrated from where the sensor should be, a position starts from where it is.
        before = self.tip.arm_model.measured_pose() if o.control_mode == "TCP_position_control" else self._commanded
        self._commanded = before @ matrix(motion[:3], Rotation.from_rotvec(motion[3:]))
        self._touch = self.tip.go(self._commanded)
        force = float(np.linalg.norm(self._touch.force))
        if force > o.max_force_n:
            raise Failure(f"the force on the tip is {force:.1f} N (at most {o.max_force_n:g} N)")
        if self._touch.clearance_m < 0 or self._touch.stopped_by == "housing":
            raise Failure("the sensor's housing runs against the object")

    @property
    def touch(self) -> TipState:
        """State of the tip. Raises TactipError without an episode."""
        if self._touch is None:
            raise TactipError("the environment has no episode: call reset first")
        return self._touch

    def _observe(self) -> Observation:
        out: Observation = {}
        features = np.concatenate([self._features(), self._action]).astype(np.float32)
        for name in self._observed:
            if name == "tactile":
                out[name] = self.image()[..., None]
            elif name == "extended_feature":
                out[name] = features
            else:
                out[name] = np.concatenate([self._state(estimated=name == "pose"), features]).astype(np.float32)
        return out

    def _all_info(self, reached: bool) -> dict[str, Any]:
        return {"is_success": reached, "force_n": float(np.linalg.norm(self.touch.force)), **self._info()}

    def image(self) -> np.ndarray:
        """Return the tactile image (size, size) uint8. Raises TactipError if the renderer cannot be used."""
        if self._rendered is None:
            self._rendered = renderer_named(self.options.renderer, self.design)
        return tactile_image(self._rendered(self.touch.pin_tips, self.touch.directions), self.design.image)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return the view of the scene (h, w, 3) uint8 with the tactile image in it; show it for render_mode="human".

        Raises:
            TactipError: There is no render mode, or OpenGL cannot be used.
        """
        if self.render_mode is None:
            raise TactipError("render_mode must be one of rgb_array, human, got None: give it to gymnasium.make")
        static, moving, middle = self._meshes()
        if self.render_mode == "human":
            if self._page is None:
                self._page = EnvironmentPage(_PORT, _EYE_M, _FIELD_DEG)
                print(f"{self._page.address} shows the environment", file=sys.stderr, flush=True)
            force = float(np.linalg.norm(self.touch.force))
            self._page.show(static, moving, middle, self.image(), f"step {self._steps}\n\nforce on the tip: {force:.2f} N")
            return None
        if self._view is None:
            self._view = SceneRenderer(_VIEW_PX[1], _VIEW_PX[0], static)
        frame = self._view.render(moving, middle + _EYE_M, middle, _FIELD_DEG).copy()
        small = cv2.resize(self.image(), (_IMAGE_PX, _IMAGE_PX), interpolation=cv2.INTER_AREA)
        frame[8 : 8 + _IMAGE_PX, -8 - _IMAGE_PX : -8] = small[..., None]
        return frame

    @property
    def address(self) -> str | None:
        """Address of the page of render_mode="human", which is served from the first reset on; None before."""
        return None if self._page is None else self._page.address

    def close(self) -> None:
        """Release the scene, the renderers and the page."""
        if self._page is not None:
            self._page.close()
        self._forget()
