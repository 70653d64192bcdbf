r"""Redraw the departures of a user's demand, so that another seed gives other traffic.

SUMO starts a vehicle with a fixed departure at the same time with any seed. :func:`redraw_departures` changes a copy of
a demand file:

- A vehicle, trip, person or container starts at a random time within the same :data:`INTERVAL_S`, and within the time
  that the departures of the file span. So the profile of the demand over the day stays.
- A flow at regular intervals becomes a Poisson process of the same rate, ``period="exp(rate)"``, which SUMO draws with
  its seed.

What starts with another vehicle or person (``depart="triggered"``), and what a calibrator inserts, stays unchanged.
Times are seconds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, tostring
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core import files
from egvs.formats import xml

INTERVAL_S = 300.0
"""Longer than two signal cycles, so that vehicles meet others; shorter than the rise of a peak hour."""

_SINGLE_TAGS = frozenset({"vehicle", "trip", "person", "container"})
_FLOW_TAGS = frozenset({"flow", "personFlow", "containerFlow"})
_HOURLY_KEYS = ("vehsPerHour", "perHour", "personsPerHour", "containersPerHour")
_CLOCK_TIME = re.compile(r"(?:(\d+):)?(\d+):(\d+):(\d+(?:\.\d+)?)")
"""SUMO's times of day: hours, minutes and seconds, with or without days."""


@dataclass(frozen=True)
class DepartureCounts:
    """Number of vehicles and flows with departures that can be redrawn, and of the others."""

    redrawn: int = 0
    fixed: int = 0

    def __add__(self, other: DepartureCounts) -> DepartureCounts:
        return DepartureCounts(self.redrawn + other.redrawn, self.fixed + other.fixed)


def count_departures(paths: Iterable[Path]) -> DepartureCounts:
    """Count the departures in demand files that can and cannot be redrawn.

    Raises
    ------
    InputError
        When a file is not well-formed.
    """
    counts = DepartureCounts()
    for path in paths:
        for child in xml.iter_elements(path, ""):
            counts += _count_element(child)
    return counts


def redraw_departures(path: Path, rng: np.random.Generator) -> DepartureCounts:
    """Redraw the departures in a copy of a demand file.

    Parameters
    ----------
    path
        The copy; it is changed.
    rng
        Random numbers.

    Returns
    -------
    DepartureCounts
        What was redrawn, and what was not. A file without departures is not changed.

    Raises
    ------
    InputError
        When the file is not well-formed.
    """
    departures_s = [_depart_s(child) for child in xml.iter_elements(path, "") if child.tag in _SINGLE_TAGS]
    known_s = [time_s for time_s in departures_s if time_s is not None]
    span_s = (min(known_s), max(known_s)) if known_s else (0.0, 0.0)

    root = ""

    def open_root(element: Element) -> None:
        nonlocal root
        attributes = "".join(f" {key}={quoteattr(value)}" for key, value in element.attrib.items() if "}" not in key)
        root = f"<{element.tag}{attributes}>\n"

    counts = DepartureCounts()
    texts: list[tuple[float, str]] = []
    for child in xml.iter_elements(path, "", on_root=open_root):
        counts += _count_element(child)
        start_s = _redraw_element(child, span_s, rng)
        texts.append((start_s, tostring(child, encoding="unicode").rstrip() + "\n"))
    if not counts.redrawn:
        return counts

    texts.sort(key=lambda pair: pair[0])  # SUMO requires the order of departures; what has none comes first
    end = f"</{root[1:].split(None, 1)[0].rstrip('>')}>\n"
    files.write_text(path, root + "".join(text for _, text in texts) + end)
    return counts


def _count_element(element: Element) -> DepartureCounts:
    """Count the departures of a child of the root, and of those within it."""
    if element.tag in _SINGLE_TAGS:
        return DepartureCounts(1, 0) if _depart_s(element) is not None else DepartureCounts(0, 1)
    if element.tag in _FLOW_TAGS:
        is_random = "probability" in element.attrib or element.get("period", "").startswith("exp")
        return DepartureCounts(1, 0) if is_random or _rate_per_s(element) is not None else DepartureCounts(0, 1)
    nested = sum(inner.tag in _SINGLE_TAGS | _FLOW_TAGS for inner in element.iter())
    return DepartureCounts(0, nested)


def _redraw_element(element: Element, span_s: tuple[float, float], rng: np.random.Generator) -> float:
    """Change the departure of a child of the root; return its new time, or -inf if it has none."""
    if element.tag in _SINGLE_TAGS:
        depart_s = _depart_s(element)
        if depart_s is None:
            return -math.inf
        interval = math.floor(depart_s / INTERVAL_S)
        low_s = max(interval * INTERVAL_S, span_s[0])
        high_s = min((interval + 1) * INTERVAL_S, span_s[1])
        start_s = round(float(rng.uniform(low_s, max(low_s, high_s))), 3)
        element.set("depart", f"{start_s:.3f}")
        return start_s
    if element.tag in _FLOW_TAGS:
        rate_per_s = _rate_per_s(element)
        if rate_per_s is not None:
            for key in _HOURLY_KEYS:
                element.attrib.pop(key, None)
            if "end" in element.attrib:
                element.attrib.pop("number", None)  # SUMO accepts two of end, number and period
            element.set("period", f"exp({rate_per_s:.9g})")
        return parse_time_s(element.get("begin", "0")) or 0.0
    return -math.inf


def _depart_s(element: Element) -> float | None:
    return parse_time_s(element.get("depart", ""))


def _rate_per_s(flow: Element) -> float | None:
    """Return the rate of a flow at regular intervals; None if it is random, or not known."""
    for key in _HOURLY_KEYS:
        if key in flow.attrib:
            per_hour = _parse_positive(flow.attrib[key])
            return None if per_hour is None else per_hour / 3600.0
    if "period" in flow.attrib:
        period_s = _parse_positive(flow.attrib["period"])
        return None if period_s is None else 1.0 / period_s
    number = _parse_positive(flow.get("number", ""))
    begin_s, end_s = parse_time_s(flow.get("begin", "0")), parse_time_s(flow.get("end", ""))
    if "probability" in flow.attrib or number is None or begin_s is None or end_s is None or end_s <= begin_s:
        return None
    return number / (end_s - begin_s)


def _parse_positive(text: str) -> float | None:
    value = parse_time_s(text)
    return value if value else None


def parse_time_s(text: str) -> float | None:
    """Return a time of SUMO in seconds; None for a word such as "triggered".

    >>> parse_time_s("90.5"), parse_time_s("1:00:30"), parse_time_s("triggered")
    (90.5, 3630.0, None)
    """
    if match := _CLOCK_TIME.fullmatch(text.strip()):
        days, hours, minutes, seconds = match.groups()
        return ((int(days or 0) * 24 + int(hours)) * 60 + int(minutes)) * 60 + float(seconds)
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 <= value < math.inf else None
