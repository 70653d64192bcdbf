"""Where vehicles are missed, as the report and the terminal say it: sentences by hand, and the page of a small run."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from egvs.artefacts import readers
from egvs.artefacts.readers import MAX_LOCATIONS, LocationVisibility, SiteBlindspots
from egvs.report import colours, figures, maps
from tests.report.test_report import Reader, decoded, finished, page

NAN = float("nan")


def place(by: str, words: str, frames: int, vehicles: int, share: float, se: float = 0.05) -> LocationVisibility:
    return LocationVisibility(by, words, 10.0, 20.0, frames, vehicles, share, se)


ALL = place("all", "all vehicles", 1000, 80, 0.875)
LEFT = place("lane", "eastbound left-turn lane", 120, 12, 0.41, 0.08)
TURN = place("turn", "eastbound left turn in the junction", 30, 11, 0.5)
CROSSING = place("crossing", "pedestrian crossing on the east side of the junction", 30, 10, 0.5)
APPROACH = place("approach", "eastbound approach", 400, 30, 0.63)
FEW = place("lane", "northbound lane", 90, 9, 0.0)
GOOD = place("lane", "westbound lane", 90, 40, 0.875)


def site(places: Sequence[LocationVisibility], share: object = ((0.0, NAN), (0.25, 1.0))) -> SiteBlindspots:
    return SiteBlindspots("p1", 20.0, tuple(places), np.array(share), (0.0, 0.0), 1.0)


def test_the_worst_come_first_and_few_vehicles_are_not_spoken_of() -> None:
    its = site([ALL, APPROACH, GOOD, FEW, CROSSING, TURN, LEFT])
    assert its.worst == [LEFT, TURN, CROSSING]
    assert figures.describe_worst_locations(its)[0] == (
        "eastbound left-turn lane: 41 % seen",
        "± 8 %, from 12 vehicles looked at 120 times",
    )
    assert figures.format_missed_share(its) == "12.5%"
    assert figures.blindspot_note(its) == "Whole approaches, seen: eastbound approach: 63 %."
    assert its.in_words() == (
        "p1 misses 12.5% of the vehicles (fewer than 20 points); worst: eastbound left-turn lane, 41% seen; "
        "eastbound left turn in the junction, 50% seen"
    )


def test_a_handful_is_listed() -> None:
    its = site([ALL, *(place("lane", f"lane {i}", 100 + i, 20, 0.1) for i in range(9))])
    assert [found.words for found in its.worst] == [f"lane {i}" for i in (8, 7, 6, 5, 4)]


@pytest.mark.parametrize(
    ("places", "said"),
    [
        ([], "No vehicle in the region."),
        ([ALL], "Without one network of roads for all the traffic there are no lanes to name: the map alone tells."),
        ([ALL, GOOD], "No lane, turn or crossing with 10 vehicles or more is seen worse than the rest."),
        ([ALL, LEFT, place("no lane", "on no lane", 1, 1, 1.0)], "Of 1,000 vehicles looked at, 1 was on no lane."),
        ([ALL, LEFT, place("no lane", "on no lane", 7, 2, 1.0)], "Of 1,000 vehicles looked at, 7 were on no lane."),
    ],
)
def test_what_the_list_does_not_say(places: list[LocationVisibility], said: str) -> None:
    assert figures.blindspot_note(site(places)) == said


def test_without_vehicles_nothing_is_missed() -> None:
    assert figures.format_missed_share(site([])) == "–" and site([]).worst == []
    assert site([]).in_words() == "no vehicle in the region of interest, so none that p1 misses"


def test_shares_have_an_even_scale_and_nobody_has_no_colour() -> None:
    image = decoded(colours.share_image(np.array([[0.0, NAN], [0.5, 1.0]])).uri(colours.SHARE_PALETTES["day"]))
    assert image.tolist() == [[0, 254], [1, 127]]  # the north first


def test_numbers_stand_where_the_vehicles_were() -> None:
    plan = maps.site_view_frame((0.0, 0.0, 40.0, 40.0))
    at = maps.label_positions(plan, site([ALL, LEFT]))
    assert at == [(round(plan.x(10.0), 1), round(plan.y(20.0), 1)), *[None] * (MAX_LOCATIONS - 1)]


def test_the_page_shows_each_site_and_the_data_of_all(tmp_path: Path) -> None:
    about, out = finished(tmp_path)
    text = page(about, out)
    read = Reader(text)
    assert read.text.count("Where vehicles are missed:") == 2
    assert (
        read.text.count("Without one network of roads for all the traffic there are no lanes to name") == 2 + 4
    )  # panels, and data
    data = json.loads(re.search(r'id="site-data">(.*?)</script>', text, re.DOTALL)[1])  # type: ignore[index]
    for name, its in data["sites"].items():
        (found,) = readers.read_blindspots(out / "blindspots.parquet", {name})
        assert found.overall is not None and found.overall.vehicle_frames == 40 + 33  # the second drives out
        assert its["vehicles"]["missed"] == f"{1 - found.overall.share:.1%}"
        assert its["vehicles"]["numbers"] == [None] * MAX_LOCATIONS
    assert any(f"misses {its['vehicles']['missed']} of the vehicles" in text for its in data["sites"].values())
