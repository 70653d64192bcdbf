"""Are peers compared beam by beam and voxel by voxel, and left out by name where they are missing?"""

from __future__ import annotations

import csv
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import peers
from benchmarks.peers import SiteBeams

from tests.conftest import write_mini


def beams(ends_m: list[tuple[float, float, float]], returned: list[bool]) -> SiteBeams:
    ends = np.array(ends_m)
    return SiteBeams(np.zeros(3), ends / np.linalg.norm(ends, axis=1)[:, None], 50.0, ends, np.array(returned))


def test_a_beam_differs_by_its_range_or_by_hit_and_miss() -> None:
    site = beams([(10.0, 0.0, 0.0), (0.0, 20.0, 0.0), (0.0, 0.0, 50.0), (50.0, 0.0, 0.0)], [True, True, False, False])
    same = np.array([10.0005, 20.0, np.inf, 60.0])  # beyond the range nothing is hit
    assert peers.differing_ranges(same, site) == 0
    assert peers.differing_ranges(np.array([10.002, 20.0, np.inf, np.inf]), site) == 1
    assert peers.differing_ranges(np.array([10.0, np.inf, 30.0, np.inf]), site) == 2
    assert peers.differing_ranges(np.full(4, np.inf), site) == 2


def test_a_voxel_differs_by_its_count_or_by_whether_it_is_crossed() -> None:
    ours = np.array([0, 1, 2, 0], dtype=np.uint32)
    assert peers.differing_voxels(np.array([0, 1, 2, 0], dtype=np.int32), ours) == 0
    assert peers.differing_voxels(np.array([0, 2, 1, 0], dtype=np.int32), ours) == 2
    assert peers.differing_voxels(np.array([False, True, True, False]), ours) == 0
    assert peers.differing_voxels(np.array([True, True, False, False]), ours) == 2


def test_peers_that_are_missing_are_left_out_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "CASTS", {"nobody's": ("no_such_module_anywhere", peers.open3d_cast)})
    monkeypatch.setattr(peers, "COUNTS", {"octomap": ("no_such_module_anywhere", peers.octomap_count)})
    table = peers.rows(peers.Junction.load(write_mini(tmp_path / "mini"), sites=1), repeats=1)
    assert [row[:2] for row in table] == [
        ("cast: ours", "1 x"),
        ("cast: nobody's", "left out"),
        ("traversal: ours", "1 x"),
        ("traversal: octomap", "left out"),
    ]
    assert table[1][2] == "not installed; try pip install no_such_module_anywhere"


def test_written_table_has_each_row_with_its_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    junction = peers.Junction.load(write_mini(tmp_path / "mini"), sites=1)
    monkeypatch.setattr(peers, "CASTS", {"embreex": peers.CASTS["embreex, one ray at a time"]})
    monkeypatch.setattr(peers, "COUNTS", {})
    monkeypatch.setattr(peers.Junction, "load", lambda: junction)
    peers.main(["--csv", str(tmp_path / "peers.csv")])
    with (tmp_path / "peers.csv").open(encoding="utf-8", newline="") as file:
        heading, *table = csv.reader(file)
    assert tuple(heading) == peers.HEADINGS
    assert [row[0] for row in table] == [
        "cast: ours",
        f"cast: embreex, embreex {version('embreex')}",
        "traversal: ours",
    ]
    assert float(table[1][1].removesuffix(" x")) > 0


def test_embree_hits_what_we_hit(tmp_path: Path) -> None:
    junction = peers.Junction.load(write_mini(tmp_path / "mini"), sites=1)
    site = junction.sites[0]
    assert site.returned.any()
    ours = peers.our_cast(junction)(site)
    assert peers.differing_ranges(ours, site) == 0
    assert peers.differing_ranges(peers.embreex_cast(junction)(site), site) <= 0.001 * len(ours)


def test_what_takes_longer_takes_longer() -> None:
    seconds = peers.smallest_seconds(
        {"short": lambda: sum(range(10)), "long": lambda: sum(range(1_000_000))}, repeats=2
    )
    assert 0.0 <= seconds["short"] < seconds["long"]


@pytest.mark.system  # taichi starts a process
@pytest.mark.parametrize(("module", "make"), list(peers.COUNTS.values()))
def test_a_traversal_of_a_peer_is_nearly_ours(tmp_path: Path, module: str, make: Any) -> None:
    pytest.importorskip(module, reason=f"{module} is a peer of make bench-peers, which nothing else needs")
    junction = peers.Junction.load(write_mini(tmp_path / "mini"), sites=1)
    result = make(junction)(junction.sites[0])
    if callable(result):
        result = result()
    ours = junction.count_hits(junction.sites[0])
    assert peers.differing_voxels(result, ours) < 0.01 * (ours > 0).sum()


def test_a_cast_of_open3d_is_nearly_ours(tmp_path: Path) -> None:
    pytest.importorskip("open3d", reason="open3d is a peer of make bench-peers", exc_type=ImportError)
    junction = peers.Junction.load(write_mini(tmp_path / "mini"), sites=1)
    ranges = peers.open3d_cast(junction)(junction.sites[0])
    assert peers.differing_ranges(ranges, junction.sites[0]) < 0.01 * len(ranges)
