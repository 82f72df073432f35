"""Gymnasium's interface, reproducibility, and the modes of the environments."""

import importlib
import pickle
import sys

import numpy as np
import pytest

from helpers.headless_browser import PROGRAM, Chromium
from tactip_twin.tactip_model.errors import TactipError

gymnasium = pytest.importorskip("gymnasium")

EDGE = {"id": "tactip_twin/EdgeFollow-v0", "objects": ("rim-round",), "image_size_px": 32}
SURFACE = {"id": "tactip_twin/SurfaceFollow-v0", "objects": ("plate",), "image_size_px": 32}
SLOW = pytest.mark.slow
ROLL = {"id": "tactip_twin/ObjectRoll-v0", "image_size_px": 32}


@pytest.fixture(scope="module")
def made():
    """A function that makes an environment, and keeps it for the same options."""
    import tactip_twin.control.environments  # noqa: F401  (registers them)

    kept = {}

    def make(options, **others):
        key = repr((options, others))
        if key not in kept:
            kept[key] = gymnasium.make(**options, **others)
        return kept[key]

    yield make
    for environment in kept.values():
        environment.close()


def episode(environment, seed, steps=4):
    """Return the bytes of an episode of given actions."""
    observation, _ = environment.reset(seed=seed)
    seen = [value.tobytes() for value in observation.values()]
    for k in range(steps):
        action = np.full(environment.action_space.shape, 0.2 * (-1) ** k, np.float32)
        observation, reward, terminated, truncated, info = environment.step(action)
        seen += [value.tobytes() for value in observation.values()]
        seen += [np.float64(reward).tobytes(), bytes([terminated, truncated]), repr(sorted(info.items())).encode()]
    return b"".join(seen)


@pytest.mark.parametrize("options", [EDGE, pytest.param(SURFACE, marks=SLOW), ROLL])
def test_environment_meets_the_interface(made, options):
    from gymnasium.utils.env_checker import check_env

    check_env(made(options, observation_mode="tactile_and_feature").unwrapped, skip_render_check=True)


@pytest.mark.parametrize("options", [EDGE, pytest.param(SURFACE, marks=SLOW), pytest.param(ROLL, marks=SLOW)])
def test_seed_reproduces_an_episode_byte_for_byte(made, options):
    """Also after other episodes, and in a copy that went through a pickle."""
    environment = made(options, observation_mode="tactile_and_feature")
    first = episode(environment, 3)
    assert episode(environment, 4) != first
    assert episode(environment, 3) == first
    copy = pickle.loads(pickle.dumps(environment))  # noqa: S301  (our own bytes)
    assert episode(copy, 3) == first
    # Without a seed, the next episode continues the generator, which the pickle keeps.
    environment.reset(seed=5)
    copy = pickle.loads(pickle.dumps(environment))  # noqa: S301
    assert episode(copy, None) == episode(environment, None)
    copy.close()


@pytest.mark.parametrize(
    ("mode", "forward", "axes"),
    [("xy", False, (0, 1)), ("xyRz", False, (0, 1, 5)), ("TyRz", True, (1, 5)), ("TxzRxRyRz", True, (0, 2, 3, 4, 5))],
)
def test_movement_mode_names_the_axes(mode, forward, axes):
    from tactip_twin.control.environments.options import movement_named

    movement = movement_named(mode)
    assert (movement.forward, movement.axes) == (forward, axes)


@pytest.mark.parametrize("mode", ["T", "yx", "RzT", "xyw"])
def test_movement_mode_that_is_none_is_refused(mode):
    from tactip_twin.control.environments.options import FollowOptions

    with pytest.raises(TactipError, match="movement_mode must be some of x, y, z, Rx, Ry and Rz in this order"):
        FollowOptions(movement_mode=mode)


@pytest.mark.parametrize(
    ("options", "wrong", "words"),
    [
        (EDGE, {"observation_mode": "visual"}, "unknown observation mode 'visual': choose one of oracle, pose, tactile"),
        (EDGE, {"control_mode": "joints"}, "unknown control mode 'joints'"),
        (EDGE, {"max_move_mm": 5.0}, "max_move_mm must be a finite number from 0.01 to 1.5, got 5.0"),
        (EDGE, {"speed": 5.0}, "unknown option"),
        (ROLL, {"fidelity": "fast"}, "fidelity must be draft, standard or reference, got 'fast'"),
        (ROLL, {"observation_mode": "pose"}, "no network estimates where a ball is"),
    ],
)
def test_environment_invalid_option_is_refused(made, options, wrong, words):
    with pytest.raises(TactipError, match=words):
        made({**options, **wrong})


def test_edge_of_an_object_without_one_is_refused(made):
    with pytest.raises(TactipError, match="the edge of plate is unknown: choose one of rim-round, rim-square, rim-uneven"):
        made({**EDGE, "objects": ("plate",)}).reset(seed=0)


def test_step_before_reset_is_refused(made):
    with pytest.raises(TactipError, match="call reset first"):
        made({**EDGE, "max_steps": 7}).unwrapped.step(np.zeros(5, np.float32))


def test_action_moves_the_sensor_in_its_own_frame(made):
    """On a level rim with an ideal arm, motions are exact: forward along the edge, and z out of the tip."""
    environment = made(EDGE, start_mm=0.0, start_deg=0.0, movement_mode="TxzRxRyRz")
    environment.reset(seed=0)
    before = environment.unwrapped.tip.arm_model.pose
    _, reward, _, _, info = environment.step(np.array([0.2, 0.6, 0, 0, 0.75], np.float32))
    motion = np.linalg.inv(before) @ environment.unwrapped.tip.arm_model.pose
    assert np.allclose(motion[:3, 3], [0.1e-3, -1e-3, 0.3e-3], atol=1e-9)
    assert np.arctan2(motion[1, 0], motion[0, 0]) == pytest.approx(np.radians(1.5))
    error = info["error_mm_deg"]
    assert error[2] == pytest.approx(-0.3, abs=1e-6)
    assert info["progress_mm"] == pytest.approx(1, abs=0.02)
    cost = 0.5 * abs(error[0]) + 0.5 * abs(error[2]) + 0.1 * np.abs(error[3:]).sum()
    assert reward == pytest.approx(info["progress_mm"] - cost)


def test_velocities_are_integrated_from_the_commanded_pose(made):
    """The dynamic arm gives way to the contact; a position starts from where it is, a velocity from where it should be."""
    ends = {}
    for mode in ("TCP_position_control", "TCP_velocity_control"):
        environment = made(EDGE, control_mode=mode, arm="dynamic", start_deg=0.0)
        environment.reset(seed=1)
        first = environment.unwrapped._commanded
        for _ in range(2):
            environment.step(np.zeros(5, np.float32))
        ends[mode] = np.linalg.inv(first) @ environment.unwrapped._commanded
    ideal = np.array([0, -2e-3, 0])
    assert np.allclose(ends["TCP_velocity_control"][:3, 3], ideal, atol=1e-12)
    assert 1e-9 < np.linalg.norm(ends["TCP_position_control"][:3, 3] - ideal) < 0.2e-3


def test_failure_ends_the_episode(made):
    environment = made(EDGE)
    environment.reset(seed=0)
    over, count = False, 0
    while not over:
        _, reward, over, _, info = environment.step(np.array([1, 0, 0, 0, 0], np.float32))
        count += 1
    assert "mm beside the edge (at most 6)" in info["failure"]
    assert reward == -10 and not info["is_success"] and count < 16


@pytest.mark.slow
def test_goal_is_reached_and_rewarded(made):
    """Without T, the policy moves itself; the goal is where the edge leads."""
    options = {"movement_mode": "xyRz", "length_mm": 12.0, "reward_mode": "sparse", "start_mm": 0.0, "start_deg": 0.0}
    environment = made(EDGE, observation_mode="tactile_and_feature", **options)
    observation, _ = environment.reset(seed=2)
    total, over = 0.0, False
    while not over:
        goal = observation["extended_feature"][:3]
        action = np.clip([goal[0] / 2, goal[1] / 2, 0.3], -1, 1).astype(np.float32)
        observation, reward, over, truncated, info = environment.step(action)
        total += reward
        assert not truncated
    assert info["is_success"] and total == 1
    assert np.linalg.norm(goal) < 5


def test_render_shows_the_tactile_image(made):
    environment = made({**ROLL, "image_size_px": 128}, render_mode="rgb_array")
    environment.reset(seed=0)
    frame = environment.render()
    assert frame.shape == (480, 480, 3) and frame.dtype == np.uint8
    shown = frame[8:168, -168:-8, 0] > 127
    assert shown.any() and not shown.all()
    with pytest.raises(TactipError, match="render_mode must be one of rgb_array, human"):
        made(EDGE).unwrapped.render()


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium here")
def test_browser_shows_each_step(made, capsys):
    """The page needs no OpenGL here; a reset shows the new episode's first state."""
    environment = made({**ROLL, "image_size_px": 128}, render_mode="human")
    environment.reset(seed=0)
    address = environment.unwrapped.address
    assert f"{address} shows the environment" in capsys.readouterr().err
    browser = Chromium(address)

    def shows(step):
        state = f"step {step} force on the tip: {np.linalg.norm(environment.unwrapped.touch.force):.2f} N"
        image = browser.evaluate("Math.max(0, ...[...document.images].map(image => image.naturalWidth))")
        scene = browser.screenshot()[300:, 450:850].astype(int)
        # The skin and the housing are darker than the table.
        return state in " ".join(browser.text().split()) and image >= 128 and (scene.max(2) < 130).mean() > 0.02

    try:
        browser.until(lambda: shows(0))
        for _ in range(3):
            environment.step(np.ones(environment.action_space.shape, np.float32))
        browser.until(lambda: shows(3))
        environment.reset(seed=1)
        browser.until(lambda: shows(0))
    finally:
        browser.close()
        environment.close()


def test_base_install_has_an_error_of_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "tactip_twin.control.environments", raising=False)
    with pytest.raises(
        TactipError, match=r"the environments need gymnasium: in the clone, .venv/bin/pip install -e '.\[rl\]'"
    ):
        importlib.import_module("tactip_twin.control.environments")


def test_shipped_policy_follows_a_surface(made):
    from tactip_twin.assets import POLICIES
    from tactip_twin.control.policy import read_policy

    policy = read_policy(POLICIES / "surface-follow.npz")
    environment = made({"id": policy.environment, **policy.options, "objects": ("sphere",), "length_mm": 20.0})
    observation, info = environment.reset(seed=1)
    over, steps, errors = False, 0, []
    while not over:
        observation, _, over, _, info = environment.step(policy(observation))
        errors.append(info["error_mm_deg"])
        steps += 1
    assert info["is_success"] and steps < 30
    assert np.abs(errors[10:]).mean(0)[2] < 0.3 and np.linalg.norm(np.array(errors[10:])[:, 3:5], axis=1).mean() < 4


@pytest.mark.slow
def test_vector_environment_in_processes_gives_the_same_episodes(made):
    """A process that is started anew finds the environments by the module in front of their name."""
    name = f"tactip_twin.control.environments:{EDGE['id']}"
    others = {key: value for key, value in EDGE.items() if key != "id"}
    in_processes = {"vectorization_mode": "async", "vector_kwargs": {"context": "spawn"}}
    together = gymnasium.make_vec(name, num_envs=2, **in_processes, **others)
    observations, _ = together.reset(seed=[3, 4])
    first, *_ = together.step(np.zeros((2, 5), np.float32))
    together.close()
    for k, seed in enumerate((3, 4)):
        environment = made(EDGE)
        alone, _ = environment.reset(seed=seed)
        assert np.array_equal(alone["oracle"], observations["oracle"][k])
        assert np.array_equal(environment.step(np.zeros(5, np.float32))[0]["oracle"], first["oracle"][k])
