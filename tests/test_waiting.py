"""What takes long says what it does, and what fails at once says one thing."""

import time

import tactip
from commands.waiting import _PATIENCE_S, Waiting


def test_a_long_wait_is_told_once_and_a_short_one_is_not(capsys):
    with Waiting("reading"):
        time.sleep(1.5 * _PATIENCE_S)
    assert capsys.readouterr().err == "reading …\n"
    with Waiting("reading"):
        pass
    with Waiting("reading") as waiting:
        waiting.over()
        time.sleep(1.5 * _PATIENCE_S)
    assert capsys.readouterr().err == ""


def test_an_error_is_one_line(tmp_path, capsys):
    """Once libraries are loaded, as they are here."""
    for command in (["train", "--data"], ["evaluate", "--model", "surface-tactip-127", "--data"]):
        capsys.readouterr()
        tactip.main([*command, str(tmp_path / "none"), *(["--out", str(tmp_path / "out")] if "train" in command else [])])
        assert len(capsys.readouterr().err.splitlines()) == 1
