"""Sets after a kill, a full disk or a lost worker can be resumed and extended to the same bytes."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from helpers.set_commands import contents, kill_unfinished, make, process, records, run, samples_found, wait_for
from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset.partial_record import unpack_finished_set
from tactip_twin.sim.parallel.file_lock import locked


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_make_killed_run_is_resumed_to_the_same_bytes(whole, tmp_path, workers):
    folder = tmp_path / "killed"
    kill_unfinished(make(folder, workers=workers), folder, lambda: len(records(folder)) >= 1)
    verified = run(["dataset", "verify", str(folder)])
    assert verified.returncode == 1
    assert "unfinished" in verified.stderr
    kept = len(records(folder))
    (folder / "images" / ".image_00000.png.1.tmp").write_bytes(b"half a fi")  # a kill during a write leaves this
    # Workers of the killed run end by themselves, at the latest after their current sample.
    resumed = run(make(folder, workers=2))
    assert resumed.returncode == 0
    assert samples_found(resumed.stderr + resumed.stdout) in (kept, kept + 1, kept + 2)
    assert contents(folder) == contents(whole)


def test_make_finished_set_grows_to_the_same_bytes(whole, tmp_path):
    folder = tmp_path / "small"
    assert run(make(folder, samples=2)).returncode == 0
    (folder / ".partial").mkdir()  # as after a kill between the last two steps
    (folder / ".partial" / "configuration.json").write_text("{}")
    grown = run(make(folder))
    assert grown.returncode == 0, grown.stderr
    assert "2 of 4 samples already exist" in grown.stderr
    assert contents(folder) == contents(whole)


def test_make_killed_growth_is_resumed(whole, tmp_path, monkeypatch):
    folder = tmp_path / "small"
    assert run(make(folder, samples=2)).returncode == 0
    before = contents(folder)

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("tactip_twin.sim.dataset.partial_record.record_path", killed)
        assert run(make(folder)).returncode != 0
    assert before.items() <= contents(folder).items()
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


def test_make_set_locked_by_another_command_is_left_unchanged(copy, capsys):
    """While another command prepares its growth, meta.json still says it is finished: its .partial is not a leftover."""
    (copy / ".partial").mkdir()
    before = contents(copy)
    command = make(copy)
    with locked(copy / ".partial" / "lock", f"making the set in {copy}"):
        assert tactip.main(command) == 1
        assert "another command is making the set" in capsys.readouterr().err
        assert (copy / ".partial" / "lock").exists()
    assert tactip.main(command) == 0
    assert not (copy / ".partial").exists()
    assert contents(copy) == before


@pytest.mark.parametrize(("damaged", "words"), [("pins.npz", "damaged"), ("targets.csv", "targets.csv")])
def test_make_damaged_set_does_not_grow(copy, capsys, damaged, words):
    (copy / damaged).write_bytes(b"")
    before = contents(copy)
    assert tactip.main(make(copy, samples=8)) == 1
    assert words in capsys.readouterr().err
    assert {n: b for n, b in contents(copy).items() if ".partial" not in n} == before


def test_make_lost_image_is_made_again(copy, whole):
    (copy / ".partial").mkdir()
    unpack_finished_set(copy)
    assert len(records(copy)) == 4 and not (copy / "meta.json").exists()  # as after a kill that follows the last contact
    (copy / "images" / "image_00000.png").unlink()
    assert run(make(copy)).returncode == 0
    assert contents(copy) == contents(whole)


def test_make_complete_set_makes_nothing(copy, whole):
    again = run(make(copy))
    assert again.returncode == 0
    assert "complete already" in again.stdout
    assert contents(copy) == contents(whole)


@pytest.mark.parametrize(
    ("after", "number", "workers"),
    [
        pytest.param(0, signal.SIGINT, 2, marks=pytest.mark.slow),
        (1, signal.SIGINT, 1),
        pytest.param(3, signal.SIGINT, 2, marks=pytest.mark.slow),
        pytest.param(3, signal.SIGTERM, 2, marks=pytest.mark.slow),
    ],
)
def test_make_interrupted_keeps_finished_samples(tmp_path, after, number, workers):
    """Ctrl-C while the workers start and while they work, and the SIGTERM of a scheduler."""
    folder = tmp_path / "stopped"
    started = subprocess.Popen(
        process(make(folder, samples=60, workers=workers)),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Where the tests run in the background of a shell, Ctrl-C is ignored, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    wait_for(lambda: (folder / ".partial" / "configuration.json").exists() and len(records(folder)) >= after)
    time.sleep(0.3)  # while the workers start
    os.killpg(started.pid, number)  # as a terminal does: to parent and workers alike
    _, output = started.communicate(timeout=60)
    assert started.returncode == 128 + number
    assert "the same command resumes it" in output
    assert "Traceback" not in output
    assert after <= len(records(folder)) < 60


def test_make_dead_worker_is_replaced(whole, tmp_path):
    folder = tmp_path / "replaced"
    command = process(make(folder))
    started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wait_for(lambda: len(records(folder)) >= 1)
    children = Path(f"/proc/{started.pid}/task/{started.pid}/children").read_text().split()
    workers = [c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
    os.kill(int(workers[0]), signal.SIGKILL)
    output, _ = started.communicate(timeout=120)
    assert started.returncode == 0, output
    assert "another worker takes over" in output
    assert contents(folder) == contents(whole)


def test_make_second_command_on_one_set_is_refused(tmp_path):
    folder = tmp_path / "contested"
    command = process(make(folder, samples=60))
    first = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_for((folder / ".partial" / "configuration.json").exists)
        second = run(make(folder, samples=60))
        assert second.returncode == 1
        assert "another command is making" in second.stderr
    finally:
        first.kill()
        first.wait()


@pytest.mark.parametrize("leftover", [".partial", ".partial/lock", ".targets.csv.7.tmp"])
def test_make_kill_during_first_or_last_write_is_resumed(whole, tmp_path, leftover):
    """Only the folders exist, or also the lock, or half of a table."""
    folder = tmp_path / "started"
    (folder / ".partial").mkdir(parents=True)
    if leftover != ".partial":
        (folder / leftover).write_text("")
    assert run(make(folder)).returncode == 0
    assert contents(folder) == contents(whole)


def test_make_kill_between_the_last_two_steps_is_resumed(copy, whole):
    (copy / ".partial").mkdir()
    (copy / ".partial" / "000000.npz").write_bytes(b"")
    assert run(make(copy)).returncode == 0
    assert contents(copy) == contents(whole)


def test_make_full_disk_gives_one_sentence_and_keeps_finished_samples(tmp_path):
    """Simulated by a limit on the size of files: images fit, records do not."""
    folder = tmp_path / "full"
    limited = ["prlimit", "--fsize=4096", *process(make(folder, samples=2))]
    result = subprocess.run(limited, capture_output=True, text=True, timeout=300)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert "cannot write" in result.stderr
    assert "the same command resumes it" in result.stderr
    assert run(make(folder, samples=2)).returncode == 0
    assert tactip.main(["dataset", "verify", str(folder)]) == 0
