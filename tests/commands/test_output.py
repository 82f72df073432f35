"""Output that cannot be written: a closed pipe, a full disk, a terminal that lacks characters."""

import ctypes
import os
import subprocess
import sys

import pytest

from helpers.learning_sets import write_fake_set
from tactip_twin.commands import main

TACTIP = [sys.executable, "-m", "tactip_twin.commands.main"]


def run(*arguments, **options):
    return subprocess.run([*TACTIP, *arguments], capture_output=True, check=False, **options)


def test_reader_that_has_ended_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([*TACTIP, "--help"], stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert b"Traceback" not in done.stderr
    assert b"Broken pipe" not in done.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")
def test_output_to_a_full_disk_is_said(tmp_path):
    write_fake_set(tmp_path / "set", samples=2)
    with open("/dev/full", "w") as full:
        done = subprocess.run([*TACTIP, "dataset", "show", tmp_path / "set", "--out", tmp_path / "a.png"], stdout=full,
                              stderr=subprocess.PIPE, check=False, text=True)  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == "tactip: the output or a file: No space left on device\n"


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_streams_that_the_caller_has_closed_are_no_files_of_the_command(tmp_path, closed):
    """A file that got the number of the error stream would receive the messages of libraries."""
    make = [
        "dataset",
        "make",
        "--samples",
        "1",
        "--fidelity",
        "fast",
        "--renderer",
        "raster",
        "--out",
        str(tmp_path / "set"),
    ]
    close = "import os, runpy; [os.close(n) for n in {}]; runpy.run_module('tactip_twin.commands.main', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", close.format(list(closed)), *make], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert b"Traceback" not in done.stderr
    assert main.main(["dataset", "verify", str(tmp_path / "set")]) == 0


@pytest.mark.parametrize("encoding", ["ascii", "utf-8:strict"])
def test_folder_whose_name_is_no_text(tmp_path, encoding):
    folder = os.fsencode(tmp_path) + b"/w\xff\xc3\xa4"
    os.mkdir(folder)
    set_folder = write_fake_set(tmp_path / "set", samples=2)
    os.rename(set_folder, folder + b"/set")
    done = run(
        "dataset", "show", folder + b"/set", "--out", folder + b"/a.png", env=os.environ | {"PYTHONIOENCODING": encoding}
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(os.fsencode(tmp_path) + b"/w\\udcff")


def test_main_interrupted_while_ctypes_converts_says_that_it_is_stopped(monkeypatch, capsys):
    """As OpenGL loads: the interrupt is left as text in another error."""

    class Argument:
        @classmethod
        def from_param(cls, error):
            raise error

    function = ctypes.CDLL(None).abs
    function.argtypes = [Argument]
    monkeypatch.setattr(main, "_command", lambda arguments: function(KeyboardInterrupt()))
    assert main.main(["servo"]) == 130
    assert capsys.readouterr().err == "tactip: stopped\n"
    monkeypatch.setattr(main, "_command", lambda arguments: function(ValueError("no number")))
    with pytest.raises(ctypes.ArgumentError, match="no number"):
        main.main(["servo"])
