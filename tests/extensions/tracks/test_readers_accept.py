"""Each format is accepted by its own reader and by no other, plain and gzipped."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from egvs.core import readers
from egvs.core.readers import HEAD_BYTES
from egvs.extensions.tracks import sources as track_readers
from tests.extensions.tracks import writers
from tests.extensions.tracks.boxes import moving_boxes
from tests.extensions.tracks.writers import TrackRows

WRITERS: dict[str, tuple[Callable[[Path, TrackRows], Path], ...]] = {
    "interaction": (writers.write_interaction, writers.write_taf_bw), "sind": (writers.write_sind,),
    "levelx": (writers.write_levelx,), "highd": (writers.write_highd,), "ngsim": (writers.write_ngsim,),
    "pneuma": (writers.write_pneuma,), "lumpi": (writers.write_lumpi,),
}  # fmt: skip


def modules() -> list[ModuleType]:
    return [readers.load_reader(reader) for reader in readers.list_readers(track_readers.KIND)]


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("name", WRITERS)
def test_only_one_reader_accepts_a_file(tmp_path: Path, name: str, packed: bool) -> None:
    for write in WRITERS[name]:
        path = write(tmp_path, moving_boxes(["car"], n_frames=40, straight=True))
        head = path.read_bytes()[:HEAD_BYTES]
        accepting = [module.__name__ for module in modules() if module.can_open(path, head)]
        assert accepting == [f"egvs.extensions.tracks.formats.{name}"]
        if packed:
            zipped = path.with_name(f"{path.name}.gz")
            zipped.write_bytes(gzip.compress(path.read_bytes()))
            path.unlink()
            path = zipped
        tracks = track_readers.find_reader(path).read(path)
        assert tracks.names == ("1", "2") and tracks.classes == ("car", "car")


@pytest.mark.parametrize(
    "head", [b"", b"\x00\xff\xfe", b"\x1f\x8b\x00", b"," * 5000, b"{}", b"[]", b"PAR1", b"\xff" * 5000]
)
@pytest.mark.parametrize("name", ["other.bin", "other.json"])
def test_no_reader_accepts_other_files(tmp_path: Path, name: str, head: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(head)
    for reader in readers.list_readers(track_readers.KIND):
        assert not (reader.may_open(path, head) and readers.load_reader(reader).can_open(path, head))


@pytest.mark.parametrize(
    ("start", "end", "name"),
    [
        ("{", '"openlabel": {"frames": {}}}', "OpenLABEL"),
        ("[{", '"3d_location": {}}]', "DAIR-V2X or V2X-Seq labels"),
    ],
)
def test_member_that_tells_the_format_may_come_last(tmp_path: Path, start: str, end: str, name: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'{start}"a": "{"x" * 2 * HEAD_BYTES}", {end}')
    for kind in ("tracks", "labels"):
        reader = readers.find_reader(kind, path)
        assert reader is not None and reader.name == name
