"""Small data sets for tests of learning: images that show their labels, made without physics."""

import json

import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration, digest_of
from tactip_twin.sim.dataset.format import checksum, encode_image, image_name, meta_json, row_of, targets_csv
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, generator, seed_text
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named


class _Contact:
    """The part of a contact's record that a row of targets.csv needs."""

    tangential_force_n = penetration_m = speed_m_s = contact_area_m2 = 0.0
    slip_fraction, volume_ratio, warnings, steps = 0.5, 1.0, 0, 1

    def __init__(self, pose, shear):
        self.pose, self.shear, self.effective_shear = pose, shear, 0.5 * shear
        self.normal_force_n = max(-1e3 * float(pose[2]) - 2, 0.0)  # 1 N per mm beyond 2 mm
        self.force_n = np.array([0, 0, -self.normal_force_n])


def picture(pose_mm_deg, size):
    """Return three dots whose positions encode x, depth, roll, pitch and yaw, (size, size) uint8."""
    x, _, z, roll, pitch, yaw = pose_mm_deg
    centres = np.array(
        [[0.25 + 0.05 * x, 0.25 - 0.08 * z], [0.6 + 0.015 * roll, 0.3 + 0.01 * pitch], [0.5 + 0.008 * yaw, 0.75]]
    )
    v, u = np.mgrid[:size, :size] / size
    near = [np.hypot(u - a, v - b) < 0.09 for a, b in centres]
    return (255 * np.any(near, axis=0)).astype(np.uint8)


def write_fake_set(folder, task="surface", split="train", samples=24, size=40, seed=0, **changes):
    """Write a finished set; return its folder. changes: fields of its Configuration."""
    settings = {"renderer": "raster", "design": design_named("nominal-127"), "fidelity": fidelity_named("draft")}
    settings |= {"pose": POSE_RANGES[task], "shear": SHEAR_RANGES} | changes
    configuration = Configuration(task=task, split=split, samples=samples, seed=seed, **settings)
    (folder / "images").mkdir(parents=True)
    rows, images = [], {}
    for i in range(samples):
        rng = generator(seed, task, split, i)
        contact = _Contact(configuration.pose.sample(rng), configuration.shear.sample(rng))
        rows.append(row_of(contact, i, 1, seed_text(seed, task, split, i)))
        data = encode_image(picture([rows[-1][f"pose_{c}"] for c in ("x", "y", "z", "Rx", "Ry", "Rz")], size))
        (folder / "images" / image_name(i)).write_bytes(data)
        images[image_name(i)] = checksum(data)
        assert np.allclose(from_mm_deg([rows[-1]["pose_z"]] * 6)[0], contact.pose[2])
    (folder / "targets.csv").write_bytes(targets_csv(rows))
    counts = {"asked": samples, "kept": samples, "failed": 0}
    more = {"failures": [], "images": images}
    (folder / "meta.json").write_bytes(meta_json(configuration, counts, {"targets.csv": ""}, more))
    mend_checksums(folder)
    return folder


def add_pins(folder, tips, directions):
    """Add pins.npz to a set of nominal-127: tips and directions (n, 127, 3)."""
    neutral = dict(zip(("neutral_tips", "neutral_directions"), neutral_pins(design_named("nominal-127")), strict=True))
    meta = json.loads((folder / "meta.json").read_text())
    arrays = {
        name: np.asarray(array, np.float32)
        for name, array in {"pin_tips": tips, "directions": directions, **neutral}.items()
    }
    np.savez(folder / "pins.npz", **arrays, digest=np.array(meta["digest"]))
    (folder / "meta.json").write_text(json.dumps(meta | {"files": meta["files"] | {"pins.npz": ""}}))
    mend_checksums(folder)


def mend_checksums(folder):
    """Make meta.json of a changed set match its files and its configuration."""
    meta = json.loads((folder / "meta.json").read_text())
    for names, place in ((meta["files"], folder), (meta.get("images", {}), folder / "images")):
        names.update({name: checksum((place / name).read_bytes()) for name in names if (place / name).exists()})
    meta["digest"] = digest_of(meta["configuration"])
    (folder / "meta.json").write_text(json.dumps(meta))


def write_fake_shards(folder, shards=3, samples=4, **changes):
    """Write a set of shards with `samples` each; return its folder."""
    sums, configuration = {}, {}
    for k in range(shards):
        name = f"shard-{k:05d}"
        write_fake_set(folder / name, samples=samples, seed=k, **changes)
        data = (folder / name / "meta.json").read_bytes()
        configuration, sums[f"{name}/meta.json"] = json.loads(data), checksum(data)
    counts = {"asked": shards * samples, "kept": shards * samples, "failed": 0}
    more = {"samples": counts, "shards": [key.split("/")[0] for key in sums], "files": sums}
    meta = {key: value for key, value in configuration.items() if key not in ("images", "failures")}
    (folder / "meta.json").write_text(json.dumps(meta | more))
    return folder


def write_fake_splits(folder, task="surface", samples=24, **changes):
    """Write the sets train, val and test; return the folder."""
    for split in ("train", "val", "test"):
        write_fake_set(folder / split, task, split, samples, **changes)
    return folder
