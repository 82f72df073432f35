"""Files that are damaged, or made to exhaust the machine, are refused in one sentence."""

import contextlib
import io
import json
import os
import struct
import zipfile
import zlib

import numpy as np
import pytest

from helpers.memory import MIB, Peak, memory_limit
from tactip_twin.tactip_model import input_files
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import (
    parse_arrays,
    parse_json,
    parse_table,
    read_arrays,
    read_file,
    read_json,
    read_json_lines,
)
from tactip_twin.tactip_model.input_images import decode_image, read_image


def npz(**arrays):
    data = io.BytesIO()
    np.savez(data, **arrays)
    return data.getvalue()


def png_of_size(width, height):
    """Return a PNG of one byte of pixels with a header that claims a size."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


@pytest.mark.parametrize("read", [read_file, read_json, read_arrays, read_image])
def test_special_files_are_refused_at_once(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero", "."):
        with pytest.raises(TactipError, match="must be a regular file"):
            read(tmp_path / name)
    with pytest.raises(TactipError, match="does not exist"):
        read(tmp_path / "nothing")


def test_large_files_are_refused_before_they_are_read(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(TactipError, match=r"must have at most 256 MiB, got 1048576 MiB"):
        read_file(tmp_path / "large")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "more than 32 levels"),
        ("[" * 40 + "]" * 40, "more than 32 levels"),
        ("NaN", "numbers must be finite"),
        ('{"a": [1e999]}', "numbers must be finite"),
        (str(2**64), "at most 63"),
        ("9" * 100_000, "is not JSON"),
        (b"\xff\xfe\xff", "is not JSON"),
        ("", "is not JSON"),
    ],
)
def test_json_beyond_its_limits_is_refused(text, message):
    with pytest.raises(TactipError, match=message):
        parse_json(text, "the file")


def test_json_within_limits_is_read():
    value = {"a": [1, -2.5, "x", None, True], "b": {"c": []}}
    assert parse_json(json.dumps(value), "the file") == value


@pytest.mark.parametrize(
    ("text", "cells"),
    [
        ("a,b\n1.5,x;y\n", {"a": "1.5", "b": "x;y"}),
        ("a;b;c\n-1,5;2;x,y\n", {"a": "-1.5", "b": "2", "c": "x,y"}),
        ("a\tb\r\n1,5e-3\t,25\r\n", {"a": "1.5e-3", "b": ".25"}),
        ("a\n7\n", {"a": "7"}),
    ],
)
def test_table_is_read_whatever_separates_its_values(text, cells):
    assert parse_table(text.encode("utf-8-sig"), "the file") == (list(cells), [cells])
    assert parse_table(text.encode("utf-16"), "the file") == (list(cells), [cells])
    assert parse_table(f"# of a rig\r\n# today\n{text}".encode(), "the file") == (list(cells), [cells])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"a,b\n1,2\n1,2,5\n", "the file must have at most 2 cells in a row, as many as columns, got 3 in line 3: separate"),
        (b"a;b\n1;2;3\n", "the file must have at most 2 cells in a row, as many as columns, got 3 in line 2$"),
        (b"a,b,a\n1,2,3\n", "the file must name each column once, got 'a' 2 times"),
        ("grad \u00b0\n1\n".encode("latin-1"), r"the file must be text in UTF-8 \(CSV\): invalid start byte at byte 5"),
    ],
)
def test_tables_whose_cells_could_shift_are_refused(data, words):
    with pytest.raises(TactipError, match=words):
        parse_table(data, "the file")
    assert parse_table(b"a,b,,\n1,2,,\n3,4,,,\n", "the file")[1][1]["b"] == "4"  # empty cells shift nothing


def test_quoted_decimal_commas_are_numbers():
    assert parse_table(b'a,b\n"-4,83",x\n', "the file")[1] == [{"a": "-4.83", "b": "x"}]
    assert parse_table(b"sep=;\r\na;b\r\n1,5;2\r\n", "the file")[1] == [{"a": "1.5", "b": "2"}]


@pytest.mark.parametrize("shape", [(), (0,), (0, 3), (2, 3), (3,)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.uint8, bool, "U5"])
def test_arrays_are_read_as_they_were_written(shape, dtype):
    array = np.ones(shape, dtype)
    fortran = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    read = parse_arrays(npz(a=array, b=fortran), "the file")
    assert read["a"].dtype == array.dtype
    assert np.array_equal(read["a"], array)
    assert np.array_equal(read["b"], fortran)


def npy_with_header(header):
    text = header.encode().ljust(117) + b"\n"
    member = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + b"\0" * 64
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("a.npy", member)
    return data.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cannot be read as arrays"),
        (b"PK nothing", "cannot be read as arrays"),
        (npz(a=np.zeros(3))[:-20], "cannot be read as arrays"),
        (npy_with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}"), "has 64 bytes"),
        (npy_with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (-8, -1)}"), "numbers and texts are allowed"),
        (npy_with_header("{'descr': '|O', 'fortran_order': False, 'shape': (8,)}"), "numbers and texts are allowed"),
        (npy_with_header("{'descr': '<f8'}"), "cannot be read as arrays"),
    ],
)
def test_damaged_arrays_are_refused(data, message):
    with pytest.raises(TactipError, match=message):
        parse_arrays(data, "the file")


def test_packed_bomb_is_refused_before_it_is_unpacked(monkeypatch):
    """At an eighth of the limit: to pack more than 512 MiB takes seconds."""
    assert input_files.MAX_UNPACKED_BYTES == 512 * MIB
    monkeypatch.setattr(input_files, "MAX_UNPACKED_BYTES", 64 * MIB)
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        for _ in range(75):
            member.write(bytes(MIB))
    assert len(data.getvalue()) < MIB / 8
    with Peak() as peak, pytest.raises(TactipError, match="must unpack to at most 64 MiB"):
        parse_arrays(data.getvalue(), "the file")
    assert peak.mib < 8


@pytest.mark.parametrize("size", [(60_000, 60_000), (10_000, 10_000), (2**31 - 1, 1)])
def test_image_bomb_is_refused(size):
    with pytest.raises(TactipError, match="must have at most 67108864 pixels"):
        decode_image(png_of_size(*size), "the image")


@pytest.mark.parametrize("data", [b"", b"no image", png_of_size(0, 0), png_of_size(4, 4)[:30]])
def test_damaged_image_is_refused(data):
    with pytest.raises(TactipError, match="cannot be read as an image"):
        decode_image(data, "the image")


def many(text, mib):
    """Return a text repeated to a size in MiB."""
    return text * int(mib * MIB / len(text))


WORST = {
    "rows": (parse_table, lambda part: b"a\n" + many(b"b\n", 31 * part)),
    "columns": (parse_table, lambda part: many(b"a,", 1)[:-1] + b"\n"),
    "rows without cells": (parse_table, lambda part: b"a" + 900 * b",a" + b"\n" + many(b"b\n", 31 * part)),
    "cells of one row": (parse_table, lambda part: b"a\n" + many(b"b,", 31 * part)),
    "a table that is too large": (parse_table, lambda part: many(b"a\n", 33 * part)),
    "empty rows": (parse_table, lambda part: many(b"\n", 31 * part)),
    "lists": (parse_json, lambda part: b"[" + many(b"[],", 15 * part) + b"1]"),
    "objects": (parse_json, lambda part: b"[" + many(b"{},", 15 * part) + b"1]"),
    "levels": (parse_json, lambda part: many(b"[", 15 * part)),
    "digits": (parse_json, lambda part: many(b"9", 15 * part)),
}
"""Files that take as much memory as can be: their reader, and a function from a part of the allowed size to their bytes."""


@pytest.mark.parametrize("part", [0.25, pytest.param(1.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", WORST)
def test_worst_files_take_less_than_2_gb(monkeypatch, kind, part):
    """Of the size that is allowed; with a quarter of the limits they take less than a quarter of that."""
    read, worst = WORST[kind]
    for name in ("_MAX_TABLE_BYTES", "_MAX_CELLS"):
        monkeypatch.setattr(input_files, name, int(part * getattr(input_files, name)))
    data = worst(part)
    with Peak() as peak, memory_limit(2048 * MIB), contextlib.suppress(TactipError):
        read(data, "the file")
    print(f"{peak.mib:.0f} MiB")
    assert peak.mib < 2048 * part


def test_json_of_more_than_16_mib_is_refused(tmp_path):
    path = tmp_path / "large.json"
    path.write_bytes(b"[" + many(b"1,", 17) + b"1]")
    with pytest.raises(TactipError, match=r"large\.json must have at most 16 MiB, got 17 MiB"):
        read_json(path)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b'{"a": 1}', "its last line has no end"),
        (b'{"a": 1}\n{"a": \n', r"line 2 is not JSON"),
        (b'{"a": 1}\n[1]\n', r"line 2 must be an object, got \[1\]"),
        (b'{"a": NaN}\n', "line 1 is not valid JSON"),
    ],
)
def test_read_json_lines_damaged_raises(tmp_path, data, words):
    path = tmp_path / "lines.jsonl"
    path.write_bytes(data)
    with pytest.raises(TactipError, match=words):
        read_json_lines(path)


def test_read_json_lines_returns_the_objects(tmp_path):
    path = tmp_path / "lines.jsonl"
    path.write_bytes(b'{"a": 1}\n{"b": [2]}\n')
    assert read_json_lines(path) == [{"a": 1}, {"b": [2]}]
    path.write_bytes(b"")
    assert read_json_lines(path) == []
