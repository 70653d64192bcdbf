"""The example of docs/tracks.md gives the boxes that the page states, and the page names every format and key."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

from egvs.core import readers
from egvs.extensions.tracks import sources as track_readers
from egvs.extensions.tracks import user_table
from egvs.extensions.tracks.model import TrackFrame
from egvs.scenario.track_columns import TrackColumns
from tests.extensions.tracks.hand import assert_boxes

PAGE = (Path(__file__).parents[3] / "docs" / "tracks.md").read_text(encoding="utf-8")
NAN = math.nan


def test_mapping_of_the_page(tmp_path: Path) -> None:
    blocks = dict(re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```$', PAGE, re.DOTALL | re.MULTILINE))
    (tmp_path / "tracks.csv").write_text(blocks["tracks.csv"])
    mapping = TrackColumns.from_dict(tomllib.loads(blocks["scenario.toml"])["traffic"]["track_columns"])
    tracks = user_table.read(tmp_path / "tracks.csv", mapping)
    assert tracks.frame == TrackFrame("EPSG:25832")
    assert_boxes(tracks, [("17", "car", 0, 293537.1, 5629680.8, NAN, -1.5708, 4.6, 1.9, NAN),
                          ("17", "car", 0.04, 293537.1, 5629680.4, NAN, -1.5708, 4.6, 1.9, NAN),
                          ("18", "pedestrian", 0.04, 293547.1, 5629691.6, NAN, 1.5708, NAN, NAN, NAN)])  # fmt: skip


def test_page_names_all_formats_and_keys() -> None:
    for reader in readers.list_readers(track_readers.KIND):
        assert all(word in PAGE for word in re.findall(r"[\w-]{3,}", reader.name)), reader.name
    for key in TrackColumns.model_fields:
        assert f"`{key}`" in PAGE, key
