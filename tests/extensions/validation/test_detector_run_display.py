"""Progress of detector runs: an estimate of the time that is left only where it was measured in this run."""

from __future__ import annotations

from egvs.core.resource_usage import ResourceUsage
from egvs.extensions.validation.tables import DetectorRunDisplay, PlanRunDisplay


def lines_of(display_class: type[DetectorRunDisplay], sites: list[str], seconds: list[float]) -> list[str]:
    lines: list[str] = []
    display = display_class(lines.append)
    display.begins(dict.fromkeys(sites, ("points", "cluster")), 250, 1)
    for site, site_s in zip(sites, seconds, strict=True):
        display.site_done(site, ["points", "cluster"], ResourceUsage(seconds=site_s))
    return lines


def test_prints_the_time_that_is_left_after_some_sites() -> None:
    lines = lines_of(DetectorRunDisplay, list("abcdef"), [60.0, 12.0, 14.0, 13.0, 13.0, 13.0])
    assert lines[0] == "250 frames from 6 sites, points, cluster, 1 process"
    assert lines[1:3] == ["    60.0 s   a: points, cluster", "    12.0 s   b: points, cluster"]
    assert lines[3] == "    14.0 s   c: points, cluster (about 39 s left for detectors)"
    assert lines[4].endswith("(about 26 s left for detectors)")
    assert "left" not in lines[5] and "left" not in lines[6]


def test_prints_no_estimate_of_a_few_seconds() -> None:
    assert not any("left" in line for line in lines_of(DetectorRunDisplay, list("abcdef"), [9.0] + [1.0] * 5))


def test_groups_of_other_sizes_are_not_estimated() -> None:
    groups = ["a", "a + b", "a + b + c", "a + b + c + d"]
    assert not any("left" in line for line in lines_of(PlanRunDisplay, groups, [30.0, 60.0, 90.0, 120.0]))
