"""Rules for the region of interest: lanes lead through it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.checks.subject import Subject
from pipeline.core.findings import Finding
from pipeline.world import limits


def lanes(subject: Subject) -> Iterator[Finding]:
    """An error where no lane leads through the region, or all lie above or below it."""
    if subject.network is None:
        return
    box = subject.scenario.roi.box
    low_m, high_m = np.asarray(box.origin_m), np.add(box.origin_m, box.size_m)
    place, cure = f"{subject.scenario.file}: roi", "a region over the network's roads, in the network's coordinates"
    if subject.carriageway is None:
        yield Finding("region", place, "the network has no lane for vehicles of the road", cure, is_error=True)
        return
    if (far_m := subject.carriageway.distance_m(low_m.tolist(), high_m.tolist())) > 0:
        (x0, y0), (x1, y1) = subject.carriageway.bounds_m
        extent = f"lanes reach from ({x0:.0f}, {y0:.0f}) to ({x1:.0f}, {y1:.0f})"
        what = f"no lane leads through it: the nearest is {far_m:,.1f} m away, {extent}"
        yield Finding("region", place, what, cure, is_error=True)
        return
    at_m = (low_m + high_m)[:2] / 2.0
    lane = subject.carriageway.nearest(at_m)
    road_m = subject.carriageway.height_m(lane, at_m)
    if road_m > high_m[2] or road_m + limits.CLEARANCE_M < low_m[2]:
        what = f"reaches from z = {low_m[2]:g} to {high_m[2]:g} m, but the road there lies at z = {road_m:.1f} m"
        yield Finding("region", place, what, "a center_m that holds the traffic", is_error=True)
