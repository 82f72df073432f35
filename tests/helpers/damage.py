"""Random damage to files: bytes, JSON values, cells of tables, and special files instead of files."""

import json
import os

ODD_VALUES = (
    None,
    True,
    False,
    0,
    -1,
    1.5,
    1e308,
    2**70,
    "",
    "x",
    "\0",
    "../x",
    "/dev/zero",
    [],
    [None],
    [[1]],
    {},
    {"a": 1},
)

ODD_CELLS = ("", "nan", "inf", "-1e308", "x", "9" * 400, "\0", '"', "../x", "/dev/zero", "1,1", "\n")


def damage_bytes(data, rng):
    """Return bytes with one random damage."""
    at = int(rng.integers(max(1, len(data))))
    kind = rng.integers(6)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return b""
    if kind == 2:
        return data + rng.bytes(20)
    if kind == 3:
        return data[:at] + rng.bytes(8) + data[at + 8 :]
    if kind == 4:
        return data[:at] + data[at + int(rng.integers(1, 40)) :]
    return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :] if data else b"x"


def damage_json(data, rng):
    """Return JSON in which one random value is replaced or removed, or that is nested deeply."""
    value = json.loads(data)
    if rng.random() < 0.05:
        return b"[" * 100_000
    place, key = value, None
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = keys[int(rng.integers(len(keys)))]
        if not isinstance(place[key], dict | list) or not place[key] or rng.random() < 0.3:
            break
        place = place[key]
    if rng.random() < 0.2:
        del place[key]
    else:
        place[key] = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    return json.dumps(value).encode()


def damage_lines(data, rng):
    """Return lines of JSON of which one is damaged, removed or repeated."""
    lines = data.splitlines(keepends=True)
    at = int(rng.integers(len(lines)))
    kind = rng.random()
    lines[at] = b"" if kind < 0.1 else 2 * lines[at] if kind < 0.2 else damage_json(lines[at], rng) + b"\n"
    return b"".join(lines)


def damage_table(data, rng):
    """Return a table of which one cell is replaced, or one row removed or repeated."""
    rows = [line.split(b",") for line in data.splitlines()]
    at = int(rng.integers(len(rows)))
    kind = rng.random()
    if kind < 0.1:
        del rows[at]
    elif kind < 0.2:
        rows.insert(at, rows[at])
    elif kind < 0.3:
        del rows[at][int(rng.integers(len(rows[at])))]
    else:
        rows[at][int(rng.integers(len(rows[at])))] = ODD_CELLS[int(rng.integers(len(ODD_CELLS)))].encode()
    return b"\n".join(b",".join(row) for row in rows) + b"\n"


BY_ENDING = {".json": damage_json, ".jsonl": damage_lines, ".csv": damage_table}


def damage(path, rng):
    """Damage a file, or put a folder, a pipe, a device or nothing in its place."""
    if rng.random() < 0.05:
        path.unlink()
        kind = rng.integers(4)
        if kind == 0:
            path.mkdir()
        elif kind == 1:
            os.mkfifo(path)
        elif kind == 2:
            path.symlink_to("/dev/zero")
        return
    by_ending = BY_ENDING.get(path.suffix) if rng.random() < 0.6 else None
    path.write_bytes((by_ending or damage_bytes)(path.read_bytes(), rng))
