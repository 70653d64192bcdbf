"""The table of readers: recognises files without imports, in a stated order, and names packages that are wrong."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

import pytest

from egvs.core import limits, readers
from egvs.core.errors import InputError, MissingBackendError
from egvs.core.readers import Reader
from tests.core.test_plugins import install, install_readers, site  # noqa: F401  the fixture
from tests.installed import needs

DATA = Path("data.bin")


def reader(**conditions: object) -> Reader:
    return Reader("walls", "map", "plug_walls", **conditions)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("conditions", "name", "head", "expected"),
    [
        ({}, "a.walls", b"walls", False),
        ({"suffixes": (".walls",)}, "a.WALLS", b"", True),
        ({"suffixes": (".walls",)}, "a.walls.gz", b"", False),
        ({"suffixes": readers.with_gzip(".walls")}, "a.walls.gz", b"", True),
        ({"suffixes": (".walls",)}, "a.wallsx", b"walls", False),
        ({"head": rb"\Awalls"}, "a.txt", b"walls", True),
        ({"head": rb"\Awalls"}, "a.txt", b"the walls", False),
        ({"head": rb"<walls[\s>]"}, "a.xml", "<walls>".encode("utf-16"), True),
        ({"suffixes": (".walls",), "head": rb"walls"}, "a.walls", b"other", True),
    ],
)
def test_recognises_by_name_or_beginning(conditions: dict[str, object], name: str, head: bytes, expected: bool) -> None:
    assert reader(**conditions).may_open(Path(name), head) is expected


@pytest.mark.parametrize("size", [0, 10, (1 << 20) - 3, (1 << 20) + 7])
@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_content_decides_wherever_it_is(tmp_path: Path, size: int, pack: object) -> None:
    """Also across the border of two pieces that are read."""
    with_content = reader(suffixes=(".walls",), content=rb"the wall")
    for text, expected in ((b"the wall", True), (b"the door", False)):
        path = tmp_path / "a.walls"
        path.write_bytes(pack(b"." * size + text))  # type: ignore[operator]
        assert with_content.may_open(path, b"") is expected
    path.rename(tmp_path / "a.doors")
    assert not with_content.may_open(tmp_path / "a.doors", b"")


def test_damaged_or_large_gzip_may_be_of_the_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its reader then says what is wrong."""
    path = tmp_path / "a.walls"
    packed = gzip.compress(b"door " * 1_000_000)
    path.write_bytes(packed)
    with_content = reader(suffixes=(".walls",), content=b"wall")
    assert not with_content.may_open(path, b"")
    monkeypatch.setenv(limits.UNPACKED.name, "1")
    assert with_content.may_open(path, b"")
    monkeypatch.delenv(limits.UNPACKED.name)
    path.write_bytes(packed[:-20])
    assert with_content.may_open(path, b"")
    assert readers.read_head(path).startswith(b"door door")


def test_imports_only_the_reader_of_the_file(site: Path) -> None:  # noqa: F811
    rows = (
        "Reader('doors', 'map', 'plug_doors', suffixes=('.doors',)), Reader('walls', 'map', 'plug_w', suffixes=('.w',))"
    )
    install_readers(site, "somebody-elses", rows, {"plug_doors": "raise RuntimeError", "plug_w": "A = 1"})
    (site / "a.w").write_text("")
    found = readers.find_reader("map", site / "a.w")
    assert found is not None and found.name == "walls" and readers.reader_package(found) == "somebody-elses"
    assert readers.find_reader("points", site / "a.w") is None
    assert readers.load_reader(found).A == 1
    assert "plug_doors" not in sys.modules
    assert {"doors", "walls"} <= set(readers.describe_formats("map").split(", "))


def test_module_decides_where_the_table_cannot(site: Path) -> None:  # noqa: F811
    rows = "Reader('first', 'map', 'plug_a', suffixes=('.w',)), Reader('second', 'map', 'plug_b', suffixes=('.w',))"
    test = "def can_open(path, head):\n    return head.startswith(b'1')"
    install_readers(site, "somebody-elses", rows, {"plug_a": test, "plug_b": ""})
    for text, name in (("1", "first"), ("2", "second")):
        (site / "a.w").write_text(text)
        found = readers.find_reader("map", site / "a.w")
        assert found is not None and found.name == name


@needs("maps")
def test_content_comes_first_and_no_package_replaces_a_reader_of_this_program(site: Path) -> None:  # noqa: F811
    by_name = "Reader('by name', 'map', 'plug_a', suffixes=('.w', '.osm'))"
    rows = f"{by_name}, Reader('zz', 'map', 'plug_b', suffixes=('.w',), content=b'z')"
    install_readers(site, "aaa", rows, {"plug_a": "", "plug_b": ""})
    for name, text, expected in (("a.w", "z", "zz"), ("a.w", "y", "by name"), ("a.osm", "z", "OpenStreetMap")):
        (site / name).write_text(text)
        found = readers.find_reader("map", site / name)
        assert found is not None and found.name == expected
    names = [each.name for each in readers.list_readers("map")]
    assert names.index("Lanelet2") < names.index("OpenStreetMap") < names.index("zz") < names.index("by name")


@pytest.mark.parametrize(
    ("declarations", "problem"),
    [
        ("READERS = 1", r"expected a tuple of egvs\.core\.readers\.Reader, got 1"),
        ("READERS = ('walls',)", r"expected a tuple of egvs\.core\.readers\.Reader"),
        (
            "from egvs.core.readers import Reader\nREADERS = (Reader('a', 'mop', 'm'),)",
            "is of the kind 'mop'; expected",
        ),
        ("from egvs.core.readers import Reader\nREADERS = (Reader('a', 'map', 'm', head=b'('),)", "its import raised"),
    ],
)
def test_rejects_wrong_declarations(site: Path, declarations: str, problem: str) -> None:  # noqa: F811
    install(site, "somebody-elses", "a = plug_a:READERS", {"plug_a": declarations}, readers.GROUP)
    with pytest.raises(MissingBackendError, match=rf"{problem}.*of the package somebody-elses"):
        readers.list_readers("map")


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("raise RuntimeError('boom')", r"its import raised RuntimeError\('boom'\)"),
        ("import nowhere_to_be_found", "No module named 'nowhere_to_be_found'"),
        ("", "plug_a has no read_solids, read_roads; expected a map"),
    ],
)
def test_message_of_broken_reader_names_its_package(site: Path, source: str, problem: str) -> None:  # noqa: F811
    install_readers(site, "somebody-elses", "Reader('walls', 'map', 'plug_a')", {"plug_a": source})
    (walls,) = (each for each in readers.list_readers("map") if each.name == "walls")
    with pytest.raises(MissingBackendError, match=rf"the reader 'walls': {problem}.*of the package somebody-elses"):
        readers.load_reader(walls, ("read_solids", "read_roads"), "a map")


@pytest.mark.parametrize("group", readers.FORMER_GROUPS)
def test_message_of_former_group_names_the_new_one(site: Path, group: str) -> None:  # noqa: F811
    install(site, "old-package", "walls = plug_old", {}, group)
    message = rf"the group {group} is now egvs\.readers.*\(entry point 'plug_old' of the package old-package\)"
    with pytest.raises(MissingBackendError, match=message):
        readers.list_readers("map")


def test_rejects_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"missing\.osm: no such file"):
        readers.find_reader("map", tmp_path / "missing.osm")


def test_modules_of_this_program_exist_and_their_formats_differ() -> None:
    for kind, functions in (("points", ("read",)), ("tracks", ("companions", "read")), ("sweeps", ("read",))):
        assert all(readers.load_reader(each, functions, "") for each in readers.list_readers(kind))
    assert "OpenStreetMap" in readers.describe_formats("map", "roads").split(", ")
    assert "OpenStreetMap" not in readers.describe_formats("map", "terrain")
