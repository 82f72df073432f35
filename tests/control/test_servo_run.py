"""`tactip servo`: its outputs and its error messages."""

import json
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from helpers.kills import end_at_rename
from tactip_twin.benchmarks.servo.contact_patch import contact_patch_normal
from tactip_twin.commands import main as tactip
from tactip_twin.control.estimator import Estimate
from tactip_twin.control.options import RouteOptions, ServoOptions, Settings
from tactip_twin.control.score import coverage, summary
from tactip_twin.control.servo import DEPTHS_MM, Controller
from tactip_twin.control.servo_run import run_servo
from tactip_twin.sim.pose import from_mm_deg, matrix, to_mm_deg
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.robot.recording import PHASES, read_recording
from tactip_twin.sim.view.tactile_picture import pin_projection, tactile_picture
from tactip_twin.tactip_model.errors import TactipError

QUICK = ["servo", "--fidelity", "draft", "--renderer", "raster", "--object", "plate", "--settings.alignment-steps", "4"]
SHORT = ["--route.kind", "straight", "--route.length-mm", "4"]


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A short run with the shipped network, and its outputs."""
    out = tmp_path_factory.mktemp("servo") / "run"
    assert tactip.main([*QUICK, *SHORT, "--out", str(out)]) == 0
    return out, json.loads((out / "score.json").read_text()), *read_recording(out)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"noise_grey": -1.0}, "noise_grey must be a finite number from 0 to 255, got -1.0"),
        ({"friction": 2.5}, "friction must be a finite number from 0 to 2, got 2.5"),
        ({"settle_steps": 0}, "settle_steps must be a whole number from 1 to 1000, got 0"),
        ({"scale": 0.0}, "scale must be a finite number from 1e-06 to 1e\\+06, got 0.0"),
    ],
)
def test_servo_options_out_of_bounds_are_refused(tmp_path, options, words):
    with pytest.raises(TactipError, match=words):
        ServoOptions(tmp_path / "run", **options)


def test_servo_run_writes_a_complete_score(ran):
    _, score, record, _ = ran
    assert score["stopped_because"] == "route completed"
    assert score["contact_losses"] == 0
    assert score["events"] == {}
    assert score["left_out"] == []
    assert score["reachable"] == 1
    assert score["coverage_of_reachable"] == score["coverage"]
    assert score["penetration_within_bound"] > 0.99
    fitting = score["errors"]["where the tip fits"]
    assert fitting["steps"] == score["steps_followed"]
    assert fitting["depth_mae_mm"] == pytest.approx(score["depth_mae_mm"])
    assert score["depth_mae_mm"] < 0.4
    assert score["angle_mean_deg"] < score["angle_p95_deg"] < 3
    assert (
        score["steps"]
        == record["steps"]
        == score["steps_followed"] + sum(record["steps"] - f for f in [score["steps_followed"]])
    )
    # From the end of the first step to half a millimetre before the end of the route.
    assert 2 < score["path_mm"] < 4
    assert score["coverage"] > 0.9
    assert score["lateral_mae_mm"] is None
    assert not score["closed"]
    assert [p["pass"] for p in score["passes"]] == [0]
    assert set(score["ms_a_step"]) == {"simulation", "image", "network", "control"}


def test_summary_says_what_to_do_where_the_arm_cannot_reach(ran):
    _, score, _, _ = ran
    assert not any("cannot reach" in line for line in summary(score))
    left_out = [
        {"from_mm": 1.0, "to_mm": 3.0, "kind": kind, "places_mm": []} for kind in ("unreachable", "force", "unreachable")
    ]
    lines = summary(score | {"left_out": left_out})
    assert "left out: 6 mm of the route" in lines
    assert any("the arm cannot reach 4 mm of the route" in line and "--position-mm" in line for line in lines)


def test_contact_patch_normal_on_a_plate_equals_the_normal_at_the_apex(ran):
    out, _, _, arrays = ran
    patch = contact_patch_normal(out, load_object("plate"))
    assert np.allclose(patch["apart_deg"], 0, atol=1e-3)
    errors = np.abs(arrays["predicted"] - arrays["true"])[arrays["phase"] == PHASES.index("follow"), 3:5]
    assert np.allclose(patch["predicted_deg"], np.degrees(np.linalg.norm(errors, axis=1)).mean(), atol=0.05)


def test_servo_depth_outside_the_training_range_is_refused(tmp_path, capsys):
    assert tactip.main([*QUICK, *SHORT, "--depth-mm", "6", "--out", str(tmp_path / "run")]) == 1
    refusal = "--depth-mm must be between 0.5 and 5, got 6: the network surface-curved-256px-tactip-127"
    assert refusal in capsys.readouterr().err


def test_servo_recording_is_complete_and_consistent(ran):
    out, score, record, arrays = ran
    assert record["complete"] and not (out / "steps.log").exists()
    following = arrays["phase"] == PHASES.index("follow")
    true = to_mm_deg(arrays["true"][following])
    assert score["depth_mae_mm"] == pytest.approx(np.abs(true[:, 2] + DEPTHS_MM["surface"]).mean())
    assert arrays["images"].shape[1:] == (256, 256)
    assert set(np.unique(arrays["images"])) == {0, 255}
    assert arrays["pin_tips_m"].shape[1:] == (127, 3)
    # True labels belong to the recorded poses: on a plate, depth equals height.
    height = arrays["T_base_tcp"][:, 2, 3] - 0.02
    assert np.allclose(arrays["true"][:, 2], height, atol=1e-9)
    assert np.isfinite(arrays["angles_rad"]).all()
    assert record["options"]["object"] == "plate"
    assert record["network"]["train"]["digest"]


def test_servo_same_run_twice_gives_equal_arrays(ran, tmp_path):
    """All arrays but the measured times."""
    assert tactip.main([*QUICK, *SHORT, "--out", str(tmp_path / "again")]) == 0
    _, arrays = read_recording(tmp_path / "again")
    for name, values in ran[3].items():
        assert name == "seconds" or np.array_equal(values, arrays[name], equal_nan=name in ("angles_rad", "deviations")), (
            name
        )


def test_servo_json_prints_one_object(tmp_path, capsys):
    assert tactip.main([*QUICK, "--route.kind", "straight", "--route.length-mm", "1", "--model", "oracle", "--arm", "none",
                        "--settings.alignment-steps", "12", "--json", "--out", str(tmp_path / "run")]) == 0  # fmt: skip
    score = json.loads(capsys.readouterr().out)
    assert score["depth_mae_mm"] < 0.2


def test_servo_with_the_shipped_network_follows_an_edge(tmp_path):
    out = tmp_path / "run"
    command = [*QUICK, "--task", "edge", "--object", "rim-round", "--route.max-length-mm", "5", "--out", str(out)]
    assert tactip.main(command) == 0
    score = json.loads((out / "score.json").read_text())
    assert score["lateral_mae_mm"] < 1
    assert score["angle_mean_deg"] < 4
    assert 0.005 < score["coverage"] < 0.1


def test_servo_ctrl_c_keeps_the_recorded_steps(tmp_path, monkeypatch, capsys):
    from tactip_twin.control.sensed_tip import SensedTip

    calls, go = [], SensedTip.go

    def interrupted(self, *rest):
        calls.append(1)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return go(self, *rest)

    monkeypatch.setattr(SensedTip, "go", interrupted)
    out = tmp_path / "run"
    assert tactip.main([*QUICK, *SHORT, "--out", str(out)]) == 130
    assert "the steps so far are in" in capsys.readouterr().err
    record, arrays = read_recording(out)
    assert record["stopped_because"] == "interrupted by Ctrl-C"
    assert len(arrays["phase"]) == 6
    assert json.loads((out / "score.json").read_text())["steps"] == 6


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--object", "cup"], "unknown object 'cup': choose one of bust"),
        (["--design", "tactip-331"], "no surface network is shipped for the design 'tactip-331': choose one with --model"),
        (["--model", "none"], "neither a folder nor a shipped model"),
        (["--task", "edge"], "the edge of plate is unknown: the edge task needs one of edge, rim-round"),
        (
            ["--task", "surface", "--model", "edge-tactip-127"],
            "was trained for the task edge, but --task is surface: choose another --model",
        ),
        (["--route.middle-mm", "900", "0"], "must begin above the object, got"),
        (["--settings.step-mm", "99"], "step_mm must be a finite number from 0.05 to 10, got 99.0"),
        (["--seed", "-1"], "tactip: seed must be a whole number from 0 to"),
        (
            ["--position-mm", "nan", "0", "0"],
            "tactip: position_mm must be a finite number from -10000 to 10000, got (nan, 0.0, ",
        ),
    ],
)
def test_servo_invalid_input_prints_one_line(ran, tmp_path, capsys, options, words):
    """The libraries are loaded by an earlier run; otherwise a status line about loading would come first."""
    capsys.readouterr()
    assert tactip.main([*QUICK, *SHORT, *options, "--out", str(tmp_path / "run")]) == 1
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "run" / "recording.json").exists()


@pytest.mark.parametrize(
    ("option", "value", "choices"),
    [
        ("--task", "corner", ("surface", "edge")),
        ("--arm", "left", ("none", "kinematic", "dynamic")),
        ("--gains", "high", ("paper", "tactile-servo-control")),
        ("--fidelity", "perfect", ("draft", "standard", "reference")),
        ("--route.kind", "spiral", ("serpentine", "straight", "geodesic")),
        ("--renderer", "blender", ("pyrender", "raster")),
    ],
)
def test_servo_unknown_choice_exits_with_2_and_lists_the_choices(tmp_path, capsys, option, value, choices):
    with pytest.raises(SystemExit) as ended:
        tactip.main(["servo", option, value, "--out", str(tmp_path / "run")])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert option in error and all(repr(choice) in error for choice in (value, *choices))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("wrong", [{"task": "corner"}, {"gains": "high"}, {"arm": "left"}, {"fidelity": "perfect"}])
def test_run_servo_unknown_choice_is_refused(tmp_path, wrong):
    with pytest.raises(TactipError, match=f"unknown {next(iter(wrong))} '{next(iter(wrong.values()))}'"):
        run_servo(ServoOptions(tmp_path / "run", object="plate", **wrong))


def test_servo_into_a_finished_run_is_refused(ran, capsys):
    assert tactip.main([*QUICK, *SHORT, "--out", str(ran[0])]) == 1
    assert "is not empty" in capsys.readouterr().err


def test_servo_start_out_of_reach_is_reported(tmp_path):
    out = tmp_path / "run"
    far = ["servo", "--fidelity", "draft", "--object", "plate", "--video", "--position-mm", "750", "0", "0", *SHORT]
    assert tactip.main([*far, "--out", str(out)]) == 1  # there is a recording, but no step followed the object
    assert not (out / "film.mp4").exists()
    assert tactip.main(["replay", str(out), "--gif", str(tmp_path / "a.gif")]) == 1
    assert "the start is out of reach" in json.loads((out / "score.json").read_text())["stopped_because"]


def test_servo_oracle_runs_a_design_without_a_shipped_network(tmp_path):
    options = ["--design", "nominal-331", "--model", "oracle", "--settings.max-steps", "60"]
    assert tactip.main([*QUICK, *SHORT, *options, "--out", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run" / "score.json").read_text())["depth_mae_mm"] is not None


def own_options(tmp_path):
    route = RouteOptions(kind="straight", length_mm=2)
    quick = {"arm": "none", "fidelity": "draft", "renderer": "raster", "settings": Settings(alignment_steps=4)}
    return ServoOptions(tmp_path / "run", object="plate", route=route, **quick)


@pytest.mark.parametrize("label", [(-2.0, 0.0, 0.0), (0.0, 0.0, -2.0, 0.0, 0.0, 0.0)])
def test_run_servo_function_of_the_image_takes_the_networks_place(tmp_path, label):
    images = []

    def estimate(image):
        images.append(image)
        return label

    score = run_servo(own_options(tmp_path), log=lambda line: None, estimator=estimate)
    record, arrays = read_recording(tmp_path / "run")
    assert score["stopped_because"] == "route completed"
    assert (record["estimator"], record["network"]) == ("ImageEstimator", None)
    assert len(images) == 1 + len(arrays["predicted"])  # one is the neutral image
    assert images[0].shape == (128, 128)
    assert np.allclose(to_mm_deg(arrays["predicted"]), [0, 0, -2, 0, 0, 0])


def test_run_servo_function_with_a_wrong_label_is_refused(tmp_path):
    with pytest.raises(TactipError, match=r"the label must be 3 or 6 numbers, got \[1.0, 2.0\]"):
        run_servo(own_options(tmp_path), log=lambda line: None, estimator=lambda image: [1, 2])


def test_run_servo_own_parts_take_the_place_of_network_and_controller(tmp_path):
    class Still(Controller):
        moves = resets = 0

        def move(self, label, along=(0.0, 0.0, 0.0), max_press_m=np.inf):
            self.moves += 1
            return matrix(along, Rotation.identity())

    class Fixed:
        def estimate(self, touch, T_base_tcp):
            return Estimate(from_mm_deg([0, 0, -2, 0, 0, 0]), float(touch.force[2] != 0))

    still = Still()
    options = replace(own_options(tmp_path), design="nominal-331")  # no network is shipped for it
    score = run_servo(options, log=lambda line: None, estimator=Fixed(), controller=still)
    record, arrays = read_recording(tmp_path / "run")
    assert (record["estimator"], record["controller"]) == ("Fixed", "Still")
    assert 0 < still.moves <= score["steps"]
    following = arrays["T_base_tcp"][arrays["phase"] == PHASES.index("follow"), :3, 3]
    assert np.ptp(following[:, 2]) < 1e-9  # nothing corrects the depth


def test_run_servo_controller_without_its_methods_is_refused(tmp_path):
    with pytest.raises(TactipError, match=r"must have the methods move, reset and limited_to, .* got a object"):
        run_servo(own_options(tmp_path), log=lambda line: None, controller=object())
    assert not (tmp_path / "run").exists()


def test_coverage_counts_targets_within_reach():
    targets = np.stack([np.arange(10), np.zeros(10), np.zeros(10)], -1).astype(float)
    assert coverage(targets[:1], targets, 2.5) == pytest.approx(0.3)
    assert coverage(targets[:0], targets, 2.5) == 0


@pytest.mark.slow
def test_servo_video_shows_every_step(tmp_path):
    """Each frame shows the arm, the object and the tactile image of its step."""
    import av

    out = tmp_path / "run"
    command = ["servo", "--fidelity", "draft", "--object", "plate", "--route.kind", "straight", "--route.length-mm", "1"]
    assert tactip.main([*command, "--video", "--out", str(out)]) == 0
    record, arrays = read_recording(out)
    with av.open(str(out / "film.mp4")) as film:
        frames = [f.to_ndarray(format="rgb24") for f in film.decode(video=0)]
    assert len(frames) == len(arrays["phase"])
    assert frames[0].shape == (630, 1120, 3)
    project = pin_projection(record)
    arrows = np.stack([project(arrays["pin_tips_m"][k]) for k in (0, -1)], 1)
    picture = tactile_picture(arrays["images"][-1], arrows)
    assert picture.shape == (256, 256, 3)  # a larger one would be shown smaller
    assert np.corrcoef(frames[-1][16 : 16 + 256, 782:1038].ravel(), picture.ravel())[0, 1] > 0.9
    assert (out / "figure.png").stat().st_size > 5000
    # A replay of the recording gives the same frames.
    again, gif = tmp_path / "again.mp4", tmp_path / "again.gif"
    page = tmp_path / "page.html"
    written = ["--video", str(again), "--gif", str(gif), "--html", str(page)]
    assert tactip.main(["replay", str(out), *written, "--stride", "4"]) == 0
    assert 5e4 < page.stat().st_size < 20e6 and "@DATA@" not in page.read_text()
    with av.open(str(again)) as film:
        few = [f.to_ndarray(format="rgb24") for f in film.decode(video=0)]
    assert len(few) == len(frames[::4])
    assert all(np.abs(a.astype(int) - b).mean() < 3 for a, b in zip(few, frames[::4], strict=True))
    with Image.open(gif) as picture:
        assert picture.n_frames == len(few)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "there is no recording in"),
        (["--video", "a.gif"], "the file name must end in .mp4, got a.gif"),
        (["--gif", "a.gif", "--stride", "0"], "--stride and --fps must be at least 1, got 0 and 25"),
        (["--gif", "a.gif"], "there is no recording in"),
    ],
)
def test_replay_invalid_input_is_refused(tmp_path, capsys, options, words):
    assert tactip.main(["replay", str(tmp_path), *options]) == 1
    assert words in capsys.readouterr().err


def test_servo_video_without_pyrender_is_refused(tmp_path, capsys):
    assert tactip.main([*QUICK, *SHORT, "--video", "--out", str(tmp_path / "run")]) == 1
    assert "--video needs OpenGL, but --renderer raster works without" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", [pytest.param("score.json", marks=pytest.mark.slow), "steps.npz"])
def test_servo_killed_after_its_last_step_runs_again(tmp_path, name):
    out = tmp_path / "run"
    command = [
        *QUICK,
        "--route.kind",
        "straight",
        "--route.length-mm",
        "1",
        "--arm",
        "none",
        "--model",
        "oracle",
        "--out",
        str(out),
    ]
    killed = multiprocessing.get_context("forkserver").Process(target=end_at_rename, args=(name, command))
    killed.start()
    killed.join()
    assert killed.exitcode == 9
    record, arrays = read_recording(out)
    assert not record["complete"] and record["steps"] > 5
    assert tactip.main(command) == 0
    assert np.array_equal(read_recording(out)[1]["true"], arrays["true"])
    assert {p.name for p in out.iterdir()} == {".lock", "recording.json", "scenery.npz", "score.json", "steps.npz"}
