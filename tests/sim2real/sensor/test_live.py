"""The live sensor: videos and folders as sources, and its errors."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.sensor import frame_sources as frames
from tactip_twin.sim2real.sensor.frame_sources import CameraFrames
from tactip_twin.sim2real.sensor.live import LiveSensor
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

ROOT = Path(__file__).parents[3]
WIDTH, HEIGHT, LEFT, TOP = 640, 480, 132, 60
CROP = (LEFT, TOP, LEFT + 360, TOP + 360)


@pytest.fixture(scope="module")
def presses():
    """Frames of a camera, the tip untouched and then pressed, and the depths: grey, 640 by 480 px."""
    design, depths = load_design("tactip-127"), [2.0, 3.0, 4.0]
    simulator = ContactSimulator(design, "surface", fidelity_named("standard"))
    contacts = [simulator.simulate(from_mm_deg([0, 0, -d, 0, 0, 0]), np.zeros(6)) for d in depths]
    raster, shots = Raster(design), []
    for tips, directions in [neutral_pins(design), *((c.pin_tips, c.directions) for c in contacts)]:
        shot = np.full((HEIGHT, WIDTH), 20, np.uint8)
        shot[TOP : TOP + 360, LEFT : LEFT + 360] = raster.render(tips, directions)
        shots.append(cv2.cvtColor(shot, cv2.COLOR_GRAY2BGR))
    return shots, depths


@pytest.fixture
def video(presses, tmp_path):
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (WIDTH, HEIGHT))
    for shot in presses[0]:
        for _ in range(3):
            writer.write(shot)
    writer.release()
    return path


def rows(capsys):
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_camera_video_predicts_each_frame(video, presses, capsys):
    crop = [str(x) for x in CROP]
    assert tactip.main(["camera", "--video", str(video), "--crop", *crop]) == 0
    lines = rows(capsys)
    assert [row["frame"] for row in lines] == list(range(12))
    assert all(row["pins"] == 127 and "fault" not in row for row in lines)
    predicted = np.array([row["pose_z"] for row in lines]).reshape(4, 3)[1:].mean(1)
    assert np.allclose(predicted, [-d for d in presses[1]], atol=0.15)
    assert np.allclose([[row["pose_Rx"], row["pose_Ry"]] for row in lines[3:]], 0, atol=1.0)


def test_camera_images_are_read_in_numeric_order_up_to_limit(presses, tmp_path, capsys):
    for name, shot in zip(("shot_2", "shot_10", "shot_9"), presses[0], strict=False):
        cv2.imwrite(str(tmp_path / f"{name}.png"), shot)
    crop = [str(x) for x in CROP]
    command = ["camera", "--images", str(tmp_path), "--model", "none", "--crop", *crop]
    assert tactip.main(command) == 0
    assert len(rows(capsys)) == 3
    names = [p.stem for p in frames.ImageFrames(tmp_path)._paths]
    assert names == ["shot_2", "shot_9", "shot_10"]
    assert tactip.main([*command, "--frames", "2"]) == 0
    assert len(rows(capsys)) == 2


def test_live_sensor_image_equals_dataset_image(presses):
    options = ImagePreprocessing(threshold=(61, -5.0), crop=CROP, mask="none")
    design = load_design("tactip-127")
    reading = next(iter(LiveSensor(presses[0][1:2], options)))
    plain = tactile_image(presses[0][1], replace(design.image, crop=CROP))
    assert np.array_equal(reading.image, plain)


def test_live_sensor_unusable_frame_is_fault_and_next_is_read(presses):
    shots = [presses[0][0], np.zeros_like(presses[0][0]), presses[0][1][:100], presses[0][2]]
    readings = list(LiveSensor(shots, ImagePreprocessing(threshold=(61, -5.0), crop=CROP)))
    assert [bool(s.fault) for s in readings] == [False, True, True, False]
    assert "pins detected, the undeformed tip has 127" in readings[1].fault
    assert "it must be 640×480 px like the neutral image, got 640×100 px" in readings[2].fault
    assert not readings[1].predicted and "fault" in readings[1].as_json()


def test_live_sensor_first_frame_without_tip_is_refused(presses):
    with pytest.raises(TactipError, match="no tip in the first frame: at least 20 pins must be detected in an image, got 0"):
        list(LiveSensor([np.zeros((HEIGHT, WIDTH, 3), np.uint8)], ImagePreprocessing(threshold=(61, -5.0))))
    with pytest.raises(
        TactipError, match=r"the first frame cannot be used: .* must be square, got 640×480 px: give --crop 132 65 488 421"
    ):
        list(LiveSensor(presses[0], ImagePreprocessing(threshold=(61, -5.0))))


class Unplugged:
    """A capture that gives some frames and then none."""

    def __init__(self, opened, shots):
        self._opened, self._shots = opened, list(shots)

    def isOpened(self):
        return self._opened

    def set(self, *_):
        return True

    def read(self):
        return (True, self._shots.pop(0)) if self._shots else (False, None)

    def release(self):
        self._opened = False


def test_camera_unplugged_reports_error(presses, monkeypatch, capsys):
    monkeypatch.setattr(cv2, "VideoCapture", lambda device: Unplugged(True, presses[0]))
    monkeypatch.setattr(CameraFrames.__init__, "__defaults__", (0.05,))
    crop = [str(x) for x in CROP]
    assert tactip.main(["camera", "--device", "0", "--model", "none", "--crop", *crop]) == 1
    captured = capsys.readouterr()
    assert len(captured.out.splitlines()) == 4  # earlier frames were printed
    assert "no frame from camera 0 for 0.05 s: check that it is plugged in" in captured.err
    monkeypatch.setattr(cv2, "VideoCapture", lambda device: Unplugged(False, []))
    assert tactip.main(["camera", "--device", "0"]) == 1
    assert "camera 0 cannot be opened" in capsys.readouterr().err


def test_camera_page_stays_after_last_frame_until_interrupt(video):
    command = [
        sys.executable,
        "-m",
        "tactip_twin.commands.main",
        "camera",
        "--video",
        str(video),
        "--model",
        "none",
        "--browser",
        "--port",
        "18931",
    ]
    with subprocess.Popen(
        [*command, "--crop", *(str(x) for x in CROP)],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509
    ) as process:
        assert process.stderr is not None
        lines = ""
        while "until Ctrl-C" not in lines:
            line = process.stderr.readline()
            assert line, lines
            lines += line
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert "12 frames, 0 unusable" in process.stderr.read()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--device", "-1"], "tactip: device must be a whole number from 0 to 1000, got -1"),
        (["--images", "b", "--frames", "-2"], "tactip: frames must be a whole number from 0 to 1e+09, got -2"),
        ([], "one of --device, --video and --images must be given, got 0 of them"),
        (["--video", "a.avi", "--images", "b"], "must be given, got 2 of them"),
        (["--video", "nothing.avi"], "the video nothing.avi does not exist"),
        (["--video", __file__], "cannot be read as a video"),
        (["--images", "nowhere"], "nowhere is not a folder of images"),
        (["--images", "."], "no image in ."),
    ],
)
def test_camera_wrong_source_reports_error(options, words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert tactip.main(["camera", *options]) == 1
    assert words in capsys.readouterr().err


def test_camera_network_of_other_size_is_refused(video, capsys):
    assert tactip.main(["camera", "--video", str(video), "--size-px", "64"]) == 1
    assert "size_px must be 128 for this network, got 64" in capsys.readouterr().err
