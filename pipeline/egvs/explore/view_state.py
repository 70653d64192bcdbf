"""What the explorer's page shows, as a value and as a link; poses saved to a file of sites.

A link has the form of the query of a web address, ``site=c03&pose=190,255,4.5,0,0,0``: world frame, metres and degrees.
Values that are the same as when the page was opened are left out.

Saved poses are rows of a file in the scenario's folder that ``sites.file`` can name. A file of that name that the
explorer did not write is never changed. Explorers that save at the same time wait for each other.
"""

from __future__ import annotations

import csv
import io
import math
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TypeVar
from urllib.parse import parse_qsl, urlencode

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import Vec3
from egvs.effects import registry
from egvs.explore.session import Session
from egvs.explore.settings import Settings
from egvs.runs import locks
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.sensors.sites import Pose, Site

SAVED_SITES = "kept_sites.csv"
"""Name of the file in the scenario's folder."""

_COLUMNS = ("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor")

LAYERS = {
    "none": "none",
    "traffic": "traffic (TPOG)",
    "seen": "entropy seen",
    "missed": "entropy missed",
    "blindspots": "vehicles missed",
    "points_car": "points on a car",
    "points_pedestrian": "points on a pedestrian",
    "overlap_car": "sensors of the plan on a car",
    "overlap_pedestrian": "sensors of the plan on a pedestrian",
    "difference": "compare with another site",
    "scan": "empty scan",
    "ring": "beams of one ring",
    "replay": "recorded traffic",
}
"""Layers over the scene: name in a link, and on the page."""

FIRST_LAYER = "traffic"
"""The layer of a page that is opened without a link."""

T = TypeVar("T")
D = TypeVar("D")
_POSE_PARTS = ("x", "y", "z", "yaw", "pitch", "roll")
_WHOLE_NUMBER = "a whole number of at least 0"
_MAX_PITCH_DEG = 90.0
_SAVE_LOCK = threading.Lock()
"""Between the threads of the page; not every system's file locks separate the threads of a process."""


def save_pose(path: Path, site: Site, candidates: Collection[str]) -> str:
    """Add a pose to a file of saved sites, and return its name in the file.

    Parameters
    ----------
    path
        The file; it is created if it does not exist.
    site
        A candidate in its current pose.
    candidates
        Names that cannot be used.

    Raises
    ------
    InputError
        If the file was not written by the explorer; it is not changed.
    """
    with _SAVE_LOCK, locks.locked(path.with_name(f".{path.name}.lock"), remove=True):
        rows = _read_saved_rows(path)
        taken = {row[0] for row in rows} | set(candidates)
        numbered = (f"{site.name[:72]}-{number}" for number in count(1))
        name = next(name for name in numbered if name not in taken)
        pose = site.pose
        rows.append([name, *(repr(float(value)) for value in (*pose.position_m, *pose.angles_deg)), site.sensor])
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([_COLUMNS, *rows])
        files.write_text(path, text.getvalue())
    return name


def unused_file_name(folder: Path) -> str:
    """Return a name for saved sites that does not exist yet, for users whose own file has the usual name."""
    stem, suffix = SAVED_SITES.split(".")
    names = (f"{stem}-{number}.{suffix}" for number in count(2))
    return next(name for name in names if not (folder / name).exists())


def _read_saved_rows(path: Path) -> list[list[str]]:
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        rows = [row for row in csv.reader(file) if row]
    if not rows or tuple(rows[0]) != _COLUMNS or any(len(row) != len(_COLUMNS) for row in rows):
        raise InputError(path, "was not written by egvs explore, so it is not overwritten", "Save to another file.")
    return rows[1:]


@dataclass(frozen=True)
class View:
    """What the page shows.

    Attributes
    ----------
    site
        A candidate with its current pose and sensor.
    settings
        Gamma, score and effects.
    period
        Traffic period; empty for all.
    layer
        One of :data:`LAYERS`.
    ring, frame
        Shown by the layers of these names.
    beside
        The candidate that the layer ``difference`` compares with; empty for the best other one.
    is_dark
        Whether the page is dark.
    """

    site: Site
    settings: Settings
    period: str = ""
    layer: str = FIRST_LAYER
    ring: int = 0
    frame: int = 0
    beside: str = ""
    is_dark: bool = False

    @classmethod
    def from_session(cls, session: Session) -> View:
        """Return the first view of a session: its best candidate."""
        return cls(session.ranked[0].site, Settings.from_scenario(session.scenario))


@dataclass(frozen=True)
class Camera:
    """Position of a camera, and the point that it looks at; world frame, metres."""

    from_m: Vec3
    at_m: Vec3


def encode_view(view: View, initial: View, camera: Camera | None = None) -> str:
    """Write a view as a link.

    Parameters
    ----------
    view
        The view.
    initial
        The first view of the session; the same settings are left out.
    camera
        Added to the link.
    """
    site = view.site
    parts = {"site": site.name}
    parts["pose"] = ",".join(_shortest(value) for value in (*site.pose.position_m, *site.pose.angles_deg))
    parts["sensor"] = site.sensor
    if view.settings.gamma is not None:
        parts["gamma"] = _shortest(view.settings.gamma)
    if view.settings.rank_by != initial.settings.rank_by:
        parts["score"] = view.settings.rank_by
    if view.settings.effects != initial.settings.effects:
        parts["effects"] = ",".join(sorted(view.settings.effects))
    for name, default in (("period", ""), ("layer", FIRST_LAYER), ("ring", 0), ("frame", 0), ("beside", "")):
        value = getattr(view, name)
        if value != default:
            parts[name] = str(value)
    if view.is_dark:
        parts["dark"] = "1"
    if camera is not None:
        parts["camera"] = ",".join(f"{value:.6g}" for value in (*camera.from_m, *camera.at_m))
    return urlencode(parts, safe=",")


def decode_view(
    link: str | Mapping[str, str], session: Session, initial: View, where: str
) -> tuple[View, Camera | None]:
    """Read a link.

    Parameters
    ----------
    link
        Its text, or its parts.
    session
        The session without changes.
    initial
        The first view of the session, for parts that are missing.
    where
        Used in messages.

    Raises
    ------
    InputError
        If a part is unknown or not valid.
    """
    if isinstance(link, str):
        link = dict(parse_qsl(link.removeprefix("?"), keep_blank_values=True))
    reader = _LinkReader(link, where)
    site = session.candidates[reader.choice("site", session.candidates, initial.site.name)].site
    pose = reader.numbers("pose", _POSE_PARTS)
    if pose:
        site = replace(site, pose=Pose(*pose))
    site = replace(site, sensor=reader.text("sensor", site.sensor))
    gamma = reader.number("gamma", None, float, "a number of at least 0")
    rank_by = reader.text("score", initial.settings.rank_by)
    settings = Settings(gamma, rank_by, reader.effects(initial.settings.effects))
    view = View(
        site=site,
        settings=settings,
        period=reader.text("period", ""),
        layer=reader.text("layer", FIRST_LAYER),
        ring=reader.whole_number("ring"),
        frame=reader.whole_number("frame"),
        beside=reader.text("beside", ""),
        is_dark=reader.text("dark", "") == "1",
    )
    settings.apply(session.scenario, where)
    check_view(view, session, where)
    camera = None
    coordinates = reader.numbers("camera", ("x", "y", "z", "x", "y", "z"))
    if coordinates:
        from_x, from_y, from_z, at_x, at_y, at_z = coordinates
        camera = Camera((from_x, from_y, from_z), (at_x, at_y, at_z))
    reader.reject_unknown_keys()
    return view, camera


def check_view(view: View, session: Session, where: str) -> None:
    """Check that a page can show a view; what depends on settings is checked when they are applied.

    Parameters
    ----------
    view
        The view.
    session
        The session without changes.
    where
        Used in messages.

    Raises
    ------
    InputError
        If a value is out of range, or there is no such candidate, sensor, period or layer.
    """
    _check_choice(f"{where}: site", view.site.name, session.candidates)
    for name, value in vars(view.site.pose).items():
        limit = _MAX_PITCH_DEG if name == "pitch_deg" else MAX_COORDINATE_M
        if not abs(value) <= limit:
            raise InputError(f"{where}: {name}", f"expected a number from {-limit:g} to {limit:g}, got {value!r}")
    session.scene.sensor(view.site.sensor, f"{where}: sensor")
    _check_choice(f"{where}: period", view.period, ("", *session.periods))
    _check_choice(f"{where}: layer", view.layer, LAYERS)
    _check_choice(f"{where}: beside", view.beside, ("", *session.candidates))


def _check_choice(where: str, text: str, choices: Collection[str]) -> None:
    """Raise an InputError if a text is not one of several names."""
    if text not in choices:
        names = ", ".join(name for name in choices if name)
        expected = f"one of {names}" if names else "no value"
        raise InputError(where, f"expected {expected}, got {text!r}")


class _LinkReader:
    """Reads the parts of a link one by one, and raises an InputError for those that are not valid."""

    def __init__(self, parts: Mapping[str, str], where: str) -> None:
        self._parts, self._where = parts, where
        self._known: set[str] = set()

    def text(self, key: str, default: str) -> str:
        """Return any text."""
        self._known.add(key)
        return self._parts.get(key, default)

    def choice(self, key: str, choices: Collection[str], default: str) -> str:
        """Return one of several names."""
        text = self.text(key, default)
        _check_choice(f"{self._where}: {key}", text, choices)
        return text

    def numbers(self, key: str, names: Sequence[str]) -> list[float]:
        """Return one finite number for each name; nothing if the part is missing."""
        self._known.add(key)
        if key not in self._parts:
            return []
        expected = f"{len(names)} numbers {','.join(names)}"
        values = [self._convert(key, part, float, expected) for part in self._parts[key].split(",")]
        if len(values) != len(names) or not all(map(math.isfinite, values)):
            raise self._error(key, expected, self._parts[key])
        return values

    def number(self, key: str, default: D, kind: Callable[[str], T], expected: str) -> T | D:
        """Return a number of some kind."""
        self._known.add(key)
        if key not in self._parts:
            return default
        return self._convert(key, self._parts[key], kind, expected)

    def whole_number(self, key: str) -> int:
        """Return a whole number from 0, which is the default."""
        value = self.number(key, 0, int, _WHOLE_NUMBER)
        if value < 0:
            raise self._error(key, _WHOLE_NUMBER, value)
        return value

    def effects(self, default: frozenset[str]) -> frozenset[str]:
        """Return names of effects, which are separated by commas."""
        if "effects" not in self._parts:
            self._known.add("effects")
            return default
        names = frozenset(filter(None, self.text("effects", "").split(",")))
        for name in sorted(names.difference(registry.effect_names())):
            raise self._error("effects", f"effects out of {', '.join(registry.effect_names())}", name)
        return names

    def reject_unknown_keys(self) -> None:
        """Raise an InputError if the link has parts that nothing has read."""
        for key in sorted(self._parts.keys() - self._known):
            raise InputError(self._where, f"unknown key {key!r}", f"Use only {', '.join(sorted(self._known))}.")

    def _convert(self, key: str, text: str, kind: Callable[[str], T], expected: str) -> T:
        try:
            return kind(text)
        except ValueError:
            raise self._error(key, expected, text) from None

    def _error(self, key: str, expected: str, value: object) -> InputError:
        return InputError(f"{self._where}: {key}", f"expected {expected}, got {value!r}")


def _shortest(value: float) -> str:
    """Return the shortest text that gives the same number."""
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{value:.0f}"
    return repr(float(value))
