"""The number of rows is limited in every format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.extensions.tracks import user_table
from egvs.extensions.tracks.formats import lumpi, pneuma
from egvs.extensions.tracks.model import Tracks
from tests.extensions.tracks.boxes import moving_boxes
from tests.extensions.tracks.writers import TrackRows, write_lumpi, write_pneuma, write_user_table
from tests.fuzz.read_tracks import MAPPING


def _write_json_lines(folder: Path, rows: TrackRows) -> Path:
    return write_user_table(folder, rows, MAPPING, True)


@pytest.mark.parametrize(
    ("write", "read"),
    [
        (write_pneuma, pneuma.read),
        (write_lumpi, lumpi.read),
        (_write_json_lines, lambda path: user_table.read(path, MAPPING)),
    ],
    ids=["pNEUMA", "LUMPI", "JSON lines"],
)
def test_too_many_rows_get_one_message(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    write: Callable[[Path, TrackRows], Path],
    read: Callable[[Path], Tracks],
) -> None:
    path = write(tmp_path, moving_boxes(["car"], n_frames=5))
    assert read(path).n_rows == 5
    monkeypatch.setenv(limits.ROWS.name, "4")
    with pytest.raises(InputError, match="EGVS_MAX_ROWS") as error:
        read(path)
    assert str(path) in str(error.value)
