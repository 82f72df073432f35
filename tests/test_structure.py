"""The house: folders import along the flow, each file is one thing, and no setting is made at import."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOW = ["assets", "tactip_model", "sim", "learning", "control"]
FILES = sorted(p for folder in FLOW for p in (ROOT / folder).rglob("*.py"))


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_with_the_flow(path):
    here = FLOW.index(path.relative_to(ROOT).parts[0])
    above = {"tactip", "commands", "benchmarks", "tests", *FLOW[here + 1 :]}
    assert not above & set(imported(path))


def test_there_are_files_to_look_at():
    assert len(FILES) > 15


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_public_things_say_what_they_are(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), node.name


def test_nothing_is_unpickled_or_evaluated():
    on_top = [p for folder in ("commands", "benchmarks") for p in (ROOT / folder).rglob("*.py")]
    assert len(on_top) > 20
    for path in [*FILES, *on_top, ROOT / "tactip.py"]:
        text = path.read_text()
        words = ("import pickle", "allow_pickle=True", "weights_only=False", "shell=True")
        assert not any(word in text for word in words), path
        assert not re.search(r"(?<![\w.])eval\(", text), path  # a network's own eval() is another thing
