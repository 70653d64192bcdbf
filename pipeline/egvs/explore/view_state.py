"""What a page shows, as a value and in a link; poses saved as sites.

Poses that a planner keeps: a file of sites in the scenario's folder, which ``sites.file`` can name.

A file of that name that this program did not write is a user's own: it stays as it is.

What a page shows, as a value, and as text in a link: a sensor in its pose, settings, what is laid over the scene.

A link's text is that of a web address after its question mark, ``site=c03&pose=195,255,4.5,0,0,0``: numbers
as the scenario has them, world frame, metres and degrees. What is as it was opened is left out.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlencode

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import Vec3
from egvs.effects import registry
from egvs.explore.session import Session
from egvs.explore.settings import Settings
from egvs.sensors.sites import Pose, Site

SAVED_SITES = "kept_sites.csv"
"""In the scenario's folder."""

_COLUMNS = ("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor")


def save_pose(path: Path, site: Site, candidates: Collection[str]) -> str:
    """Add a pose to a file of kept sites, or begin one; the name that it has there.

    Parameters
    ----------
    path
        Of the file.
    site
        The candidate whose sensor it is, as it stands now.
    candidates
        Names that are taken.

    Raises
    ------
    InputError
        Where the file is another one than this program's own: it stays as it is.
    """
    rows = _read_saved_rows(path)
    taken = {row[0] for row in rows} | set(candidates)
    name = next(new for n in range(1, len(taken) + 2) if (new := f"{site.name[:72]}-{n}") not in taken)
    pose = site.pose
    rows.append([name, *(repr(float(value)) for value in (*pose.position_m, *pose.angles_deg)), site.sensor])
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_COLUMNS, *rows])
    files.write_text(path, text.getvalue())
    return name


def unused_file_name(folder: Path) -> str:
    """The name of a file that is not there yet, for somebody whose own file has the usual one."""
    stem, suffix = SAVED_SITES.split(".")
    return next(name for n in count(2) if not (folder / (name := f"{stem}-{n}.{suffix}")).exists())


def _read_saved_rows(path: Path) -> list[list[str]]:
    """The rows of a file of kept sites; none where there is no file yet."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        header, *rows = [row for row in csv.reader(file) if row] or [[]]
    if tuple(header) != _COLUMNS or any(len(row) != len(_COLUMNS) for row in rows):
        raise InputError(path, "was not written by egvs explore, and stays as it is", "another name to keep poses in")
    return rows


LAYERS = {
    "none": "none",
    "traffic": "traffic (TPOG)",
    "seen": "entropy seen",
    "missed": "entropy missed",
    "blindspots": "vehicles missed",
    "difference": "difference to a site",
    "scan": "empty scan",
    "ring": "beams of a ring",
    "replay": "recorded traffic",
}
"""What may be laid over the scene: its name in a link, and on the page."""

T = TypeVar("T")
_POSE_PARTS = ("x", "y", "z", "yaw", "tilt", "roll")


@dataclass(frozen=True)
class View:
    """What is shown.

    Attributes
    ----------
    site
        A candidate, its sensor as it hangs now.
    period
        Of the traffic; empty for all.
    layer
        One of :data:`LAYERS`.
    ring, frame
        Which ring of beams, and which recorded frame, the layers of these show.
    beside
        The candidate that the layer of differences compares with; empty for the best other one.
    is_dark
        The page's colours.
    """

    site: Site
    settings: Settings
    period: str = ""
    layer: str = "none"
    ring: int = 0
    frame: int = 0
    beside: str = ""
    is_dark: bool = False

    @classmethod
    def of(cls, session: Session) -> View:
        """That with which a session is opened: its best candidate."""
        return cls(session.ranked[0].site, Settings.of(session.scenario))


@dataclass(frozen=True)
class Camera:
    """Where somebody looks from, and at what, world frame, metres."""

    from_m: Vec3
    at_m: Vec3


def encode_view(view: View, opened: View, camera: Camera | None = None) -> str:
    """A view as a link has it, beside the one with which the session was opened."""
    site, said = view.site, {"site": view.site.name}
    said["pose"] = ",".join(_digits(value) for value in (*site.pose.position_m, *site.pose.angles_deg))
    said["sensor"] = site.sensor
    if view.settings.gamma is not None:
        said["gamma"] = _digits(view.settings.gamma)
    if view.settings.rank_by != opened.settings.rank_by:
        said["score"] = view.settings.rank_by
    if view.settings.effects != opened.settings.effects:
        said["effects"] = ",".join(sorted(view.settings.effects))
    for name, default in (("period", ""), ("layer", "none"), ("ring", 0), ("frame", 0), ("beside", "")):
        if (value := getattr(view, name)) != default:
            said[name] = str(value)
    if view.is_dark:
        said["dark"] = "1"
    if camera is not None:
        said["camera"] = ",".join(f"{value:.6g}" for value in (*camera.from_m, *camera.at_m))
    return urlencode(said, safe=",")


def decode_view(
    text: str | Mapping[str, str], session: Session, opened: View, where: str
) -> tuple[View, Camera | None]:
    """The view that a link asks for, and from where.

    Parameters
    ----------
    session
        As it was opened, and ``opened`` its view.
    where
        Named in messages.

    Raises
    ------
    InputError
        Where it asks for what is not there.
    """
    said = dict(text if isinstance(text, Mapping) else parse_qsl(text.removeprefix("?"), keep_blank_values=True))
    read = _LinkReader(said, where)
    name = read.one_of("site", session.candidates, opened.site.name)
    site = session.candidates[name].site
    pose = read.numbers("pose", len(_POSE_PARTS), ",".join(_POSE_PARTS))
    site = replace(site, pose=Pose(*pose) if pose else site.pose)
    if "sensor" in said:
        site = replace(site, sensor=said["sensor"])
        session.scene.sensor(site.sensor, f"{where}: sensor")
    view = View(
        site,
        Settings(read.gamma(), said.get("score", opened.settings.rank_by), read.effects(opened.settings.effects)),
        read.one_of("period", ("", *session.periods), ""),
        read.one_of("layer", LAYERS, "none"),
        read.integer("ring"),
        read.integer("frame"),
        read.one_of("beside", ("", *session.candidates), ""),
        said.get("dark", "") == "1",
    )
    view.settings.applied_to(session.scenario, where)
    camera = read.numbers("camera", 6, "x,y,z,x,y,z: from where, and at what")
    unknown = sorted(said.keys() - read.known)
    if unknown:
        raise InputError(where, f"unknown {unknown[0]!r}", f"one of {', '.join(sorted(read.known))}")
    return view, Camera((camera[0], camera[1], camera[2]), (camera[3], camera[4], camera[5])) if camera else None


class _LinkReader:
    """Reads the parts of a link one by one."""

    def __init__(self, parts: Mapping[str, str], where: str) -> None:
        self.parts, self.where = parts, where
        self.known = {"sensor", "score", "dark"}

    def one_of(self, key: str, known: Any, default: str) -> str:
        """A name that is known."""
        self.known.add(key)
        found = self.parts.get(key, default)
        if found not in known:
            right = f"one of {', '.join(name for name in known if name)}"
            raise InputError(f"{self.where}: {key}", repr(found), right if any(known) else "none")
        return found

    def numbers(self, key: str, count: int, expected: str) -> list[float]:
        """So many finite numbers; none where the key is not there."""
        self.known.add(key)
        if key not in self.parts:
            return []
        parts = self.parts[key].split(",")
        found = [self._number(key, part, float, expected) for part in parts]
        if len(found) != count or not all(map(math.isfinite, found)):
            raise InputError(f"{self.where}: {key}", repr(self.parts[key]), expected)
        return found

    def gamma(self) -> float | None:
        """None where it is as the scenario has it."""
        self.known.add("gamma")
        return self._number("gamma", self.parts["gamma"], float, "a number from 0") if "gamma" in self.parts else None

    def integer(self, key: str) -> int:
        """A number from 0."""
        self.known.add(key)
        found = self._number(key, self.parts.get(key, "0"), int, "a whole number from 0")
        if found < 0:
            raise InputError(f"{self.where}: {key}", str(found), "a whole number from 0")
        return found

    def effects(self, default: frozenset[str]) -> frozenset[str]:
        """Names, with commas between them."""
        self.known.add("effects")
        if "effects" not in self.parts:
            return default
        found, known = frozenset(filter(None, self.parts["effects"].split(","))), registry.effect_names()
        for name in sorted(found.difference(known)):
            raise InputError(f"{self.where}: effects", repr(name), f"one of {', '.join(known)}")
        return found

    def _number(self, key: str, text: str, kind: Callable[[str], T], expected: str) -> T:
        try:
            return kind(text)
        except ValueError:
            raise InputError(f"{self.where}: {key}", repr(text), expected) from None


def _digits(value: float) -> str:
    """All digits that tell a number from its neighbours, and no more."""
    return f"{value:.0f}" if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))
