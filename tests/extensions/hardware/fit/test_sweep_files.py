"""Sweeps are read alike from every format; missing returns keep their slots; each bad file gives one message.

Evidence: the same 3,000 points by every writer, with NaN, infinite and zero points in known slots.
"""

from __future__ import annotations

import gzip
import zipfile
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats import pcd, ply
from egvs.formats.sweep_files import read_sweeps

MISSING = (0, 7, 2999)


def points() -> FloatArray:
    """3,000 points, three of which are missing returns in different notations."""
    made = np.round(np.random.default_rng(0).uniform(1.0, 30.0, (3000, 3)), 3)
    made[0] = np.nan
    made[7] = 0.0
    made[2999, 1] = np.inf
    return made


def write(path: Path, array: FloatArray) -> None:
    """Write points in the format of the suffix."""
    match path.suffix:
        case ".pcd":
            pcd.write(path, array)
        case ".ply":
            ply.write(path, array)
        case ".csv":
            rows = "\n".join(f"{x!r},{y!r},{z!r}" for x, y, z in array.tolist())
            path.write_text(f"x_m,y_m,z_m\n{rows}\n", encoding="utf-8")
        case ".npz":
            np.savez(path, first=array, second=array.astype(np.float32))


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".csv", ".npz"])
@pytest.mark.parametrize("packed", [False, True])
def test_formats_give_same_points(tmp_path: Path, suffix: str, packed: bool) -> None:
    path = tmp_path / f"sweep{suffix}"
    write(path, points())
    if packed:
        path = tmp_path / f"sweep{suffix}.gz"
        path.write_bytes(gzip.compress((tmp_path / f"sweep{suffix}").read_bytes()))
    sweep = read_sweeps([path])[0]
    expected = points()
    expected[list(MISSING)] = np.nan
    np.testing.assert_array_equal(sweep.points_m, expected)
    assert sweep.returns == 2997
    assert not sweep.is_coarse


def test_signalling_nan_is_a_missing_return(tmp_path: Path) -> None:
    made = points()
    made[5, 2] = np.uint64(0x7FF4_0000_0000_0000).view(np.float64)  # arithmetic with it warns
    pcd.write(tmp_path / "sweep.pcd", made)
    (sweep,) = read_sweeps([tmp_path / "sweep.pcd"])
    assert np.isnan(sweep.points_m).all(axis=1).nonzero()[0].tolist() == [0, 5, 7, 2999]


def test_each_array_is_a_sweep(tmp_path: Path) -> None:
    path = tmp_path / "frames.npz"
    np.savez(path, a=points().astype(np.float16), b=np.column_stack([points(), np.ones(3000)]))
    first, second = read_sweeps([path])
    assert (first.name, second.name) == ("frames.npz: a", "frames.npz: b")
    assert first.is_coarse and not second.is_coarse
    assert second.points_m.shape == (3000, 3)


def test_sweeps_keep_their_order(tmp_path: Path) -> None:
    for name in ("b.ply", "a.ply"):
        write(tmp_path / name, points())
    assert [sweep.name for sweep in read_sweeps([tmp_path / "b.ply", tmp_path / "a.ply"])] == ["b.ply", "a.ply"]


def _few(path: Path) -> Path:
    write(path.with_suffix(".ply"), points()[:500])
    return path.with_suffix(".ply")


def _viewpoint(path: Path) -> Path:
    path = path.with_suffix(".pcd")
    pcd.write(path, points())
    path.write_bytes(path.read_bytes().replace(b"VIEWPOINT 0 0 0 1", b"VIEWPOINT 0 0 5 1"))
    return path


def _flat(path: Path) -> Path:
    path = path.with_suffix(".npz")
    np.savez(path, a=np.ones((3000, 2)))
    return path


def _far(path: Path) -> Path:
    made = points()
    made[100, 1] = 2e154
    np.savez(path.with_suffix(".npz"), a=made)
    return path.with_suffix(".npz")


def _other_member(path: Path) -> Path:
    path = path.with_suffix(".npz")
    np.savez(path, a=points())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("notes.txt", "no array")
    return path


def _bad_header(path: Path) -> Path:
    """An array whose header is not the text of a dictionary."""
    path = path.with_suffix(".npz")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00\x40\x00" + b"{'descr': '<f8', 'shape': (9L,".ljust(64))
    return path


def _bytes(suffix: str, data: bytes):
    def write_bytes(path: Path) -> Path:
        path = path.with_name(f"sweep{suffix}")
        path.write_bytes(data)
        return path

    return write_bytes


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (_few, "at least 2,000 returns, got 498"),
        (_viewpoint, "in the sensor's frame, got a VIEWPOINT"),
        (_flat, "shape (n, 3), got float64 of shape (3000, 2)"),
        (_bytes(".npz", b"PK\x03\x04 no archive"), "cannot be read as .npz"),
        (_far, "within 10,000 m of the sensor, got 2e+154"),
        (_other_member, "notes.txt: expected an array"),
        (_bytes(".npz", b""), "cannot be read as .npz"),
        (_bad_header, "cannot be read as .npz"),
        (_bytes(".pcd.gz", b"\x1f\x8b no gzip"), "cannot be unpacked"),
        (_bytes(".pcd.gz", gzip.compress(b"# .PCD v0.7\n")[:-6]), "cannot be unpacked"),
        (_bytes(".docx", b"words"), "unknown file format"),
        (lambda path: path / "nowhere.pcd", "cannot be read"),
    ],
)
def test_rejects_bad_file(tmp_path: Path, make, message: str) -> None:
    path = make(tmp_path / "sweep")
    with pytest.raises(InputError) as caught:
        read_sweeps([path])
    assert message in str(caught.value)
    assert path.name in str(caught.value)


@pytest.mark.parametrize("name", ["ring", "channel"])
@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".csv", ".pcd.gz"])
def test_rings_of_the_file(tmp_path: Path, suffix: str, name: str) -> None:
    ring = np.arange(3000, dtype=np.uint16) % 40
    made = points()
    path = tmp_path / f"sweep{suffix.removesuffix('.gz')}"
    if suffix == ".csv":
        rows = "\n".join(f"{x!r},{y!r},{c},{z!r}" for (x, y, z), c in zip(made.tolist(), ring, strict=True))
        path.write_text(f"x_m,y_m,{name},z_m\n{rows}\n", encoding="utf-8")
    else:
        columns = {axis: made[:, number] for number, axis in enumerate("xyz")} | {name: ring}
        (ply if suffix == ".ply" else pcd).write_columns(path, columns)
    if suffix.endswith(".gz"):
        path.with_name("sweep.pcd.gz").write_bytes(gzip.compress(path.read_bytes()))
        path = path.with_name("sweep.pcd.gz")
    sweep = read_sweeps([path])[0]
    assert sweep.ring is not None
    np.testing.assert_array_equal(sweep.ring, ring)
    assert sweep.returns == 2997


def test_field_that_is_no_ring_number_is_ignored(tmp_path: Path) -> None:
    columns = {axis: points()[:, number] for number, axis in enumerate("xyz")}
    for value in (0.5, -1.0, np.nan, 70_000.0):
        pcd.write_columns(tmp_path / "sweep.pcd", columns | {"ring": np.full(3000, value)})
        assert read_sweeps([tmp_path / "sweep.pcd"])[0].ring is None


def test_damaged_ring_column_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"1,2,3,{number if number != 7 else 'seven'}\n" for number in range(2500))
    (tmp_path / "sweep.csv").write_text(f"x_m,y_m,z_m,ring\n{rows}", encoding="utf-8")
    with pytest.raises(InputError, match=r"sweep.csv: line 9: ring: expected a number, got 'seven'"):
        read_sweeps([tmp_path / "sweep.csv"])
