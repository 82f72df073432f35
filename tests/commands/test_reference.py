"""The command reference agrees with the commands."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    path = tmp_path_factory.mktemp("reference") / "commands.md"
    subprocess.run([sys.executable, ROOT / "scripts" / "commands_page.py", path], check=True)
    return path.read_text()


def test_reference_agrees_with_commands(reference):
    assert reference == (ROOT / "docs" / "commands.md").read_text(), "run make reference"


def test_reference_holds_no_path_of_the_machine(reference):
    assert str(ROOT) not in reference


def sections(reference):
    """Options by command: a dict of a command's words (tuple of str) to its options (set of str)."""
    parts = re.split(r"^#+ tactip (.*)$", reference, flags=re.MULTILINE)[1:]
    return {
        tuple(name.split()): set(re.findall(r"--[a-z][\w.-]*", text)) for name, text in zip(*[iter(parts)] * 2, strict=True)
    }


def written(page):
    """Return the tactip commands in a page's code, each as a list of words; continued lines are joined."""
    text = page.read_text().replace("\\\n", " ")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = [line.split(" #")[0] for block in blocks for line in block.splitlines()]
    lines += re.findall(r"`(tactip [^`]*)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
    return [line.split() for line in lines if line.strip().startswith("tactip ")]


def test_help_flows():
    """Help is wrapped at the terminal's width, not where the source's lines end."""
    words = [sys.executable, "-m", "tactip_twin.commands.main", "servo", "--help"]
    output = subprocess.run(words, check=True, capture_output=True, text=True, env={**os.environ, "COLUMNS": "400"}).stdout
    lines = [line.strip("│ ") for line in output.splitlines() if line.startswith("│")]
    assert any(
        "the shipped network of the task; for surfaces, the one trained on curved surfaces." in line for line in lines
    )
    assert not [line for line in lines if line[:1].islower() and "show this help" not in line]


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.name)
def test_commands_in_the_pages_are_ones_that_there_are(reference, page):
    known = sections(reference)
    commands = written(page)
    assert commands or page.name != "README.md"
    for words in commands:
        plain = [w for w in words[1:3] if not w.startswith("-")]
        name = tuple(plain) if tuple(plain) in known else tuple(plain[:1])
        assert not plain or name in known or "|" in plain[0], " ".join(words)
        if name in known:
            given = {w.split("=")[0] for w in words if w.startswith("--")} - {"--help"}
            assert given <= known[name], f"{' '.join(words)}: {sorted(given - known[name])}"
