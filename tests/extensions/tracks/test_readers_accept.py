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


@pytest.mark.parametrize("head", [b"", b"\x00\xff\xfe", b"\x1f\x8b\x00", b"," * 5000, b"{}", b"PAR1", b"\xff" * 5000])
def test_no_reader_fails_on_other_files(head: bytes) -> None:
    for module in modules():
        assert not module.can_open(Path("other.bin"), head)
