"""Which reader opens a map file, and what a set of files is rejected for."""

import gzip
import re
import zipfile
from pathlib import Path

import pytest

from egvs.core import readers
from egvs.core.errors import InputError, MissingBackendError
from egvs.creation import map_readers
from egvs.creation.map_parts import RoadMap
from egvs.creation.new_scenario import NewScenarioOptions, create_scenario
from egvs.creation.road_source import NetworkRoads
from tests.core.test_plugins import install_readers, site  # noqa: F401  the fixture
from tests.installed import needs

SCENARIOS = Path(__file__).parents[2] / "scenarios"
NETWORK = SCENARIOS / "roundabout" / "network.net.xml"
SMALL = Path(__file__).parent / "data" / "small.osm"


def test_finds_readers_by_name_and_content(tmp_path: Path) -> None:
    renamed = tmp_path / "roads.xml"
    renamed.write_bytes(NETWORK.read_bytes())
    packed = tmp_path / "packed.xml.gz"
    packed.write_bytes(gzip.compress(NETWORK.read_bytes()))
    for path in (NETWORK, renamed, packed):
        assert map_readers.find_reader(path).name == "SUMO network"
    assert map_readers.find_reader(SMALL).name == "OpenStreetMap"


def test_openstreetmap_with_another_road_map_has_static_objects_only() -> None:
    maps = map_readers.open_maps([SMALL, NETWORK])
    assert maps.roads.path == NETWORK
    assert [file.path for file in maps.solids] == [SMALL]


def test_folder_stands_for_its_maps(tmp_path: Path) -> None:
    (tmp_path / "roads.net.xml").write_bytes(NETWORK.read_bytes())
    (tmp_path / "notes.txt").write_text("not a map")
    assert map_readers.list_files([tmp_path]) == [tmp_path / "roads.net.xml"]


@pytest.mark.slow
def test_archive_stands_for_its_maps(tmp_path: Path, run_egvs) -> None:
    path = tmp_path / "maps.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("town/small.osm", SMALL.read_bytes())
        archive.writestr("notes.txt", "not a map")
    code, text, error = run_egvs("new", tmp_path / "made", "--from", path)
    assert code == 0 and "East Street and North Street" in text, error
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("town/small.osm.gz", gzip.compress(SMALL.read_bytes())[:-200])
    code, _, error = run_egvs("new", tmp_path / "other", "--from", path)
    assert code == 2 and f"{path}/town/small.osm.gz: damaged gzip file" in error
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        ((), "no road map"),
        (("a.net.xml", "b.net.xml"), "expected one road map"),
        (("a.net.xml", "photo.jpg"), "format of the file is unknown"),
        (("a.net.xml", "missing.gml"), "no such file"),
    ],
)
def test_rejects_files(tmp_path: Path, names: tuple[str, ...], problem: str) -> None:
    for name in names:
        if name.endswith(".net.xml"):
            (tmp_path / name).write_bytes(NETWORK.read_bytes())
        if name.endswith(".jpg"):
            (tmp_path / name).write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match=problem):
        map_readers.open_maps([tmp_path / name for name in names])


@needs("maps")
def test_rejects_truncated_file_in_folder_by_name(tmp_path: Path, run_egvs) -> None:
    """Also if it is not needed: what it would add is unknown."""
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "roads.net.xml").write_bytes(NETWORK.read_bytes())
    (tmp_path / "maps" / "town.osm.gz").write_bytes(gzip.compress(SMALL.read_bytes())[:-200])
    code, _, error = run_egvs("new", tmp_path / "made", "--from", tmp_path / "maps")
    assert code == 2 and f"{tmp_path / 'maps' / 'town.osm.gz'}: damaged gzip file" in error and "Traceback" not in error
    assert not (tmp_path / "made").exists()


def test_rejects_unreadable_file_in_folder_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "locked.gml").write_text("<CityModel/>")
    real = readers.open_input

    def open_input(path: Path) -> object:
        if path.name == "locked.gml":
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(readers, "open_input", open_input)
    with pytest.raises(InputError, match=r"locked.gml: the file cannot be read \(Permission denied\)"):
        map_readers.list_files([tmp_path])


@needs("maps")
def test_surface_model_has_heights(tmp_path: Path) -> None:
    (tmp_path / "surface.asc").write_text("ncols 2")
    (file,) = map_readers.open_surface([tmp_path / "surface.asc"])
    assert file.reader.name == "GeoTIFF or ASCII grid"
    with pytest.raises(InputError, match=r"small.osm: expected a surface model, got OpenStreetMap"):
        map_readers.open_surface([SMALL])


def test_rejects_folder_without_maps(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no map that can be read"):
        map_readers.list_files([tmp_path])


def test_network_made_from_openstreetmap_is_a_network(tmp_path: Path) -> None:
    """netconvert names the option ``osm-files`` in a comment at the top of the network."""
    path = tmp_path / "roads.xml"
    head, root, rest = NETWORK.read_text(encoding="utf-8").partition("<net ")
    path.write_text(f'{head}<!-- <osm-files value="town.osm"/> -->\n{root}{rest}', encoding="utf-8")
    assert map_readers.find_reader(path).name == "SUMO network"


@pytest.mark.parametrize(("faces", "reader"), [(0, "point cloud"), (1, "triangle mesh")])
@needs("maps")
def test_ply_is_a_mesh_if_it_has_faces(tmp_path: Path, faces: int, reader: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nelement face %d\nend_header\n" % faces)
    assert reader == map_readers.find_reader(path).name


def test_module_without_what_its_reader_gives_is_rejected(site: Path) -> None:  # noqa: F811
    rows = "Reader('walls', 'map', 'plug_walls', suffixes=('.walls',), gives=('roads', 'solids'))"
    install_readers(site, "somebody-elses", rows, {"plug_walls": "def open_roads(path, options): ..."})
    (site / "a.walls").write_text("")
    file = map_readers.MapFile(site / "a.walls", map_readers.find_reader(site / "a.walls"))
    with pytest.raises(MissingBackendError, match="plug_walls has no read_solids; expected a module with read_roads"):
        _ = file.module


def test_unusable_network_names_the_map_and_no_temporary_file(tmp_path: Path) -> None:
    lane = '<lane id="a_0" index="0" speed="10" length="9" shape="0,0 x,9"/>'
    road_map = RoadMap(f'<net version="1.20"><edge id="a" from="b" to="c">{lane}</edge></net>')
    with pytest.raises(InputError) as caught:
        NetworkRoads.read(road_map, tmp_path / "roads.xodr")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'roads.xodr'}: the network cannot be used: ")
    assert "network.net.xml" not in message


@pytest.mark.slow
def test_street_of_a_thousand_kilometres_names_the_extract(tmp_path: Path) -> None:
    osm = tmp_path / "long.osm"
    text, far = SMALL.read_text(encoding="utf-8"), 'id="104" lat="52.0017975" lon="-10"'
    assert 'id="104" lat="52.0017975" lon="10.0000000"' in text
    osm.write_text(text.replace('id="104" lat="52.0017975" lon="10.0000000"', far), encoding="utf-8")
    with pytest.raises(InputError, match=r"expected a shape of at most 1,000,000 m, got 1,377,\d+ m") as caught:
        create_scenario(tmp_path / "made", osm)
    assert str(caught.value).startswith(f"{osm}: the network cannot be used: lane ")


@pytest.mark.slow
def test_signal_that_cannot_be_read_names_the_network(tmp_path: Path) -> None:
    create_scenario(tmp_path / "made", SMALL)
    text = (tmp_path / "made" / "network.net.xml").read_text(encoding="utf-8")
    damaged, count = re.subn(r'(<tlLogic [^>]*offset=)"[^"]*"', r'\1"1e14"', text)
    assert count == 1
    path = tmp_path / "roads.net.xml"
    path.write_text(damaged, encoding="utf-8")
    with pytest.raises(InputError, match=r"a signal \(offset = 1e\+14: expected seconds, at most 1e\+09\)") as caught:
        create_scenario(tmp_path / "again", path, options=NewScenarioOptions(traffic=200))
    assert str(caught.value).startswith(f"{path}: the network cannot be used: invalid <tlLogic>")
