"""Architecture: folders import along the data flow, each file has one concept, and imports have no side effects."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOW = ["assets", "tactip_model", "sim", "learning", "control", "sim2real", "commands", "benchmarks"]
BESIDE = {"control": {"sim2real"}, "sim2real": {"control"}}
"""Folders that do not import each other."""
FILES = sorted(p for folder in FLOW[:6] for p in (ROOT / folder).rglob("*.py"))
ON_TOP = sorted(p for folder in FLOW[6:] for p in (ROOT / folder).rglob("*.py"))
OTHERS = sorted(p for folder in ("examples", "scripts", "tests") for p in (ROOT / folder).rglob("*.py"))


@cache
def parsed(path):
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text())


@cache
def imported(path):
    """Return the modules (dotted names) that a file imports, early or late."""
    return frozenset(_imported(path))


def _imported(path):
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", [*FILES, *ON_TOP], ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_with_the_flow(path):
    folder = path.relative_to(ROOT).parts[0]
    above = {*FLOW[FLOW.index(folder) + 1 :], *BESIDE.get(folder, ())}
    # Benchmarks are not in the wheel: only the command that runs them knows of them.
    above -= {"benchmarks"} if path == ROOT / "commands" / "bench.py" else set()
    taken = {name.split(".")[1] for name in imported(path) if name.startswith("tactip_twin.")}
    assert not above & taken


@pytest.mark.parametrize("path", [*FILES, *ON_TOP, *OTHERS], ids=lambda p: str(p.relative_to(ROOT)))
def test_our_folders_are_imported_as_tactip_twin(path):
    """Their bare names belong to other packages (control is python-control's), and would load second copies here."""
    assert not {name.split(".")[0] for name in imported(path)} & {*FLOW, "tests"}
    assert not re.search(r"""["'](sim|learning|control|sim2real|tactip_model|commands)\.[a-z_]+\.""", path.read_text())


@cache
def names_of(path):
    """Return the names that a module defines, or that another imports from it."""
    names = set()
    for node in parsed(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    return names


@pytest.mark.parametrize("path", [*FILES, *ON_TOP], ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_exist(path):
    """Also where it is imported late, by a command that no test may run."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("tactip_twin."):
            folder = ROOT / node.module.removeprefix("tactip_twin.").replace(".", "/")
            file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
            there = names_of(file) | {p.stem for p in folder.glob("*") if p.suffix == ".py" or p.is_dir()}
            assert {alias.name for alias in node.names} <= there, node.module


def test_files_are_found():
    assert len(FILES) > 15


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_public_things_say_what_they_are(path):
    tree = parsed(path)
    assert ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), node.name


def fields_without_a_line(tree):
    """Return the fields ("Class.field") of public dataclasses without a docstring, and the number of all fields."""
    bare, count = set(), 0
    for node in (n for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and not n.name.startswith("_")):
        if not any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
            continue
        for field, after in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign):
                lines = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                count += 1
                if not (lines and isinstance(after.value.value, str) and after.value.value.strip()):
                    bare.add(f"{node.name}.{field.target.id}")
    return bare, count


@pytest.mark.parametrize("path", [*FILES, *ON_TOP], ids=lambda p: str(p.relative_to(ROOT)))
def test_every_field_of_a_public_dataclass_has_its_line(path):
    assert fields_without_a_line(parsed(path))[0] == set()


def test_fields_are_found():
    assert sum(fields_without_a_line(parsed(path))[1] for path in [*FILES, *ON_TOP]) > 300
    text = '@dataclass(frozen=True)\nclass A:\n    a: int\n    """Told."""\n    b: int = 0\n    c: int = 0\n    """   """\n'
    assert fields_without_a_line(ast.parse(text)) == ({"A.b", "A.c"}, 3)
    assert fields_without_a_line(ast.parse(text.replace("class A", "class _A"))) == (set(), 0)


def test_no_pickle_or_eval():
    assert len(ON_TOP) > 20
    for path in [*FILES, *ON_TOP]:
        text = path.read_text()
        words = ("import pickle", "allow_pickle=True", "weights_only=False", "shell=True")
        assert not any(word in text for word in words), path
        assert not re.search(r"(?<![\w.])eval\(", text), path  # a network's eval() method is something else
