"""The wheel is complete: it works in a clean environment, on every installed Python."""

import json
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
VERSIONS = ("3.11", "3.12", "3.13")
TORCH = next(line for line in (ROOT / "requirements.lock").read_text().splitlines() if line.startswith("torch=="))


def interpreter(version):
    """Path of a Python of a version ("3.12"), or None if there is none that runs."""
    found = shutil.which(f"python{version}")
    output = found and subprocess.run([found, "--version"], capture_output=True, text=True)
    if output and output.returncode == 0 and output.stdout.startswith(f"Python {version}."):
        return found
    # pyenv installs them beside the running one.
    beside = sorted(Path(sys.base_prefix).parent.glob(f"{version}.*/bin/python"))
    return str(beside[0]) if beside else None


def test_wheel_versions_match_the_package():
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    assert asked == f">={VERSIONS[0]},<3.{int(VERSIONS[-1].split('.')[1]) + 1}"


def isolation():
    """Return pip's option to build with the setuptools that is installed here, if it is new enough.

    Otherwise pip downloads one, which takes longer than to build.
    """
    (asked,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    try:
        installed = installed_version("setuptools")
    except PackageNotFoundError:
        return []
    new_enough = int(installed.split(".")[0]) >= int(asked.removeprefix("setuptools>="))
    return ["--no-build-isolation"] if new_enough else []


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    source = out / "source"
    subprocess.run([shutil.which("git"), "clone", "--quiet", str(ROOT), str(source)], check=True)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", *isolation()]
    subprocess.run([*pip, str(source), "--wheel-dir", str(out)], check=True)
    return next(out.glob("*.whl"))


def test_wheel_holds_nothing_outside_tactip_twin(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    folders = {name.split("/")[0] for name in names}
    assert {f for f in folders if not f.endswith(".dist-info")} == {"tactip_twin"}
    inside = {name.split("/")[1] for name in names if name.startswith("tactip_twin/")}
    assert {"__init__.py", "py.typed", "assets", "tactip_model", "sim", "learning", "control", "sim2real"} <= inside
    assert "benchmarks" not in inside
    assert "tactip_twin/sim/view/replay.html" in names


@pytest.mark.slow
def test_wheel_works_beside_python_control(wheel, tmp_path):
    """python-control's import name is `control`: neither package may write over the other's files."""
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target"]
    for number, package in enumerate(("control==0.10.2", str(wheel))):
        subprocess.run([*pip, str(tmp_path / str(number)), package], check=True)
    first, second = ({p.relative_to(root) for p in root.rglob("*.py")} for root in (tmp_path / "0", tmp_path / "1"))
    assert first and second and not first & second
    for root in (tmp_path / "0", tmp_path / "1"):
        shutil.copytree(root, site, dirs_exist_ok=True)
    code = (
        "import control, tactip_twin as tt, tactip_twin.control.servo as servo;"
        "assert control.__file__.startswith(site) and servo.__file__.startswith(site);"
        "assert abs(control.dcgain(control.tf([2], [1, 1])) - 2) < 1e-9;"
        "print(tt.TacTip(fidelity='draft', renderer='raster').press(depth_mm=2).image.shape)"
    )
    words = [sys.executable, "-c", f"import sys; site = {str(site)!r}; sys.path.insert(0, site); {code}"]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert ended.stdout.strip() == "(128, 128)", ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_wheel_works_without_checkout(wheel, tmp_path, version):
    python = interpreter(version)
    if python is None:
        pytest.skip(f"no Python {version} here")
    subprocess.run([python, "-m", "venv", str(tmp_path / "env")], check=True)
    bin_ = tmp_path / "env" / "bin"
    subprocess.run([bin_ / "pip", "install", "--quiet", TORCH, str(wheel)], check=True)

    def run(*words):
        ended = subprocess.run([bin_ / "tactip", *words], cwd=tmp_path, capture_output=True, text=True)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    subprocess.run(
        [bin_ / "python", "-W", "error", "-c", "import hyperopt, tactip_twin as tt; [getattr(tt, n) for n in tt.__all__]"],
        cwd=tmp_path,
        check=True,
    )
    bench = subprocess.run([bin_ / "tactip", "bench", "fidelity"], cwd=tmp_path, capture_output=True, text=True)
    assert bench.returncode == 1 and len(bench.stderr.splitlines()) == 1 and "clone the repository" in bench.stderr
    run("dataset", "make", "--samples", "4", "--fidelity", "draft", "--out", "set")
    assert "complete; 4 samples" in run("dataset", "verify", "set")
    assert json.loads(run("evaluate", "--model", "surface-tactip-127", "--data", "set", "--json"))["mae"]["pose_z"] < 0.5
    run("servo", "--task", "surface", "--object", "sphere", "--fidelity", "draft", "--route.kind", "straight",
        "--route.length-mm", "6", "--out", "run")  # fmt: skip
    assert json.loads((tmp_path / "run" / "score.json").read_text())["contact_losses"] == 0
