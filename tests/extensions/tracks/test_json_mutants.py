"""Damaged tracks in JSON, protobuf, Parquet and Feather end in an InputError that names a file, or in tracks.

The mutants are those of the fuzzer (``tests/fuzz/mutating.py``).
"""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from egvs.core import limits, readers
from egvs.core.errors import InputError
from egvs.core.readers import HEAD_BYTES
from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks.formats import argoverse2, dair_v2x, openlabel, osi, v2x_seq_tfd
from tests.extensions.tracks import writers_json
from tests.extensions.tracks.boxes import moving_boxes
from tests.extensions.tracks.writers import TrackRows
from tests.fuzz.mutating import mutant

Writer = Callable[[Path, TrackRows], Path]

KINDS: dict[str, tuple[ModuleType, Writer, str]] = {
    "OpenLABEL of ASAM": (openlabel, writers_json.write_openlabel, ""),
    "OpenLABEL of TUMTraf": (openlabel, writers_json.write_tumtraf, ""),
    "V2X-Seq label": (dair_v2x, writers_json.write_dair_v2x, ""),
    "V2X-Seq data_info.json": (dair_v2x, writers_json.write_dair_v2x, "data_info.json"),
    "V2X-Seq calibration": (dair_v2x, writers_json.write_dair_v2x, "calib/virtuallidar_to_world/000001.json"),
    "V2X-Seq scene": (v2x_seq_tfd, writers_json.write_v2x_seq_tfd, ""),
    "Argoverse 2 scenario": (argoverse2, writers_json.write_argoverse2_scenario, ""),
    "Argoverse 2 annotations": (argoverse2, writers_json.write_argoverse2, ""),
    "Argoverse 2 poses": (argoverse2, writers_json.write_argoverse2, "city_SE3_egovehicle.feather"),
    "OSI": (osi, writers_json.write_osi, ""),
    "OSI MCAP": (osi, writers_json.write_osi_mcap, ""),
}
"""The reader, the writer, and the file beside the one that is read that is damaged instead of it."""


def read_mutants(folder: Path, kind: str, seeds: range) -> tuple[int, int]:
    """Return how many mutants were read, and how many rejected."""
    reader, write, other = KINDS[kind]
    if reader is osi:
        pytest.importorskip("osi3", reason="osi-python is not installed (egvs[osi])")
    rows = moving_boxes(("car", "pedestrian"), 10)
    path = write(folder, rows)
    assert reader.can_open(path, path.read_bytes()[:HEAD_BYTES])
    assert reader.read(path).n_rows == len(rows.name)
    changed = folder / other if other else path
    sound = changed.read_bytes()
    read = rejected = 0
    for seed in seeds:
        changed.write_bytes(mutant(random.Random(seed), sound))
        assert reader.can_open(path, path.read_bytes()[:HEAD_BYTES]) in (True, False)
        try:
            reader.companions(path)
            tracks = reader.read(path)
            assert np.isfinite([tracks.time_s, tracks.x_m, tracks.y_m]).all(), seed
            read += 1
        except InputError as error:
            assert str(folder) in str(error), seed
            assert len(str(error)) < 4000 and "\n" not in str(error), seed
            rejected += 1
    return read, rejected


@pytest.mark.parametrize("kind", KINDS)
def test_one_reader_accepts_file(tmp_path: Path, kind: str) -> None:
    reader, write, _ = KINDS[kind]
    if reader is osi:
        pytest.importorskip("osi3", reason="osi-python is not installed (egvs[osi])")
    path = write(tmp_path, moving_boxes(("car", "pedestrian"), 10))
    head = path.read_bytes()[:HEAD_BYTES]
    assert track_readers.find_reader(path) is reader
    rows = [row for row in readers.list_readers(track_readers.KIND) if row.may_open(path, head)]
    assert {row.module for row in rows if readers.load_reader(row).can_open(path, head)} == {reader.__name__}


@pytest.fixture(autouse=True)
def less_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files that grow when they are unpacked are rejected sooner."""
    monkeypatch.setenv(limits.UNPACKED.name, "50")


@pytest.mark.parametrize("kind", KINDS)
def test_some_mutants(tmp_path: Path, kind: str) -> None:
    _, rejected = read_mutants(tmp_path, kind, range(12))
    assert rejected > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_200_mutants(tmp_path: Path, kind: str) -> None:
    read, rejected = read_mutants(tmp_path, kind, range(200))
    assert read > 0
    assert rejected > 20
