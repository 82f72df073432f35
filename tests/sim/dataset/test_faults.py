"""A set is whole after a kill, a full disk, a lost worker; it goes on, and grows, to the same bytes."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from helpers.set_commands import TACTIP, contents, make, records, run, samples_found, wait_for
from tactip_twin.commands import main as tactip
from tactip_twin.sim.parallel.file_lock import locked


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_is_resumed_to_the_same_bytes(whole, tmp_path, workers):
    folder = tmp_path / "killed"
    process = subprocess.Popen(make(folder, workers=workers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for(lambda: len(records(folder)) >= 2)
    process.kill()
    process.wait()
    assert not (folder / "meta.json").exists()
    told = run([*TACTIP, "verify", str(folder)])
    assert told.returncode == 1
    assert "unfinished" in told.stderr
    kept = len(records(folder))
    (folder / "images" / ".image_00000.png.1.tmp").write_bytes(b"half a fi")  # what a kill in a write leaves
    # The orphans of the killed run end by themselves, at the latest with the sample in their hands.
    resumed = run(make(folder, workers=2))
    assert resumed.returncode == 0
    assert samples_found(resumed.stderr + resumed.stdout) in (kept, kept + 1, kept + 2)
    assert contents(folder) == contents(whole)


def test_a_finished_set_grows_to_the_same_bytes(whole, tmp_path):
    folder = tmp_path / "small"
    assert run(make(folder, samples=3)).returncode == 0
    (folder / ".partial").mkdir()  # and a kill came between the last two steps
    (folder / ".partial" / "configuration.json").write_text("{}")
    grown = run(make(folder))
    assert grown.returncode == 0, grown.stderr
    assert "3 of 6 samples are there already" in grown.stderr
    assert contents(folder) == contents(whole)


def test_growth_that_is_killed_halfway_goes_on(whole, tmp_path, monkeypatch):
    folder = tmp_path / "small"
    assert run(make(folder, samples=4)).returncode == 0
    before = contents(folder)

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("tactip_twin.sim.dataset.partial_record.record_path", killed)
        options = ["--samples", "6", "--fidelity", "draft", "--renderer", "raster", "--design", "nominal-127"]
        assert tactip.main(["dataset", "make", "--task", "edge", "--out", str(folder), *options]) != 0
    assert before.items() <= contents(folder).items()
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


def test_a_set_that_another_command_makes_larger_is_left_to_it(copy, capsys):
    """It is whole, as far as meta.json goes, until its records are written: what is beside it is not a leftover."""
    (copy / ".partial").mkdir()
    before = contents(copy)
    options = ["--samples", "6", "--fidelity", "draft", "--renderer", "raster", "--design", "nominal-127"]
    command = ["dataset", "make", "--task", "edge", "--out", str(copy), *options]
    with locked(copy / ".partial" / "lock", f"making the set in {copy}"):
        assert tactip.main(command) == 1
        assert "another command is making the set" in capsys.readouterr().err
        assert (copy / ".partial" / "lock").exists()
    assert tactip.main(command) == 0
    assert not (copy / ".partial").exists()
    assert contents(copy) == before


@pytest.mark.parametrize(("damaged", "words"), [("pins.npz", "damaged"), ("targets.csv", "targets.csv")])
def test_a_damaged_set_does_not_grow(copy, capsys, damaged, words):
    (copy / damaged).write_bytes(b"")
    before = contents(copy)
    options = ["--samples", "8", "--fidelity", "draft", "--renderer", "raster", "--design", "nominal-127"]
    assert tactip.main(["dataset", "make", "--task", "edge", "--out", str(copy), *options]) == 1
    assert words in capsys.readouterr().err
    assert {n: b for n, b in contents(copy).items() if ".partial" not in n} == before


def test_an_image_lost_before_the_end_is_made_again(whole, tmp_path):
    folder = tmp_path / "holed"
    process = subprocess.Popen(make(folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    # Which worker is the first is chance: with three records, image 0 may still be on its way.
    wait_for((folder / ".partial" / "000000.npz").exists)
    process.kill()
    process.wait()
    (folder / "images" / "image_00000.png").unlink()
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


def test_resuming_makes_only_what_is_missing(whole, tmp_path):
    folder = tmp_path / "resumed"
    assert run(make(folder)).returncode == 0
    again = run(make(folder))
    assert again.returncode == 0
    assert "complete already" in again.stdout
    assert contents(folder) == contents(whole)


@pytest.mark.parametrize(("after", "number"), [(0, signal.SIGINT), (3, signal.SIGINT), (3, signal.SIGTERM)])
def test_ctrl_c_keeps_what_is_done(tmp_path, after, number):
    """While the workers are starting, and in the middle of the work; and so does what a scheduler sends."""
    folder = tmp_path / "stopped"
    process = subprocess.Popen(
        make(folder, samples=60),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Where the tests run in the background of a shell, Ctrl-C is ignored, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    wait_for(lambda: (folder / ".partial" / "configuration.json").exists() and len(records(folder)) >= after)
    time.sleep(0.3)  # into the start of the workers
    os.killpg(process.pid, number)  # as a terminal does: to parent and workers alike
    _, told = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert "the same command goes on from there" in told
    assert "Traceback" not in told
    assert after <= len(records(folder)) < 60


def test_a_dead_worker_is_replaced(whole, tmp_path):
    folder = tmp_path / "replaced"
    process = subprocess.Popen(make(folder, workers=1), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wait_for(lambda: len(records(folder)) >= 1)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    workers = [c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
    os.kill(int(workers[0]), signal.SIGKILL)
    told, _ = process.communicate(timeout=120)
    assert process.returncode == 0, told
    assert "another takes over" in told
    assert contents(folder) == contents(whole)


def test_two_commands_do_not_make_one_set(tmp_path):
    folder = tmp_path / "contested"
    first = subprocess.Popen(make(folder, samples=60), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: len(records(folder)) >= 1)
        second = run(make(folder, samples=60))
        assert second.returncode == 1
        assert "another command is making" in second.stderr
    finally:
        first.kill()
        first.wait()


@pytest.mark.parametrize("begun", [".partial", ".partial/lock", ".targets.csv.7.tmp"])
def test_a_kill_in_the_very_first_or_last_writes_is_mended(whole, tmp_path, begun):
    """Folders and lock made and nothing else; half a table beside them."""
    folder = tmp_path / "begun"
    (folder / ".partial").mkdir(parents=True)
    if begun != ".partial":
        (folder / begun).write_text("")
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


def test_a_kill_between_the_last_two_steps_is_mended(copy, whole):
    (copy / ".partial").mkdir()
    (copy / ".partial" / "000000.npz").write_bytes(b"")
    assert run(make(copy)).returncode == 0
    assert contents(copy) == contents(whole)


def test_a_full_disk_gives_one_sentence_and_keeps_what_is_done(tmp_path, monkeypatch, design):
    """A limit on the size of files stands in for the disk: images fit, records do not."""
    folder = tmp_path / "full"
    limited = ["prlimit", "--fsize=4096", *make(folder, workers=1)]
    result = run(limited)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert "cannot write" in result.stderr
    assert "goes on from there" in result.stderr
    assert run(make(folder)).returncode == 0
    assert tactip.main(["dataset", "verify", str(folder)]) == 0
