"""Each stage opens each Parquet file of the run folder at most once."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder

SETTINGS = ('score.others=["seen_well", "coverage"]', "score.keep_visibility=all", "tpog.blocks=4")


def count_opens(scenario: egvs.Scenario, out: Path, monkeypatch: pytest.MonkeyPatch) -> Counter[tuple[str, str]]:
    """(stage, file name) -> how often the stage opened the file in a cold run."""
    counts: Counter[tuple[str, str]] = Counter()
    running = [""]

    class CountingFile(pq.ParquetFile):  # type: ignore[misc]
        def __init__(self, source: BinaryIO, **options: Any) -> None:
            counts[running[-1], Path(source.name).name] += 1
            super().__init__(source, **options)

    monkeypatch.setattr(parquet.pq, "ParquetFile", CountingFile)
    egvs.run(scenario, out, jobs=1, listener=lambda stage, *_: running.append(stage))
    return counts


@pytest.mark.slow
def test_stage_opens_each_artefact_once(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opens = count_opens(egvs.load(mini, SETTINGS), tmp_path / "out", monkeypatch)
    assert opens.keys() >= {
        ("tpog", RunFolder.trajectories.name),
        ("score", RunFolder.tpog.name),
        ("score", RunFolder.trajectories.name),
        ("score", RunFolder.scans.name),
        ("report", RunFolder.scores.name),
    }
    assert {key: count for key, count in opens.items() if count > 1} == {}


def test_shared_file_is_opened_again_when_it_was_replaced(tmp_path: Path) -> None:
    path = tmp_path / "trajectories.parquet"
    with parquet.share_open_files():
        for frames in (3, 5):
            columns = {column.name: [] for column in parquet.arrow_schema("trajectories")}
            parquet.write_artefact(path, "trajectories", columns, {"schema": parquet.SCHEMA_VERSION, "frames": frames})
            assert parquet.read_metadata(path, "trajectories")["frames"] == frames
