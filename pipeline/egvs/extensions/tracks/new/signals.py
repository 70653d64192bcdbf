"""Recorded states of traffic lights, and which connections of a map each signal group governs.

Formats, told apart by their columns or root element:

- states of TAF-BW: ``signal_group_id``, ``timestamp_ms``, ``movement_state`` (SAE J2735), one row per group and time;
- states of SinD: ``timestamp(ms)`` and a column for each light with 0 (red), 1 (green) or 3 (yellow); changes only;
- groups as KML, as TAF-BW writes MAP messages: lanes with ``Source``, ``Sink`` and the ``SignalGroup`` of each sink;
- groups as CSV: ``group``, ``from_edge`` and ``to_edge``, with ids of the network's edges; an empty ``to_edge`` is all.

Names of groups (in SinD: of columns) are compared in lower case.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from xml.etree.ElementTree import Element

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.tracks import columns
from egvs.formats import xml

RED, RED_YELLOW, GREEN, YELLOW, DARK = "r", "u", "G", "y", "O"
"""States, in SUMO's letters."""

_J2735 = {
    "UNAVAILABLE": DARK, "DARK": DARK, "STOP_THEN_PROCEED": RED, "STOP_AND_REMAIN": RED, "PRE_MOVEMENT": RED_YELLOW,
    "PERMISSIVE_MOVEMENT_ALLOWED": GREEN, "PROTECTED_MOVEMENT_ALLOWED": GREEN, "PERMISSIVE_CLEARANCE": YELLOW,
    "PROTECTED_CLEARANCE": YELLOW, "CAUTION_CONFLICTING_TRAFFIC": DARK,
}  # fmt: skip
_SIND = {"0": RED, "1": GREEN, "3": YELLOW}
_TAF_BW = ("signal_group_id", "timestamp_ms", "movement_state")
_SIND_TIME = "timestamp(ms)"
_KML = "{http://www.opengis.net/kml/2.2}"
_HINT = "Give the recorded states (TAF-BW or SinD) and a file that assigns the groups (KML or CSV)."


@dataclass(frozen=True, eq=False)
class SignalRecord:
    """The states of one signal group.

    Attributes
    ----------
    starts_s
        When each state begins, (n,), ascending; the first is the beginning of the recording of this group.
    states
        The states, n letters; neighbours differ.
    end_s
        End of the recording.
    """

    starts_s: FloatArray
    states: tuple[str, ...]
    end_s: float

    @property
    def green_starts_s(self) -> list[float]:
        """When green begins, without the green at the beginning of the recording."""
        later = zip(self.starts_s.tolist()[1:], self.states[1:], strict=True)
        return [start_s for start_s, state in later if state == GREEN]

    @property
    def green_durations_s(self) -> list[float]:
        """Durations of complete greens."""
        ends_s = self.starts_s[1:].tolist()
        spans = list(zip(self.starts_s.tolist(), ends_s, self.states, strict=False))[1:]
        return [end_s - start_s for start_s, end_s, state in spans if state == GREEN]

    @property
    def is_lit(self) -> bool:
        """Whether it ever shows something else than dark."""
        return set(self.states) != {DARK}

    def state_at(self, time_s: float) -> str:
        """Return the state at a time."""
        return self.states[max(int(np.searchsorted(self.starts_s, time_s + 1e-9, side="right")) - 1, 0)]


@dataclass(frozen=True, eq=False)
class GroupOfWay:
    """A way from one lane of a map to another, and the signal group that governs it: lines (n, 2) in degrees."""

    group: str
    source_deg: FloatArray
    sink_deg: FloatArray


@dataclass(frozen=True)
class GroupOfEdges:
    """Edges of the network, and the signal group that governs the connections between them; "" for any target."""

    group: str
    from_edge: str
    to_edge: str

    COLUMNS: ClassVar = ("group", "from_edge", "to_edge")
    """Columns of a CSV file with such rows."""


@dataclass(frozen=True, eq=False)
class RecordedSignals:
    """States by signal group, and what the groups govern; nothing, where no file says so."""

    records: dict[str, SignalRecord]
    ways: tuple[GroupOfWay, ...]
    edges: tuple[GroupOfEdges, ...]


def read_signals(paths: Sequence[Path]) -> RecordedSignals:
    """Read recorded states, and the files that assign signal groups.

    Parameters
    ----------
    paths
        The files, in any order.

    Raises
    ------
    InputError
        When a file does not exist, is damaged or of an unknown format, or no file has states.
    """
    records: dict[str, SignalRecord] = {}
    ways: list[GroupOfWay] = []
    edges: list[GroupOfEdges] = []
    for path in paths:
        head = _head(path)
        names = columns.header(head)
        if b"<kml" in head:
            ways += _read_kml(path)
        elif set(_TAF_BW) <= set(names):
            records |= _read_taf_bw(path)
        elif _SIND_TIME in names:
            records |= _read_sind(path, [name for name in names if "light" in name.lower()])
        elif set(GroupOfEdges.COLUMNS) <= set(names):
            table = columns.read_table(path, GroupOfEdges.COLUMNS)
            rows = zip(*(table.texts(name) for name in GroupOfEdges.COLUMNS), strict=True)
            edges += [GroupOfEdges(group.lower(), start, end) for group, start, end in rows]
        else:
            raise InputError(path, "neither recorded states of signals nor an assignment of signal groups", _HINT)
    if not records:
        raise InputError(", ".join(map(str, paths)), "no file has recorded states of signals", _HINT)
    return RecordedSignals(records, tuple(ways), tuple(edges))


def _head(path: Path) -> bytes:
    with xml.open_bounded(path) as file:
        return file.read(4096)


def _read_taf_bw(path: Path) -> dict[str, SignalRecord]:
    table = columns.read_table(path, _TAF_BW)
    names, time_s = np.array([text.lower() for text in table.texts(_TAF_BW[0])]), table.times_s(_TAF_BW[1], 1e-3)
    states = []
    for row, text in enumerate(table.texts(_TAF_BW[2])):
        if text.upper() not in _J2735:
            raise table.error(row, _TAF_BW[2], f"expected a state such as STOP_AND_REMAIN, got {text[:40]!r}")
        states.append(_J2735[text.upper()])
    letters = np.array(states)
    return {str(name): _record(time_s[names == name], letters[names == name]) for name in np.unique(names)}


def _read_sind(path: Path, lights: Sequence[str]) -> dict[str, SignalRecord]:
    table = columns.read_table(path, (_SIND_TIME, *lights))
    time_s = table.optional_numbers(_SIND_TIME) / 1000.0
    known = np.isfinite(time_s)  # the first row of some recordings has no time
    if not known.any():
        raise InputError(path, "no row has a time", "Use the file as it was published.")
    records = {}
    for light in lights:
        letters = []
        for row, text in enumerate(table.texts(light)):
            if text not in _SIND:
                raise table.error(row, light, f"expected 0, 1 or 3, got {text[:40]!r}")
            letters.append(_SIND[text])
        records[light] = _record(time_s[known], np.array(letters)[known])
    return records


def _record(time_s: FloatArray, letters: np.ndarray[tuple[int, ...], np.dtype[np.str_]]) -> SignalRecord:
    order = np.argsort(time_s, kind="stable")
    time_s, letters = time_s[order], letters[order]
    changes = np.append(True, letters[1:] != letters[:-1])
    return SignalRecord(time_s[changes], tuple(letters[changes].tolist()), float(time_s[-1]))


def _read_kml(path: Path) -> Iterator[GroupOfWay]:
    """Yield the ways of a KML file."""
    lines: dict[str, FloatArray] = {}
    ways: list[tuple[str, str, str]] = []
    for child in xml.iter_elements(path, _tag("kml")):
        for placemark in child.iter(_tag("Placemark")):
            values = {data.get("name", ""): _text(data, "value") for data in placemark.iter(_tag("Data"))}
            if "Source" not in values:
                continue
            lines[values["Source"]] = _coordinates(placemark, path)
            groups = [part.strip().lower() for part in values.get("SignalGroup", "").split(",")]
            sinks = [part.strip() for part in values.get("Sink", "").split(",")]
            ways += [(values["Source"], *pair) for pair in zip(sinks, groups, strict=False) if all(pair)]
    for source, sink, group in ways:
        if sink not in lines:
            raise InputError(path, f"lane {source} leads to lane {sink[:40]!r}, which is missing", _HINT)
        yield GroupOfWay(group, lines[source], lines[sink])


def _tag(name: str) -> str:
    return f"{_KML}{name}"


def _text(element: Element, name: str) -> str:
    return (element.findtext(_tag(name)) or "").strip()


def _coordinates(placemark: Element, path: Path) -> FloatArray:
    """Return longitude and latitude of a line, (n, 2)."""
    texts = [(line.text or "").split() for line in placemark.iter(_tag("coordinates"))]
    try:
        points = [[float(number) for number in point.split(",")[:2]] for point in texts[0]]
        lon_lat_deg = np.array(points, dtype=np.float64).reshape(-1, 2)
    except (ValueError, IndexError):
        lon_lat_deg = np.empty((0, 2))
    if not len(lon_lat_deg) or not (np.abs(lon_lat_deg) <= (180.0, 90.0)).all():
        raise InputError(path, "a lane has no valid coordinates", "Use the file as it was published.")
    return lon_lat_deg
