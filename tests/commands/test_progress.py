"""Slow steps print what they do; a command that fails at once prints its error only."""

import time
from importlib.metadata import version

import pytest

from tactip_twin.commands import _progress
from tactip_twin.commands import main as tactip
from tactip_twin.commands._progress import DelayedStatus


def test_only_long_waits_are_reported(capsys, monkeypatch):
    assert 0.5 <= _progress._PATIENCE_S <= 2
    monkeypatch.setattr(_progress, "_PATIENCE_S", 0.2)
    with DelayedStatus("reading"):
        time.sleep(0.5)
    assert capsys.readouterr().err == "reading …\n"
    with DelayedStatus("reading"):
        pass
    with DelayedStatus("reading") as waiting:
        waiting.cancel()
        time.sleep(0.5)
    assert capsys.readouterr().err == ""


def test_version_is_printed(capsys):
    assert tactip.main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == version("tactip-twin")


@pytest.mark.parametrize("late", [False, True])
def test_interruption_before_start_prints_one_line(capsys, monkeypatch, late):
    """Also during the import of a compiled library, which then reports a failure to load."""

    def stopped(_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            if late:
                raise ImportError("initialization failed") from error
            raise

    monkeypatch.setattr(tactip, "_command", stopped)
    assert tactip.main([]) == 130
    assert capsys.readouterr().err == "tactip: stopped\n"


def test_missing_library_is_not_an_interruption(monkeypatch):
    def lacking(_):
        raise ImportError("no such library")

    monkeypatch.setattr(tactip, "_command", lacking)
    with pytest.raises(ImportError, match="no such library"):
        tactip.main([])


def test_error_is_one_line(tmp_path, capsys):
    """With the libraries loaded already, as in a second call."""
    for command in (["train", "--data"], ["evaluate", "--model", "surface-tactip-127", "--data"]):
        options = [*command, str(tmp_path / "none"), *(["--out", str(tmp_path / "out")] if "train" in command else [])]
        for _ in range(2):
            capsys.readouterr()
            assert tactip.main(options) == 1
        assert len(capsys.readouterr().err.splitlines()) == 1
