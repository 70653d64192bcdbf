"""Vehicles and people as bodies: closed meshes that are stretched to the boxes of traffic.

A body touches all six faces of its box and never leaves it. Those of the program are prisms across the vehicle, as
``bodies.toml`` beside this module has them; a scenario may name a mesh of the user's for a kind (``[validation]
bodies``). Which body a box gets goes by its SUMO vClass, as ``bodies.toml`` lists them; a box of several parts is a
tractor with trailers, but for buses. Cars, and whatever is of no listed class, go by size:

======================================================= ==========
box                                                     body
======================================================= ==========
no longer than 3.4 m and no wider than 1.48 m (kei car) ``kei``
no longer than 5.3 m, lower than 1.9 m                  ``sedan``
no longer than 6.5 m                                    ``van``
any other                                               ``truck``
======================================================= ==========
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.checks import mesh_parts
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.formats.meshes import loading as meshes
from pipeline.scenario.models import Scenario
from pipeline.validation.clouds.surfaces import REFLECTIVITY

FILE = Path(__file__).with_name("bodies.toml")
MOST_TRIANGLES = 5000
"""Of a user's mesh; each beam near a body is held against it."""

Floats = NDArray[np.float64]

_WHEEL = np.array([(1, 0), (0.5**0.5, 0.5**0.5), (0, 1), (-(0.5**0.5), 0.5**0.5)])
_WHEEL = np.concatenate([_WHEEL, -_WHEEL])
_GROUP = 16  # triangles of a user's mesh that share a box
_BY_SIZE = "by size"
_KEI_M = 3.4, 1.48  # the largest length and width of Japan's class of light vehicles
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Part:
    """A piece of a body that is closed and faces outwards, or some triangles of a user's mesh: corners (m, 3, 3) in the
    unit box round zero."""

    triangles: Floats
    surface: str
    closed: bool = True


@dataclass(frozen=True)
class Bodies:
    """The bodies of all kinds, as :func:`pipeline.kernels.bodies.cast` takes them (``shapes``)."""

    kinds: tuple[str, ...]
    shapes: tuple[NDArray[np.int64], Floats, NDArray[np.bool_], NDArray[np.int64], Floats, Floats, Floats]

    @classmethod
    def of(cls, parts: Mapping[str, tuple[Part, ...]]) -> Bodies:
        """From the parts of each kind."""
        every = [part for several in parts.values() for part in several]
        triangles = np.concatenate([part.triangles for part in every])
        cornered = triangles.copy()
        cornered[:, 1:] -= triangles[:, :1]
        crosses = np.sqrt((np.cross(cornered[:, 1], cornered[:, 2]) ** 2).sum(axis=1))
        lengths = [len(part.triangles) for part in every]
        boxes = [np.append(part.triangles.min(axis=(0, 1)), part.triangles.max(axis=(0, 1))) for part in every]
        closed = np.array([part.closed for part in every])
        pad = np.repeat([-_ROUNDING, _ROUNDING], 3)
        reflectivity = np.repeat([REFLECTIVITY[part.surface] for part in every], lengths)
        starts, ends = (np.cumsum([0, *counts]) for counts in ([len(several) for several in parts.values()], lengths))
        return cls(tuple(parts), (starts, np.array(boxes) + pad, closed, ends, cornered, crosses, reflectivity))

    def of_frame(self, frame: TrafficFrame) -> NDArray[np.int64]:
        """The kind of each box of a frame, (n,)."""
        several = frame.several_parts()
        names = (
            kind_of(vclass, size, part, jointed)
            for vclass, size, part, jointed in zip(
                frame.kinds, frame.boxes[:, 3:6].tolist(), frame.part.tolist(), several.tolist(), strict=True
            )
        )
        return np.array([self.kinds.index(name) for name in names], dtype=np.int64)


def kind_of(vclass: str, size_m: list[float], part: int = 0, jointed: bool = False) -> str:
    """The kind of body that a box gets.

    Parameters
    ----------
    vclass, size_m
        SUMO's vClass; length, width, height.
    part, jointed
        0, or the number of a rear part; whether its vehicle has several parts.
    """
    named = str(_document()["classes"].get(vclass, _BY_SIZE))
    if jointed and named != "bus":
        return "trailer" if part else "tractor"
    return _by_size(*size_m) if named == _BY_SIZE else named


def _by_size(length_m: float, width_m: float, height_m: float) -> str:
    if length_m <= _KEI_M[0] + _ROUNDING and width_m <= _KEI_M[1] + _ROUNDING:
        return "kei"
    if length_m <= 5.3 and height_m < 1.9:
        return "sedan"
    return "van" if length_m <= 6.5 else "truck"


@cache
def _document() -> dict[str, Any]:
    with FILE.open("rb") as file:
        return tomllib.load(file)


@cache
def own() -> Mapping[str, tuple[Part, ...]]:
    """The program's own bodies by kind: closed parts in the unit box."""
    return {kind: tuple(_parts(entry["parts"])) for kind, entry in _document().items() if kind != "classes"}


def drawn_size_m(kind: str) -> tuple[float, float, float]:
    """The box that a body of the program was drawn for."""
    length, width, height = _document()[kind]["size_m"]
    return length, width, height


def of_scenario(scenario: Scenario) -> Bodies:
    """The bodies that a scenario's clouds are made with; InputError as :func:`parts_of`."""
    return Bodies.of(parts_of(scenario))


def parts_of(scenario: Scenario) -> Mapping[str, tuple[Part, ...]]:
    """The parts of each kind of body that a scenario's clouds are made with.

    Raises
    ------
    InputError
        Where a mesh that it names is missing, or no body.
    """
    parts = dict(own())
    for kind, name in scenario.validation.bodies.items():
        place = f"validation.bodies.{kind}"
        parts[kind] = read(scenario.find(name, place), place)
    return parts


def digests(scenario: Scenario) -> dict[str, str]:
    """The files that bodies come from, by sha256: what clouds depend on beside the program's source."""
    hashes = {FILE.name: files.sha256_of(FILE)}
    for kind, name in scenario.validation.bodies.items():
        hashes |= mesh_parts.digests(scenario.find(name, f"validation.bodies.{kind}"), name)
    return hashes


def read(path: Path, place: str) -> tuple[Part, ...]:
    """A user's mesh as a body, all of it paint, in the unit box; ``place`` names it in messages.

    Raises
    ------
    InputError
        When it cannot be read, holds no triangles or too many, is flat, or has corners that are no numbers.
    """
    place = f"{place}: {path}"
    mesh = meshes.load(path, place)
    if len(mesh.faces) > MOST_TRIANGLES:
        raise InputError(place, f"has {len(mesh.faces):,} triangles", f"at most {MOST_TRIANGLES:,}; simplify it")
    triangles = np.asarray(mesh.vertices, dtype=np.float64)[mesh.faces]
    if not np.isfinite(triangles).all():
        raise InputError(place, "a triangle has a corner that is no number", "finite coordinates")
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    if flat := ["xyz"[axis] for axis in range(3) if not high[axis] > low[axis]]:
        raise InputError(place, f"has no extent along {', '.join(flat)}", "a body with length, width and height")
    unit = np.clip((triangles - low) / (high - low), 0.0, 1.0) - 0.5
    order = np.lexsort(np.floor(unit.mean(axis=1) * 4).T)
    return tuple(Part(unit[order[i : i + _GROUP]], "paint", closed=False) for i in range(0, len(order), _GROUP))


def _parts(entries: list[dict[str, Any]]) -> Iterator[Part]:
    """The prisms of a body."""
    for entry in entries:
        if "wheel" in entry:
            x, along, up = entry["wheel"]
            profile = _WHEEL * (along, up) + (x, up)
        else:
            profile = np.array(entry["profile"], dtype=np.float64)
        corners = profile - 0.5
        right, left = entry["y"] if "y" in entry else (-np.asarray(entry["half"]), np.asarray(entry["half"]))
        yield Part(_prism(corners, right, left), entry["surface"])
        if entry.get("mirrored"):
            yield Part(_prism(corners, -left, -right), entry["surface"])


def _prism(profile: Floats, right: Floats | float, left: Floats | float) -> Floats:
    """A closed prism across a vehicle, its triangles facing outwards, (4 n - 4, 3, 3)."""
    n = len(profile)
    near, far = (np.column_stack([profile[:, 0], np.broadcast_to(y, n), profile[:, 1]]) for y in (right, left))
    fan, after = np.arange(1, n - 1), np.roll(np.arange(n), -1)
    # Seen from the right (-y), x to the right and z up, the profile runs counter-clockwise.
    faces = [(near[0], near[i], near[i + 1]) for i in fan] + [(far[0], far[i + 1], far[i]) for i in fan]
    faces += [(near[i], far[i], far[after[i]]) for i in range(n)] + [
        (near[i], far[after[i]], near[after[i]]) for i in range(n)
    ]
    return np.array(faces)
