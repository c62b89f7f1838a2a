"""Input files, refused word by word: each kind of damage, and each limit at its two sides."""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane import files
from trilane.errors import BadInputError
from trilane.files import as_numbers, npz_names, npz_pickles, read_npy, read_npz, read_text, require_file, whole_number

WANTED = "numbers of mine"


def said(call: Callable[[], Any]) -> str:
    with pytest.raises(BadInputError) as refused:
        call()
    return str(refused.value)


def header(shape: str, descr: str = "'<f8'", version: int = 1) -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text


def test_what_is_no_file(tmp_path: Path) -> None:
    file = tmp_path / "f"
    assert said(lambda: require_file(file, WANTED)) == f"{file}: found no such file, expected {WANTED}"
    file.mkdir()
    assert said(lambda: require_file(file, WANTED)) == f"{file}: found a folder, expected {WANTED}"
    nul = Path("a\0b")
    found = said(lambda: require_file(nul, WANTED))
    assert found in (
        f"{nul}: found a file that cannot be read (embedded null byte), expected {WANTED}",
        f"{nul}: found no such file, expected {WANTED}",
    )
    os.mkfifo(tmp_path / "pipe")
    pipe = tmp_path / "pipe"
    assert said(lambda: require_file(pipe, WANTED)) == f"{pipe}: found a device, a pipe or a socket, expected {WANTED}"


def test_sizes_of_files(tmp_path: Path) -> None:
    file = tmp_path / "f"
    for size in (1, 5):
        file.write_bytes(b"x" * size)
        assert require_file(file, WANTED) == size
    file.write_bytes(b"")
    assert said(lambda: require_file(file, WANTED)) == f"{file}: found an empty file, expected {WANTED}"


def test_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "t.txt"
    file.write_bytes(b"\xef\xbb\xbfna\xc3\xafve\n")
    assert read_text(file, WANTED) == "naïve\n"
    monkeypatch.setattr(files, "MAX_TEXT_BYTES", 10)
    assert read_text(file, WANTED) == "naïve\n"
    monkeypatch.setattr(files, "MAX_TEXT_BYTES", 9)
    assert said(lambda: read_text(file, WANTED)) == f"{file}: found 10 bytes, expected at most 9"
    file.write_bytes(b"a\xff")
    found = said(lambda: read_text(file, WANTED))
    assert found.startswith(f"{file}: found a file that cannot be read as text ('utf-8")
    assert found.endswith(f"), expected {WANTED}; if it is text, save it as UTF-8")
    monkeypatch.undo()
    file.write_text("1 2\n3 \0 4\n")
    assert (
        said(lambda: read_text(file, WANTED)) == f"{file}, line 2: found a NUL byte, as no text has, expected {WANTED}"
    )


#: Heads of files as their specifications have them: content, what it is, the beginning of the remedy.
OTHERS = {
    "FBX": (b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0", "an FBX file", "export the motion as BVH"),
    "ASCII FBX": (b"; FBX 7.5.0 project file\n", "an FBX file", "export the motion as BVH"),
    "GLB": (b"glTF\x02\0\0\0", "a binary glTF file (GLB, VRM)", "export the motion as BVH"),
    "glTF": (b'{ "asset" : { "version": "2.0" } }', "a glTF file", "export the motion as BVH"),
    "VMD": (b"Vocaloid Motion Data 0002\0", "a VMD file", "export the motion as BVH"),
    "Unity": (b"%YAML 1.1\n%TAG !u! tag:unity3d.com,2011:\n", "a Unity asset", "export the clip as FBX"),
    "MVNX": (b'<?xml version="1.0"?>\n<mvnx version="4">', "an MVNX file", "in Xsens MVN"),
    "ASF": (b"# AST/ASF file\n:version 1.10\n:name walker\n", "an ASF or AMC file", "export the motion as BVH"),
    "AMC": (b"#!OML:ASF F:\\VICON\n:FULLY-SPECIFIED\n:DEGREES\n", "an ASF or AMC file", "export the motion as BVH"),
    "torch": (b"PK\x03\x04" + bytes(26) + b"archive/data.pklFB", "a file of torch.save", "save its arrays with NumPy"),
    "USD": (b"#usda 1.0\n", "a USD file", "export the motion as BVH"),
    "USD crate": (b"PXR-USDC\0\x08\0\0", "a USD file", "export the motion as BVH"),
    "pickle": (b"\x80\x04\x95\x10\0\0\0\0\0\0\0", "a Python pickle", "save its arrays with NumPy"),
    "UTF-16": ("HIERARCHY\n".encode("utf-16"), "text in UTF-16", "save it as UTF-8"),
    "LFS": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "a Git LFS pointer", "fetch it"),
    "web page": (b"\n<!DOCTYPE HTML><html>", "a web page", "download the file itself"),
    "MP4": (b"\0\0\0\x20ftypisom", "an MP4 or QuickTime video", ""),
}


@pytest.mark.parametrize("case", OTHERS)
def test_another_format_is_named_by_every_reader(case: str, tmp_path: Path) -> None:
    content, name, remedy = OTHERS[case]
    file = tmp_path / "walk.bvh"
    file.write_bytes(content)
    for read in (read_text, read_npy, lambda path, wanted: read_npz(path, ["a"], wanted)):
        with pytest.raises(BadInputError) as refused:
            read(file, WANTED)
        assert refused.value.found.startswith(name)
        assert refused.value.remedy.startswith(remedy)
        assert refused.value.expected == WANTED


def test_links_that_lead_nowhere(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    assert said(lambda: require_file(tmp_path / "a", WANTED)).endswith(
        f"found a link to {tmp_path / 'b'}, which is not there, expected {WANTED}"
    )
    (tmp_path / "b").symlink_to(tmp_path / "a")
    for place in (tmp_path / "a", tmp_path / "a" / "below"):
        assert "found a link that leads back to itself" in said(lambda place=place: require_file(place, WANTED))


def test_whole_numbers_of_any_length() -> None:
    assert whole_number("12") == 12
    assert whole_number("9" * 299) == 10**299 - 1
    assert (whole_number("9" * 300), whole_number("-" + "9" * 5000)) == (math.inf, -math.inf)


def test_names_of_arrays(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", poses=np.zeros(3), trans=np.zeros(3))
    assert npz_names(tmp_path / "a.npz", WANTED) == ["poses", "trans"]
    (tmp_path / "b.npz").write_bytes(b"PK\x03\x04 and nothing")
    assert "no readable .npz archive" in said(lambda: npz_names(tmp_path / "b.npz", WANTED))


DAMAGED = {
    "short": (header("(3, 5)") + b"x" * 119, "{size} bytes, truncated, expected {whole} by its own header"),
    "negative": (header("(-3, 5)") + b"x" * 120, f"shape (-3, 5), expected {WANTED}"),
    "version": (b"\x93NUMPY\x03\x00" + b"x" * 50, ".npy version (3, 0), expected 1.0 or 2.0"),
    "objects": (header("(3,)", "'|O'"), "pickled objects, expected numbers; save it as a plain number array"),
    "huge": (
        header("(134217729,)") + b"x",
        "shape (134217729,), 1073741832 bytes, expected at most 1073741824 bytes",
    ),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_arrays(case: str, tmp_path: Path) -> None:
    content, found = DAMAGED[case]
    file = tmp_path / "a.npy"
    file.write_bytes(content)
    found = found.format(size=len(content), whole=len(content) + 1)
    assert said(lambda: read_npy(file, WANTED)) == f"{file}: found {found}"


@pytest.mark.parametrize(
    "content",
    [
        b"no magic at all",
        header("(3,")[:-1],
        header("3"),
        header("(3,), b'x': 1"),  # NumPy sorts the keys
        header("(3,)", "()"),  # and takes the first of a tuple
        header("(3,), []: 1"),
    ],
)
def test_broken_headers(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.npy"
    file.write_bytes(content)
    found = said(lambda: read_npy(file, WANTED))
    assert found.startswith(f"{file}: found no readable NumPy array (") and found.endswith(f"), expected {WANTED}")


@pytest.mark.parametrize("version", [1, 2])
def test_arrays_come_as_they_were(version: int, tmp_path: Path) -> None:
    """Also in Fortran's order, and with bytes behind the end."""
    file = tmp_path / "a.npy"
    array = np.arange(15.0).reshape(3, 5)
    file.write_bytes(header("(3, 5)", version=version) + array.tobytes() + b"more")
    np.testing.assert_array_equal(read_npy(file, WANTED), array)
    np.save(file, np.asfortranarray(array))
    np.testing.assert_array_equal(read_npy(file, WANTED), array)


def test_an_old_header_is_read_without_a_warning(tmp_path: Path) -> None:
    """Python 2 wrote long numbers with an L."""
    file = tmp_path / "a.npy"
    file.write_bytes(header("(2L,)") + np.array([1.0, 2.0]).tobytes())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_npy(file, WANTED).tolist() == [1.0, 2.0]


def test_arrays_and_objects_of_an_archive_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two members of 128 + 24 bytes each; two objects with pickles of the same length."""
    file = tmp_path / "a.npz"
    np.savez(file, a=np.arange(3), b=np.arange(3), o=np.array([None], object), p=np.array([None], object))
    monkeypatch.setattr(files, "MAX_ARRAY_BYTES", 304)
    assert len(read_npz(file, ("a", "b"), WANTED)) == 2
    monkeypatch.setattr(files, "MAX_ARRAY_BYTES", 303)
    assert said(lambda: read_npz(file, ("a", "b"), WANTED)) == (
        f"{file}: found 304 bytes of arrays, expected at most 303"
    )
    size = len(zipfile.ZipFile(file).read("o.npy"))
    assert npz_pickles(file, ("a", "p"), size, WANTED).keys() == {"p"}
    pickle = len(npz_pickles(file, ("o",), size, WANTED)["o"])
    assert len(npz_pickles(file, ("o", "p"), size + pickle, WANTED)) == 2
    assert said(lambda: npz_pickles(file, ("o", "p"), size + pickle - 1, WANTED)) == (
        f"{file}[p]: found {size} bytes of Python objects, expected at most {size - 1}"
    )


def test_archives(tmp_path: Path) -> None:
    """Members that nobody asked for are not opened; one that is wrong is named."""
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w") as archive:
        buffer = io.BytesIO()
        np.save(buffer, np.arange(3))
        archive.writestr("good.npy", buffer.getvalue())
        archive.writestr("short.npy", header("(2,)") + b"x" * 15)
        archive.writestr("objects.npy", header("(2,)", "'|O'"))
        archive.writestr("text.txt", "text")
    found = read_npz(file, ("good", "absent", "text"), WANTED)
    assert list(found) == ["good"] and found["good"].tolist() == [0, 1, 2]
    size = len(header("(2,)")) + 15
    truncated = f"{file}[short]: found {size} bytes, truncated, expected {size + 1} by its own header"
    assert said(lambda: read_npz(file, ("good", "short"), WANTED)) == truncated
    assert said(lambda: read_npz(file, ("objects",), WANTED)).startswith(f"{file}[objects]: found pickled objects")
    file.write_bytes(b"PK no archive")
    assert said(lambda: read_npz(file, ("good",), WANTED)) == (
        f"{file}: found no readable .npz archive (File is not a zip file), expected {WANTED}"
    )


def test_what_are_numbers() -> None:
    for kind in (np.float32, np.int8, np.uint64):
        given = as_numbers("f", np.array([1, 2], kind), WANTED)
        assert (given.dtype, given.tolist()) == (np.float64, [1.0, 2.0])
    for array in (np.array(["x"]), np.array([True]), np.array([1j])):
        assert said(lambda: as_numbers("f", array, WANTED)) == f"f: found dtype {array.dtype}, expected {WANTED}"  # noqa: B023
