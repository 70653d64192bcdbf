"""Redrawn departures of a user's demand."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, parse

import numpy as np
import pytest

from egvs.traffic import departures
from egvs.traffic.departures import DepartureCounts


def write_demand(folder: Path, *lines: str, root: str = "routes") -> Path:
    path = folder / "d.rou.xml"
    path.write_text(f"<{root}>{''.join(lines)}</{root}>")
    return path


def redraw(path: Path, seed: int = 1) -> tuple[DepartureCounts, list[Element]]:
    counts = departures.redraw_departures(path, np.random.default_rng(seed))
    return counts, list(parse(path).getroot())


def times_of(elements: list[Element]) -> dict[str, float]:
    return {e.attrib["id"]: float(e.attrib["depart"]) for e in elements if e.tag in ("vehicle", "trip")}


def test_vehicles_depart_within_the_same_five_minutes_in_order(tmp_path: Path) -> None:
    lines = ["<route id='r' edges='a b'/>", *(f"<vehicle id='{k}' route='r' depart='{10 * k}'/>" for k in range(100))]
    counts, elements = redraw(write_demand(tmp_path, *lines))
    times_s = times_of(elements)
    assert counts == DepartureCounts(100, 0) and elements[0].tag == "route"
    assert list(times_s.values()) == sorted(times_s.values())
    assert all(int(times_s[str(k)] // 300) == 10 * k // 300 for k in range(90))
    assert max(times_s.values()) <= 990.0  # the last departure of the file
    assert sum(abs(times_s[str(k)] - 10 * k) > 5 for k in range(100)) > 80


def test_another_seed_gives_other_departures_and_the_same_seed_the_same(tmp_path: Path) -> None:
    lines = [f"<trip id='{k}' from='a' to='b' depart='{k}'/>" for k in range(20)]
    results = [times_of(redraw(write_demand(tmp_path, *lines), seed)[1]) for seed in (1, 1, 2)]
    assert results[0] == results[1] != results[2]


@pytest.mark.parametrize(
    ("flow", "expected"),
    [
        ("end='600' vehsPerHour='360'", {"end": "600", "period": "exp(0.1)"}),
        ("end='600' period='10'", {"end": "600", "period": "exp(0.1)"}),
        ("begin='100' end='200' number='20'", {"begin": "100", "end": "200", "period": "exp(0.2)"}),
        ("number='20' period='4'", {"number": "20", "period": "exp(0.25)"}),
        ("begin='0:01:00' end='0:02:00' number='30'", {"begin": "0:01:00", "end": "0:02:00", "period": "exp(0.5)"}),
        ("end='600' probability='0.1'", {"end": "600", "probability": "0.1"}),
        ("end='600' period='exp(0.3)'", {"end": "600", "period": "exp(0.3)"}),
    ],
)
def test_flows_become_poisson_processes_of_the_same_rate(tmp_path: Path, flow: str, expected: dict[str, str]) -> None:
    counts, (element,) = redraw(write_demand(tmp_path, f"<flow id='f' from='a' to='b' {flow}/>"))
    assert counts == DepartureCounts(1, 0)
    assert {key: value for key, value in element.attrib.items() if key not in ("id", "from", "to")} == expected


def test_what_cannot_be_redrawn_is_counted_and_unchanged(tmp_path: Path) -> None:
    lines = [
        "<vehicle id='t' depart='triggered'/>",
        "<calibrator id='c'><flow id='f' begin='0' end='9' vehsPerHour='9'/></calibrator>",
        "<vehicle id='v' depart='7'/>",
    ]
    path = write_demand(tmp_path, *lines)
    assert departures.count_departures([path]) == DepartureCounts(1, 2)
    counts, elements = redraw(path)
    assert counts == DepartureCounts(1, 2)
    assert elements[0].attrib["depart"] == "triggered" and elements[1][0].attrib["vehsPerHour"] == "9"
    assert times_of([elements[2]]) == {"v": 7.0}  # the only departure spans no time


def test_file_without_departures_is_not_changed(tmp_path: Path) -> None:
    path = write_demand(tmp_path, "<!-- signals --><tlLogic id='t'/>", root="additional")
    before = path.read_bytes()
    assert departures.redraw_departures(path, np.random.default_rng(1)) == DepartureCounts()
    assert path.read_bytes() == before
