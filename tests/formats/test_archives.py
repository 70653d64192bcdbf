"""ZIP archives and KMZ files: what is unpacked, what is refused, and whom messages name."""

from __future__ import annotations

import importlib.util
import stat
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.formats import archives, vector_files
from egvs.formats.archives import unpack_archives

pytestmark = pytest.mark.system

RING = "8.0,50.0,0 8.001,50.0,0 8.001,50.001,0 8.0,50.0,0"
KML = (
    '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>hall</name><Polygon>'
    f"<outerBoundaryIs><LinearRing><coordinates>{RING}</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark>"
    "</Document></kml>"
)
needs_gdal = pytest.mark.skipif(
    importlib.util.find_spec("pyogrio") is None, reason="pyogrio is not installed (egvs[gis])"
)


def write_zip(path: Path, members: Mapping[str, str | bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_an_archive_is_a_folder_of_its_files(tmp_path: Path) -> None:
    members = {"a.txt": "one", "deep/b.txt": "two", "empty.txt": "", "__MACOSX/a.txt": "x", ".hidden": "x", "d/": ""}
    path = write_zip(tmp_path / "tiles.ZIP", members)
    plain = tmp_path / "c.txt"
    plain.write_text("three")
    with unpack_archives([plain, path]) as unpacked:
        first, folder = unpacked.paths
        texts = {file.relative_to(folder).as_posix(): file.read_text() for file in folder.rglob("*") if file.is_file()}
        assert unpacked.user_text(f"{folder}/a.txt: bad") == f"{path}/a.txt: bad"
    assert first == plain
    assert texts == {"a.txt": "one", "deep/b.txt": "two", "empty.txt": ""}
    assert not folder.exists()


@pytest.mark.slow
def test_archives_in_archives_are_folders(tmp_path: Path) -> None:
    def packed(members: Mapping[str, str | bytes]) -> bytes:
        return write_zip(tmp_path / "made", members).read_bytes()

    two = packed({"deep.zip": packed({"b.txt": "two"}), "named.zip": "text"})
    path = write_zip(tmp_path / "a.zip", {"x/tiles.zip": two, "a.txt": "one"})
    with unpack_archives([path]) as unpacked:
        (folder,) = unpacked.paths
        texts = {file.relative_to(folder).as_posix(): file.read_text() for file in folder.rglob("*") if file.is_file()}
    assert texts == {"a.txt": "one", "x/tiles.zip/deep.zip/b.txt": "two", "x/tiles.zip/named.zip": "text"}
    out = packed({"../out.txt": "x"})
    for members, message in (
        (
            {"x.zip": packed({"y.zip": packed({"z.zip": packed({"b": ""})})})},
            r"a\.zip/x\.zip/y\.zip/z\.zip: .* more than 3 deep",
        ),
        ({"x.zip": out}, r"a\.zip/x\.zip: its member '\.\./out\.txt' leads out of the archive"),
    ):
        with pytest.raises(InputError, match=message), unpack_archives([write_zip(path, members)]):
            pass


def test_first_bytes_tell_an_archive(tmp_path: Path) -> None:
    named = tmp_path / "map.zip"
    named.write_text("<osm/>")
    zipped = write_zip(tmp_path / "map.osm", {"map.osm": "<osm/>"})
    with unpack_archives([named, zipped]) as unpacked:
        assert unpacked.paths[0] == named
        assert (unpacked.paths[1] / "map.osm").read_text() == "<osm/>"


def test_errors_name_the_archive(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "tiles.zip", {"a.txt": "one"})
    with (
        pytest.raises(InputError, match=rf"^{path}/a\.txt: line 1: wrong, see {path}/a\.txt"),
        unpack_archives([path]) as unpacked,
    ):
        raise InputError(f"{unpacked.paths[0]}/a.txt: line 1", f"wrong, see {unpacked.paths[0]}/a.txt")


@pytest.mark.parametrize("name", ["../out.txt", "/etc/out.txt", "a/../../out.txt", "..\\out.txt", "C:out.txt"])
def test_no_member_leads_out(tmp_path: Path, name: str) -> None:
    path = write_zip(tmp_path / "a.zip", {"in.txt": "x", name: "x"})
    with pytest.raises(InputError, match=r"a\.zip: its member .* leads out of the archive"), unpack_archives([path]):
        pass
    assert not list(tmp_path.parent.glob("out.txt"))


def test_links_are_refused(tmp_path: Path) -> None:
    link = zipfile.ZipInfo("link.txt")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(InputError, match=r"its member 'link\.txt' is a link"), unpack_archives([tmp_path / "a.zip"]):
        pass


@pytest.mark.slow
def test_archives_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = write_zip(tmp_path / "a.zip", {"zeros.txt": bytes(3_000_000)})
    assert bomb.stat().st_size < 10_000
    monkeypatch.setenv("EGVS_MAX_UNPACKED_MB", "2")
    with pytest.raises(InputError, match=r"a\.zip: has 3 MB after decompression"), unpack_archives([bomb]):
        pass
    content = bytearray(bomb.read_bytes())
    size_at = content.index(b"PK\x01\x02") + 24  # the size that the directory declares
    content[size_at : size_at + 4] = (10).to_bytes(4, "little")
    bomb.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.zip: .*(damaged|MB)"), unpack_archives([bomb]):
        pass
    many = write_zip(tmp_path / "b.zip", {f"{n}.txt": "" for n in range(archives.MAX_MEMBERS + 1)}, zipfile.ZIP_STORED)
    with pytest.raises(InputError, match=r"b\.zip: has 10,001 files; at most 10,000 are read"), unpack_archives([many]):
        pass


@pytest.mark.slow
def test_damaged_and_encrypted_archives(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "a.zip", {"a.txt": "one " * 100})
    good = path.read_bytes()
    directory = good.index(b"PK\x01\x02")
    encrypted = good[: directory + 8] + b"\1" + good[directory + 9 :]
    damaged = good[:40] + bytes(8) + good[48:]
    for content, message in (
        (good[:-30], "cannot be read as a ZIP archive"),
        (encrypted, r"its member 'a\.txt' is encrypted"),
        (damaged, r"a\.zip: .*"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=message), unpack_archives([path]):
            pass


@pytest.mark.slow
@needs_gdal
def test_kmz_and_zipped_layers(tmp_path: Path) -> None:
    kmz = write_zip(tmp_path / "a.kmz", {"doc.kml": KML, "more/other.kml": KML, "files/icon.png": b"x"})
    (feature,) = vector_files.read_gis_file(kmz, "Polygon")["features"]
    assert feature["properties"]["name"] == "hall"
    assert len(feature["geometry"]["coordinates"][0][0]) == 2  # altitudes are left out, as of a .kml
    (feature,) = vector_files.read_gis_file(write_zip(tmp_path / "b.zip", {"x/h.kml": KML}), "Polygon")["features"]
    assert feature["properties"]["name"] == "hall"
    two = write_zip(tmp_path / "c.zip", {"a.kml": KML, "b.kml": KML})
    with pytest.raises(InputError, match=r"c\.zip: expected one file of .*, got a\.kml, b\.kml"):
        vector_files.read_gis_file(two, "Polygon")
    broken = write_zip(tmp_path / "d.kmz", {"doc.kml": KML[:200]})
    with pytest.raises(InputError, match=rf"^{tmp_path}/d\.kmz/doc\.kml: "):
        vector_files.read_gis_file(broken, "Polygon")
    with pytest.raises(InputError, match=r"e\.kmz: "):
        vector_files.read_gis_file(tmp_path / "e.kmz", "Polygon")


@pytest.mark.slow
@needs_gdal
def test_zipped_shapefile(tmp_path: Path) -> None:
    import pyogrio
    import shapely

    shape = shapely.box(0.0, 0.0, 10.0, 20.0)
    pyogrio.raw.write(
        tmp_path / "h.shp",
        shapely.to_wkb([shape]),
        [np.array(["hall"], dtype=object)],
        ["name"],
        geometry_type="Polygon",
        crs="EPSG:25832",
    )
    parts = {part.name: part.read_bytes() for part in tmp_path.glob("h.*")}
    document = vector_files.read_gis_file(write_zip(tmp_path / "h.zip", parts), "Polygon")
    assert document["features"][0]["properties"]["name"] == "hall"
    assert "25832" in document["crs"]["properties"]["name"]
    del parts["h.prj"]
    with pytest.raises(InputError, match=r"h2\.zip/h\.shp: the file does not declare .* Add h\.prj"):
        vector_files.read_gis_file(write_zip(tmp_path / "h2.zip", parts), "Polygon")


@pytest.mark.parametrize(
    "names",
    [("a.csv", "a.csv"), ("a.csv", "./a.csv"), ("a", "a/b.csv"), ("a/b.csv", "a"), ("x" * 300,), ("d/" * 2500 + "b",)],
)
def test_members_that_cannot_be_files_are_named(tmp_path: Path, names: tuple[str, ...]) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zipfile warns of names that it has written before
        for name in names:
            archive.writestr(name, "x")
    with pytest.raises(InputError, match=r"a\.zip: its member '[^']+'") as error, unpack_archives([path]):
        pass
    assert "egvs-work" not in str(error.value)


@pytest.mark.slow
def test_deep_folders_are_unpacked(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "a.zip", {"d/" * 400 + "b.csv": "x"})
    with unpack_archives([path]) as unpacked:
        assert [file.name for file in unpacked.paths[0].rglob("*.csv")] == ["b.csv"]
