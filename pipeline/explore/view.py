"""What a page shows, as a value, and as text in a link: a sensor in its pose, settings, what is laid over the scene.

A link's text is that of a web address after its question mark, ``site=c03&pose=195,255,4.5,0,0,0``: numbers
as the scenario has them, world frame, metres and degrees. What is as it was opened is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlencode

from pipeline.core.errors import InputError
from pipeline.core.grid import Vec3
from pipeline.effects import registry
from pipeline.explore.session import Session
from pipeline.explore.settings import Settings
from pipeline.sensing.sites import Pose, Site

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
_POSE = ("x", "y", "z", "yaw", "tilt", "roll")


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


def text_of(view: View, opened: View, camera: Camera | None = None) -> str:
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


def of_text(text: str | Mapping[str, str], session: Session, opened: View, place: str) -> tuple[View, Camera | None]:
    """The view that a link asks for, and from where.

    Parameters
    ----------
    session
        As it was opened, and ``opened`` its view.
    place
        Named in messages.

    Raises
    ------
    InputError
        Where it asks for what is not there.
    """
    said = dict(text if isinstance(text, Mapping) else parse_qsl(text.removeprefix("?"), keep_blank_values=True))
    read = _Reader(said, place)
    name = read.one_of("site", session.candidates, opened.site.name)
    site = session.candidates[name].site
    pose = read.numbers("pose", len(_POSE), ",".join(_POSE))
    site = replace(site, pose=Pose(*pose) if pose else site.pose)
    if "sensor" in said:
        site = replace(site, sensor=said["sensor"])
        session.scene.sensor(site.sensor, f"{place}: sensor")
    view = View(
        site,
        Settings(read.gamma(), said.get("score", opened.settings.rank_by), read.effects(opened.settings.effects)),
        read.one_of("period", ("", *session.periods), ""),
        read.one_of("layer", LAYERS, "none"),
        read.whole("ring"),
        read.whole("frame"),
        read.one_of("beside", ("", *session.candidates), ""),
        said.get("dark", "") == "1",
    )
    view.settings.over(session.scenario, place)
    camera = read.numbers("camera", 6, "x,y,z,x,y,z: from where, and at what")
    unknown = sorted(said.keys() - read.known)
    if unknown:
        raise InputError(place, f"unknown {unknown[0]!r}", f"one of {', '.join(sorted(read.known))}")
    return view, Camera((camera[0], camera[1], camera[2]), (camera[3], camera[4], camera[5])) if camera else None


class _Reader:
    """Reads the parts of a link one by one."""

    def __init__(self, said: Mapping[str, str], place: str) -> None:
        self.said, self.place = said, place
        self.known = {"sensor", "score", "dark"}

    def one_of(self, key: str, known: Any, default: str) -> str:
        """A name that is known."""
        self.known.add(key)
        found = self.said.get(key, default)
        if found not in known:
            right = f"one of {', '.join(name for name in known if name)}"
            raise InputError(f"{self.place}: {key}", repr(found), right if any(known) else "none")
        return found

    def numbers(self, key: str, count: int, right: str) -> list[float]:
        """So many finite numbers; none where the key is not there."""
        self.known.add(key)
        if key not in self.said:
            return []
        parts = self.said[key].split(",")
        found = [self._number(key, part, float, right) for part in parts]
        if len(found) != count or not all(map(math.isfinite, found)):
            raise InputError(f"{self.place}: {key}", repr(self.said[key]), right)
        return found

    def gamma(self) -> float | None:
        """None where it is as the scenario has it."""
        self.known.add("gamma")
        return self._number("gamma", self.said["gamma"], float, "a number from 0") if "gamma" in self.said else None

    def whole(self, key: str) -> int:
        """A number from 0."""
        self.known.add(key)
        found = self._number(key, self.said.get(key, "0"), int, "a whole number from 0")
        if found < 0:
            raise InputError(f"{self.place}: {key}", str(found), "a whole number from 0")
        return found

    def effects(self, default: frozenset[str]) -> frozenset[str]:
        """Names, with commas between them."""
        self.known.add("effects")
        if "effects" not in self.said:
            return default
        found, known = frozenset(filter(None, self.said["effects"].split(","))), registry.names()
        for name in sorted(found.difference(known)):
            raise InputError(f"{self.place}: effects", repr(name), f"one of {', '.join(known)}")
        return found

    def _number(self, key: str, text: str, kind: Callable[[str], T], right: str) -> T:
        try:
            return kind(text)
        except ValueError:
            raise InputError(f"{self.place}: {key}", repr(text), right) from None


def _digits(value: float) -> str:
    """All digits that tell a number from its neighbours, and no more."""
    return f"{value:.0f}" if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))
