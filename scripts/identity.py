"""Record what a version of the code computes, and compare two records: for changes that must not alter results.

    python scripts/identity.py record before --tactip "OLD/.venv/bin/tactip"
    python scripts/identity.py record after
    python scripts/identity.py compare before after

Images must be identical, pins must agree to 1e-9 m, recordings, errors of networks and resumed bytes must be the same.
"""

import hashlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

_PINS_M = 1e-9
"""Largest difference of pins, m."""

FIDELITIES = ("draft", "standard", "reference")
SURFACES, EDGES = ("bust", "saddle", "sphere", "plate"), ("edge", "rim-round", "rim-square", "rim-uneven")
NETWORKS = {
    "surface-tactip-127": "surface-standard",
    "surface-curved-tactip-127": "surface-variants",
    "edge-tactip-127": "edge-standard",
}
"""Each shipped network and the set of this record that it is evaluated on."""

VARIANTS = {
    "surface-variants": ("--task", "surface", "--curvature-per-m", "-20", "60", "--varying-curvature-fraction", "0.5",
                         "--snapshots-per-contact", "3", "--randomize-mechanics", "real"),
    "edge-variants": ("--task", "edge", "--augment-symmetry", "--renderer", "raster"),
}  # fmt: skip
"""Sets of other kinds: options of `tactip dataset make`."""

_RENAMED = {"tips": "pin_tips", "tips_m": "pin_tips_m", "T_told": "T_base_tcp_measured", "felt": "predicted"}
"""Names of arrays in 0.3.0, and their names since."""

_NOT_COMPARED = ("seconds", "latency_ms", "ms_a_step", "images_per_s", "samples_per_s", "steps_per_s")
"""Parts of names of figures that are times."""


def record(out: Path, tactip: list[str]) -> None:
    """Run every case with the command `tactip` (words) and write what came out, with its time, into the folder `out`."""
    out.mkdir(parents=True)
    seconds = {}

    def run(name: str, *words: str) -> str:
        start = time.perf_counter()
        ended = subprocess.run([*tactip, *words], check=False, capture_output=True, text=True)
        seconds[name] = time.perf_counter() - start
        if ended.returncode:
            sys.exit(f"{name} failed ({shlex.join(words)}): {ended.stderr[-2000:]}")
        print(f"{name}: {seconds[name]:.1f} s", flush=True)
        return ended.stdout

    for task in ("surface", "edge"):
        for fidelity in FIDELITIES:
            name = f"{task}-{fidelity}"
            run(name, "dataset", "make", "--task", task, "--fidelity", fidelity, "--samples", "20", "--out", str(out / name))
    for name, words in VARIANTS.items():
        run(name, "dataset", "make", *words, "--fidelity", "draft", "--samples", "20", "--out", str(out / name))
    _resume(out, tactip)
    for network, folder in NETWORKS.items():
        printed = run(f"evaluate-{network}", "evaluate", "--model", network, "--data", str(out / folder), "--json")
        (out / f"evaluation-{network}.json").write_text(printed)
    sets = out / "sets"
    for split in ("train", "val"):
        shutil.copytree(out / ("surface-standard" if split == "train" else "surface-draft"), sets / split)
    run("train", "train", "--data", str(sets), "--out", str(out / "training"), "--network.filters", "4",
        "--training.epochs", "3", "--training.min-steps", "0", "--device", "cpu")  # fmt: skip
    for task, objects in (("surface", SURFACES), ("edge", EDGES)):
        for name in objects:
            route = (
                ("--route.kind", "straight", "--route.length-mm", "20")
                if task == "surface"
                else ("--route.max-length-mm", "20")
            )
            run(f"servo-{name}", "servo", "--task", task, "--object", name, *route, "--out", str(out / f"servo-{name}"))
    (out / "seconds.json").write_text(json.dumps(seconds, indent=1) + "\n")


def _resume(out: Path, tactip: list[str]) -> None:
    """Make a set that is killed twice on the way: its bytes must be those of surface-draft."""
    words = ("dataset", "make", "--task", "surface", "--fidelity", "draft", "--samples", "20", "--out", str(out / "resumed"))
    for images in (4, 10):
        with subprocess.Popen([*tactip, *words], start_new_session=True, stderr=subprocess.DEVNULL) as process:
            while len(list((out / "resumed").glob("images/*.png"))) < images and process.poll() is None:
                time.sleep(0.02)
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    subprocess.run([*tactip, *words], check=True, capture_output=True)
    for name in ("targets.csv", "pins.npz"):
        if _digest(out / "resumed" / name) != _digest(out / "surface-draft" / name):
            sys.exit(f"the resumed set has another {name}")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def compare(before: Path, after: Path) -> list[str]:
    """Differences (sentences) of two records that must not be."""
    wrong: list[str] = []
    count = 0
    for path in sorted(p for p in before.rglob("*") if p.is_file()):
        name, other = path.relative_to(before), after / path.relative_to(before)
        if path.name in ("seconds.json", "run.json", "metrics.jsonl", "meta.json", "figure.png") or path.name[0] == ".":
            continue
        if not other.exists():
            wrong.append(f"{name} is missing")
        elif path.suffix == ".npz":
            wrong += [f"{name}: {text}" for text in _arrays(path, other)]
        elif path.suffix == ".json":
            wrong += [
                f"{name}: {text}" for text in _numbers(json.loads(path.read_text()), json.loads(other.read_text()), "")
            ]
        elif path.suffix in (".png", ".csv", ".pt") and _digest(path) != _digest(other):
            wrong.append(f"{name} has other bytes")
        count += 1
    print(f"{count} files compared, {len(wrong)} differences")
    old, new = (json.loads((folder / "seconds.json").read_text()) for folder in (before, after))
    for name in old:
        print(f"{name}: {new[name]:.1f} s, {new[name] / old[name]:.2f} of before")
    return wrong


def _arrays(path: Path, other: Path) -> list[str]:
    wrong = []
    with np.load(path) as old, np.load(other) as new:
        for key in old.files:
            if key in ("digest", "seconds"):
                continue
            name = key if key in new.files else _RENAMED.get(key, key)
            if name not in new.files or old[key].shape != new[name].shape:
                wrong.append(f"{key} is missing or of another shape")
            elif old[key].dtype.kind == "f" and not np.allclose(old[key], new[name], rtol=0, atol=_PINS_M, equal_nan=True):
                wrong.append(f"{key} differs by up to {np.nanmax(np.abs(old[key] - new[name])):g}")
            elif old[key].dtype.kind != "f" and not np.array_equal(old[key], new[name]):
                wrong.append(f"{key} differs")
    return wrong


def _numbers(old: object, new: object, name: str) -> list[str]:
    """Numbers that differ in two JSON values, by the path of keys to them."""
    if any(part in name for part in _NOT_COMPARED):
        return []
    if isinstance(old, dict) and isinstance(new, dict):
        return [text for key in old if key in new for text in _numbers(old[key], new[key], f"{name}.{key}")]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [text for k, pair in enumerate(zip(old, new, strict=True)) for text in _numbers(*pair, f"{name}[{k}]")]
    if isinstance(old, int | float) and isinstance(new, int | float) and abs(old - new) > 1e-9 * max(1.0, abs(old)):
        return [f"{name} is {new}, was {old}"]
    return []


def main() -> None:
    """See the module."""
    words = sys.argv[1:]
    if words[:1] == ["record"] and len(words) in (2, 4):
        record(Path(words[1]), shlex.split(words[3]) if len(words) == 4 else [str(Path(sys.executable).with_name("tactip"))])
    elif words[:1] == ["compare"] and len(words) == 3:
        wrong = compare(Path(words[1]), Path(words[2]))
        print("\n".join(wrong))
        sys.exit(bool(wrong))
    else:
        sys.exit(f"{__doc__}")


if __name__ == "__main__":
    main()
