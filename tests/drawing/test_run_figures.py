"""Views of single sites: the data of each, and its blind spots in words."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from egvs.artefacts import readers
from egvs.artefacts.readers import MAX_LOCATIONS, LocationVisibility, SiteBlindspots, read_scores
from egvs.artefacts.tpog import read_tpog
from egvs.drawing import maps
from egvs.drawing import run_figures as figures
from egvs.runs.run_context import open_folder
from egvs.scoring.egvs import EntropyField
from egvs.scoring.scorer import Scorer
from egvs.stages.site_scoring import empty_scans
from tests.report.small_runs import PageReader, render_report, run_to_scores, site_data

NAN = float("nan")


def place(by: str, words: str, frames: int, vehicles: int, share: float, se: float = 0.05) -> LocationVisibility:
    return LocationVisibility(by, words, 10.0, 20.0, frames, vehicles, share, se)


ALL = place("all", "all vehicles", 1000, 80, 0.875)


LEFT = place("lane", "Mill Lane (west), left-turn lane", 120, 12, 0.41, 0.08)


TURN = place("turn", "Mill Lane (west), left turn in the junction", 30, 11, 0.5)


CROSSING = place("crossing", "east crosswalk", 30, 10, 0.5)


APPROACH = place("approach", "Mill Lane (west) approach", 400, 30, 0.63)


FEW = place("lane", "Mill Lane (south), lane", 90, 9, 0.0)


GOOD = place("lane", "Mill Lane (east), lane", 90, 40, 0.875)


def site(places: Sequence[LocationVisibility], share: object = ((0.0, NAN), (0.25, 1.0))) -> SiteBlindspots:
    return SiteBlindspots("p1", tuple(places), np.array(share), (0.0, 0.0), 1.0)


def test_lists_the_worst_locations_first_and_none_with_few_vehicles() -> None:
    blindspots = site([ALL, APPROACH, GOOD, FEW, CROSSING, TURN, LEFT])
    assert blindspots.worst == [LEFT, TURN, CROSSING]
    assert figures.describe_worst_locations(blindspots)[0] == (
        "Mill Lane (west), left-turn lane: 41 % found",
        "± 8 %, from 12 vehicles in 120 observations",
    )
    assert figures.format_missed_share(blindspots) == "12.5 %"
    assert figures.blindspot_note(blindspots) == "Share of vehicles found on each approach: Mill Lane (west) 63 %."
    assert blindspots.in_words() == (
        "Of all lanes, turns and crossings, p1 finds the smallest shares of vehicles on: "
        "Mill Lane (west), left-turn lane (41 ± 8 % of 12 vehicles found); "
        "Mill Lane (west), left turn in the junction (50 ± 5 % of 11 vehicles found)"
    )


def test_lists_at_most_five_locations() -> None:
    blindspots = site([ALL, *(place("lane", f"lane {i}", 100 + i, 20, 0.1) for i in range(9))])
    assert [location.words for location in blindspots.worst] == [f"lane {i}" for i in (8, 7, 6, 5, 4)]


@pytest.mark.parametrize(
    ("places", "note"),
    [
        ([], "No vehicle in the region."),
        ([ALL], "The traffic does not come from one road network, so there are no lanes to list; see the map."),
        ([ALL, GOOD], "No lane, turn or crossing with 10 vehicles or more is below the average."),
        ([ALL, LEFT, place("no lane", "on no lane", 1, 1, 1.0)], "1 of 1,000 observed vehicles was not on a lane."),
        ([ALL, LEFT, place("no lane", "on no lane", 7, 2, 1.0)], "7 of 1,000 observed vehicles were not on a lane."),
    ],
)
def test_note_on_blind_spots(places: list[LocationVisibility], note: str) -> None:
    assert figures.blindspot_note(site(places)) == note


def test_blind_spots_without_vehicles() -> None:
    assert figures.format_missed_share(site([])) == "–" and site([]).worst == []
    assert site([]).in_words() == "no vehicle in the region of interest, so none that p1 misses"


def test_numbers_are_at_the_mean_position_of_the_vehicles() -> None:
    plan = maps.site_view_frame((0.0, 0.0, 40.0, 40.0))
    at = maps.label_positions(plan, site([ALL, LEFT]))
    assert at == [(round(plan.x(10.0), 1), round(plan.y(20.0), 1)), *[None] * (MAX_LOCATIONS - 1)]


def test_page_has_the_blind_spots_of_each_site(tmp_path: Path) -> None:
    scenario, out = run_to_scores(tmp_path)
    text = render_report(scenario, out)
    read = PageReader(text)
    assert read.text.count("Vehicles not found:") == 2
    assert read.text.count("The traffic does not come from one road network") == 2 + 4  # panels, and data
    data = json.loads(re.search(r'id="site-data">(.*?)</script>', text, re.DOTALL)[1])  # type: ignore[index]
    for name, blindspots in data["sites"].items():
        (actual,) = readers.read_blindspots(out / "blindspots.parquet", {name})
        assert actual.overall is not None and actual.overall.vehicle_frames == 40 + 33  # the second drives out
        assert blindspots["vehicles"]["missed"] == f"{100 * (1 - actual.overall.share):.1f} %"
        assert blindspots["vehicles"]["numbers"] == [None] * MAX_LOCATIONS
    missed = [blindspots["vehicles"]["missed"] for blindspots in data["sites"].values()]
    assert any(f"{share} of the vehicles are not found from" in text for share in missed)


def test_views_agree_with_the_scores(plain_run):
    scenario, out, text = plain_run
    tpog = read_tpog(out / "tpog.parquet")
    field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    rows = {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}
    work = open_folder(scenario, out)
    scorer = Scorer(work.scene, tpog)
    for site_scan in empty_scans(work, ["north", "west"]):
        name, crossed = site_scan.site.name, scorer.hits(site_scan.beams).ravel()[field.cells] > 0
        assert field.per_cell_bit[crossed].sum() / field.per_cell_bit.sum() == pytest.approx(rows[name]["entropy_seen"])
        if rows[name]["rank"] in (1, 4):
            assert f"sees {crossed.sum():,} of {len(crossed):,} uncertain voxels" in text


@pytest.mark.slow
@pytest.mark.parametrize(("count", "is_coarse"), [(40, False), (41, True)])
def test_every_site_can_be_chosen_with_larger_pixels_if_there_are_many(tmp_path, monkeypatch, count, is_coarse):
    monkeypatch.setattr(figures, "_COARSE_PIXELS", 100)
    sites = [(f"g{n:03}", 0.3 * n, -1, 2) for n in range(count)]
    scenario, out = run_to_scores(tmp_path, sites=sites)
    text = render_report(scenario, out)
    actual = site_data(text)["sites"]
    ranked = sorted(read_scores(out / "scores.parquet").to_pylist(), key=lambda row: row["rank"])
    assert sorted(actual) == [name for name, *_ in sites]
    assert ("drawn with larger pixels" in text) == is_coarse
    assert ("6 more sites between these are not listed, but can be chosen below" in text) == is_coarse

    def width(site, kind):
        return int.from_bytes(base64.b64decode(actual[site]["images"][kind][0])[16:20], "big")

    best, second = ranked[0]["site"], ranked[1]["site"]
    assert width(best, "scan") == 300 and width(second, "scan") == (150 if is_coarse else 300)
    assert width(second, "seen") == (width(best, "seen") // 2 if is_coarse else width(best, "seen"))
