"""Rules for the region of interest: lanes lead through it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from pipeline.checks.subject import Refusals, Subject
from pipeline.core.findings import Finding
from pipeline.traffic import sumo_folder
from pipeline.world import limits, world_frame
from pipeline.world.carriageway import Carriageway


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


def of_periods(subject: Subject) -> Iterator[Finding]:
    """An error for each period with a network of its own that has no lane in the region, or another zero than the
    first period's: its vehicles would drive elsewhere.
    """
    scenario, refusals = subject.scenario, Refusals()
    for period, alone in scenario.by_period().items():
        roads = refusals.unless_refused("network", partial(sumo_folder.roads, alone)) if period else None
        if roads is None or roads is subject.network:
            continue
        place, box = f"{scenario.file}: traffic.periods ({period})", scenario.roi.box
        first, own = (world_frame.located(None if n is None else n.location) for n in (subject.network, roads))
        if first is not None and own is not None and first != own:
            offsets = f"netOffset {list(own.offset_m)}, not {list(first.offset_m)}"
            what = f"its network has another zero or projection than that of the first period ({offsets})"
            cure = "networks of one extract and one projection, so that all periods share a world frame"
            yield Finding("region", place, what, cure, is_error=True)
        elif (far_m := Carriageway.of(roads).distance_m(box.origin_m, np.add(box.origin_m, box.size_m))) > 0:
            what = f"no lane of its network leads through the region: the nearest is {far_m:,.1f} m away"
            yield Finding("region", place, what, "a network in the coordinates of the others", is_error=True)
    yield from refusals.found
