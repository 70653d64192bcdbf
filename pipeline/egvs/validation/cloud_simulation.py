r"""Point clouds with traffic in them: vehicle meshes, noise, intensity.

How bright a return is: what a diffuse surface sends back.

.. math:: I = \rho \cos\theta, \quad 0 \le I \le 1

with the surface's reflectivity :math:`\rho` and the angle of incidence :math:`\theta` (Lambert). A return's power also
falls as :math:`1/r^2` (Höfle and Pfeifer 2007, ISPRS J. Photogramm. Remote Sens. 62(6), 415-433); sensors that report
a calibrated reflectivity take that out again, as here. Gloss, retroreflectors and the wear of paint are left out.

Reflectivities at 900 nm. From Wehr and Lohr (1999, ISPRS J. Photogramm. Remote Sens. 54, 68-82, table of typical
reflectivities): asphalt with pebbles 17 %, smooth concrete 24 %, deciduous trees 60 %, black rubber of a tyre's wall 2
%. Assumed: paint 45 %, between a dark vehicle (10 %) and a white one (80 %), one value for all; a window 10 %: glass
mirrors most of what does not go through, and what returns comes from frames, dirt and seats; cloth 30 %.

Vehicles and people as bodies: closed meshes that are stretched to the boxes of traffic.

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

Makes the point cloud that a sensor takes of the static world with traffic in it.

The empty scan of *all* beams of a sensor is cast once; a frame then costs the beams near its bodies alone.

Steps for a frame: where effects weight beams, draw one row of each; hold beams against the bodies of all boxes, the
nearest surface wins (:mod:`egvs.kernels.mesh_casting`); throw the dice of effects that lose returns; add noise to the
ranges. A point lies where the sensor takes it to be: along the beam's nominal direction, at the measured range.

.. math:: p = (r + \sigma n)\, d_{sensor}, \quad n \sim N(0, 1)

Frames: bodies and beams meet in the world's axes round the sensor, in float64; points come out in the sensor's frame.

Not modelled: the sensor turns while vehicles move (a frame is one instant); mixed returns at edges; a second return.
"""

from __future__ import annotations

import tomllib
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core import files
from egvs.core.errors import InputError
from egvs.effects.base import Detect
from egvs.formats import meshes
from egvs.kernels import mesh_casting
from egvs.scenario.model import Scenario
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, Site
from egvs.validation.sweeps import LabelledSweep, SiteView, Sweep
from egvs.world.ray_casting import EmptyScan

REFLECTIVITY = {"paint": 0.45, "glass": 0.10, "tyre": 0.02, "cloth": 0.30, "ground": 0.17, "leaves": 0.60, "wall": 0.24}

_SOLID_SURFACES = {"ground": "ground", "tree_crown": "leaves"}
"""Kinds of solids that are no walls."""


def solid_reflectivity(kinds: Iterable[str]) -> NDArray[np.float64]:
    """The reflectivity of each solid of the static world, (solids,)."""
    return np.array([REFLECTIVITY[_SOLID_SURFACES.get(kind, "wall")] for kind in kinds], dtype=np.float64)


BODIES_FILE = Path(__file__).with_name("bodies.toml")
MAX_TRIANGLES = 5000
"""Of a user's mesh; each beam near a body is held against it."""

Floats = NDArray[np.float64]

_WHEEL = np.array([(1, 0), (0.5**0.5, 0.5**0.5), (0, 1), (-(0.5**0.5), 0.5**0.5)])
_WHEEL = np.concatenate([_WHEEL, -_WHEEL])
_GROUP = 16  # triangles of a user's mesh that share a box
_BY_SIZE = "by size"
_KEI_M = 3.4, 1.48  # the largest length and width of Japan's class of light vehicles
_ROUNDING = 1e-9


@dataclass(frozen=True)
class MeshPart:
    """A piece of a body that is closed and faces outwards, or some triangles of a user's mesh: corners (m, 3, 3) in the
    unit box round zero."""

    triangles: Floats
    surface: str
    closed: bool = True


@dataclass(frozen=True)
class VehicleMeshes:
    """The bodies of all kinds, as :func:`egvs.kernels.mesh_casting.cast_meshes` takes them (``shapes``)."""

    kinds: tuple[str, ...]
    shapes: tuple[NDArray[np.int64], Floats, NDArray[np.bool_], NDArray[np.int64], Floats, Floats, Floats]

    @classmethod
    def of(cls, parts: Mapping[str, tuple[MeshPart, ...]]) -> VehicleMeshes:
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
            body_kind(vclass, size, part, jointed)
            for vclass, size, part, jointed in zip(
                frame.kinds, frame.boxes[:, 3:6].tolist(), frame.part.tolist(), several.tolist(), strict=True
            )
        )
        return np.array([self.kinds.index(name) for name in names], dtype=np.int64)


def body_kind(vclass: str, size_m: list[float], part: int = 0, jointed: bool = False) -> str:
    """The kind of body that a box gets.

    Parameters
    ----------
    vclass, size_m
        SUMO's vClass; length, width, height.
    part, jointed
        0, or the number of a rear part; whether its vehicle has several parts.
    """
    named = str(_read_bodies_file()["classes"].get(vclass, _BY_SIZE))
    if jointed and named != "bus":
        return "trailer" if part else "tractor"
    return _kind_by_size(*size_m) if named == _BY_SIZE else named


def _kind_by_size(length_m: float, width_m: float, height_m: float) -> str:
    if length_m <= _KEI_M[0] + _ROUNDING and width_m <= _KEI_M[1] + _ROUNDING:
        return "kei"
    if length_m <= 5.3 and height_m < 1.9:
        return "sedan"
    return "van" if length_m <= 6.5 else "truck"


@cache
def _read_bodies_file() -> dict[str, Any]:
    with BODIES_FILE.open("rb") as file:
        return tomllib.load(file)


@cache
def builtin_bodies() -> Mapping[str, tuple[MeshPart, ...]]:
    """The program's own bodies by kind: closed parts in the unit box."""
    return {
        kind: tuple(_prism_parts(entry["parts"])) for kind, entry in _read_bodies_file().items() if kind != "classes"
    }


def drawn_size_m(kind: str) -> tuple[float, float, float]:
    """The box that a body of the program was drawn for."""
    length, width, height = _read_bodies_file()[kind]["size_m"]
    return length, width, height


def vehicle_meshes(scenario: Scenario) -> VehicleMeshes:
    """The bodies that a scenario's clouds are made with; InputError as :func:`body_parts`."""
    return VehicleMeshes.of(body_parts(scenario))


def body_parts(scenario: Scenario) -> Mapping[str, tuple[MeshPart, ...]]:
    """The parts of each kind of body that a scenario's clouds are made with.

    Raises
    ------
    InputError
        Where a mesh that it names is missing, or no body.
    """
    parts = dict(builtin_bodies())
    for kind, name in scenario.validation.bodies.items():
        place = f"validation.bodies.{kind}"
        parts[kind] = read_body(scenario.find(name, place), place)
    return parts


def hash_body_files(scenario: Scenario) -> dict[str, str]:
    """The files that bodies come from, by sha256: what clouds depend on beside the program's source."""
    hashes = {BODIES_FILE.name: files.hash_file(BODIES_FILE)}
    for kind, name in scenario.validation.bodies.items():
        hashes |= meshes.mesh_digests(scenario.find(name, f"validation.bodies.{kind}"), name)
    return hashes


def read_body(path: Path, location: str) -> tuple[MeshPart, ...]:
    """A user's mesh as a body, all of it paint, in the unit box; ``location`` names it in messages.

    Raises
    ------
    InputError
        When it cannot be read, holds no triangles or too many, is flat, or has corners that are no numbers.
    """
    location = f"{location}: {path}"
    mesh = meshes.load_mesh(path, location)
    if len(mesh.faces) > MAX_TRIANGLES:
        raise InputError(location, f"has {len(mesh.faces):,} triangles", f"at most {MAX_TRIANGLES:,}; simplify it")
    triangles = np.asarray(mesh.vertices, dtype=np.float64)[mesh.faces]
    if not np.isfinite(triangles).all():
        raise InputError(location, "a triangle has a corner that is no number", "finite coordinates")
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    if flat := ["xyz"[axis] for axis in range(3) if not high[axis] > low[axis]]:
        raise InputError(location, f"has no extent along {', '.join(flat)}", "a body with length, width and height")
    unit = np.clip((triangles - low) / (high - low), 0.0, 1.0) - 0.5
    order = np.lexsort(np.floor(unit.mean(axis=1) * 4).T)
    return tuple(MeshPart(unit[order[i : i + _GROUP]], "paint", closed=False) for i in range(0, len(order), _GROUP))


def _prism_parts(entries: list[dict[str, Any]]) -> Iterator[MeshPart]:
    """The prisms of a body."""
    for entry in entries:
        if "wheel" in entry:
            x, along, up = entry["wheel"]
            profile = _WHEEL * (along, up) + (x, up)
        else:
            profile = np.array(entry["profile"], dtype=np.float64)
        corners = profile - 0.5
        right, left = entry["y"] if "y" in entry else (-np.asarray(entry["half"]), np.asarray(entry["half"]))
        yield MeshPart(_prism(corners, right, left), entry["surface"])
        if entry.get("mirrored"):
            yield MeshPart(_prism(corners, -left, -right), entry["surface"])


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


Ints = NDArray[np.int64]

_NOT_DRAWN_M = -1.0
"""The range of a row that was not drawn: nothing is nearer."""

_WEIGHT_TOLERANCE = 1e-9
"""Weights of a beam that leave no more than this over are all of it."""


def sweep_rng(seed: int, site: str, frame: int) -> np.random.Generator:
    """The random numbers of one sweep: of a site, by its name, in a frame; whatever other sweeps are made, and when."""
    return np.random.default_rng(np.random.SeedSequence((seed, zlib.crc32(site.encode()), frame)))


def check_no_measured_scan(site: Site) -> None:
    """InputError for a site with a measured scan, which does not tell what met nothing."""
    if site.points is not None:
        found = f"an empty scan that was measured ({site.points}), which does not tell beams that met nothing"
        raise InputError(f"site {site.name}", found, "a site without points, whose empty scan is simulated")


@dataclass(frozen=True)
class FirstHits:
    """What beams meet first, one element a row of the empty scan (a beam, where no effect weights beams).

    Attributes
    ----------
    range_m
        Without noise; infinite where nothing was met, negative for a row that was not drawn, (n,) float64.
    owner
        Row of the frame's boxes, -1 for the static world, (n,) int32.
    intensity
        (n,) float64.
    """

    range_m: Floats
    owner: NDArray[np.int32]
    intensity: Floats


class CloudSimulator:
    """Point clouds of one sensor in one pose. Threads may share one.

    Parameters
    ----------
    scene
        The static world, and the effects that act.
    pose, sensor, site
        Where it stands, what it is, and its name.
    scanner
        A ``Scanner(scene, whole=True)`` that several makers share; its own when None.
    shapes
        The bodies of traffic; the scenario's when None.

    Raises
    ------
    InputError
        Where no sensor can stand.
    """

    def __init__(
        self,
        scene: Scene,
        pose: Pose,
        sensor: Sensor,
        site: str,
        scanner: Scanner | None = None,
        shapes: VehicleMeshes | None = None,
    ) -> None:
        self._scanner = scanner or Scanner(scene, full_sweep=True)
        assert self._scanner.full_sweep
        self._bodies = shapes or vehicle_meshes(scene.scenario)
        self._detects = scene.acting(Detect)
        scan = self._scanner.scan(pose, sensor).rows
        far = np.sqrt((scan.ends_m**2).sum(axis=1))
        directions = scan.ends_m / far[:, None]
        self._beam, self._returned, self._range_m = scan.beam.astype(np.int64), scan.returned, far
        self._cumulated = None if scan.weight is None else _cumulate_weights(self._beam, scan.weight)
        self._intensity = _static_intensity(self._scanner, scan, directions)
        cell = np.empty(len(directions), dtype=np.int64)
        mesh_casting.direction_cells(directions, cell)
        self._row = np.argsort(cell, kind="stable")
        self._directions = directions[self._row]
        self._starts = np.searchsorted(cell[self._row], np.arange(mesh_casting.ROWS * mesh_casting.COLUMNS + 1))
        self._nominal = sensor.directions()
        self.view = SiteView(site, pose, sensor, self._empty_range_m(scan, sensor.beams))

    @classmethod
    def of_site(
        cls, scene: Scene, site: Site, scanner: Scanner | None = None, shapes: VehicleMeshes | None = None
    ) -> CloudSimulator:
        """Of a candidate site.

        Raises
        ------
        InputError
            Where no sensor can stand; or for a site with a measured scan, which does not tell what met nothing.
        """
        check_no_measured_scan(site)
        return cls(scene, site.pose, scene.sensor(site.sensor, f"site {site.name}"), site.name, scanner, shapes)

    def sweep(self, frame: TrafficFrame, random: np.random.Generator) -> LabelledSweep:
        """The point cloud of one frame.

        Parameters
        ----------
        frame
            Whose boxes stand as bodies. One that holds the sensor is left out, as in the effect moving_occlusion.
        random
            Of this sweep alone, see :func:`sweep_rng`.
        """
        rows = None if self._cumulated is None else self._drawn(self._cumulated, random)
        hits = self.first_hits(frame, rows)
        returned = (hits.owner >= 0) | self._returned
        kept = np.flatnonzero(returned) if rows is None else rows[returned[rows]]
        kept = self._noticed(kept, hits.range_m, random)
        noise = self.view.sensor.range_sigma_m * random.standard_normal(len(kept), dtype=np.float32)
        points = np.empty((len(kept), 4), dtype=np.float32)
        mesh_casting.fill_returns(self._beam, kept, hits.range_m, noise, hits.intensity, self._nominal, points)
        return LabelledSweep(Sweep(points, self._beam[kept].astype(np.uint32)), hits.owner[kept])

    def first_hits(self, frame: TrafficFrame, rows: Ints | None = None) -> FirstHits:
        """What the beams meet first, before dice and noise; of some rows of the empty scan, or of all."""
        ranges = self._range_m.copy() if rows is None else np.full(len(self._range_m), _NOT_DRAWN_M)
        if rows is not None:
            ranges[rows] = self._range_m[rows]
        owner, intensity = np.full(len(ranges), -1, dtype=np.int32), self._intensity.copy()
        boxes = np.column_stack([frame.boxes, frame.pitch_rad])
        boxes[:, :3] -= self.view.pose.position_m
        kinds = self._bodies.of_frame(frame)
        shapes = self._bodies.shapes
        mesh_casting.cast_meshes(
            self._directions, self._row, self._starts, boxes, kinds, shapes, ranges, intensity, owner
        )
        ranges[(owner < 0) & ~self._returned & (ranges >= 0.0)] = np.inf
        return FirstHits(ranges, owner, intensity)

    def _drawn(self, cumulated: Floats, random: np.random.Generator) -> Ints:
        """One row of each beam, by weight; of a beam whose weights leave something over, perhaps none."""
        beams = np.arange(self.view.sensor.beams)
        rows = np.searchsorted(cumulated, beams + random.random(len(beams)), side="right")
        inside = rows < len(cumulated)
        rows, beams = rows[inside], beams[inside]
        drawn: Ints = rows[self._beam[rows] == beams]
        return drawn

    def _noticed(self, rows: Ints, range_m: Floats, random: np.random.Generator) -> Ints:
        """The rows whose return is noticed: a die each, where effects lose returns."""
        if not self._detects:
            return rows
        chance = np.ones(len(rows))
        for effect in self._detects:
            chance *= effect.detect(range_m[rows], self.view.sensor)
        return rows[random.random(len(rows)) < chance]

    def _empty_range_m(self, scan: EmptyScan, beams: int) -> Floats:
        """Range of each beam of the sensor; of a beam with several rows, of that of the largest weight."""
        found, ranges = np.full(beams, np.inf), np.where(self._returned, self._range_m, np.inf)
        rows = np.arange(len(ranges)) if scan.weight is None else np.lexsort((-scan.weight, self._beam))
        _, first = np.unique(self._beam[rows], return_index=True)
        found[self._beam[rows[first]]] = ranges[rows[first]]
        return found


def _cumulate_weights(beam: Ints, weight: Floats) -> Floats:
    """Number of its beam plus the weights of its beam up to each row; ascending."""
    total = np.cumsum(weight)
    first = np.flatnonzero(np.diff(beam, prepend=-1))
    before = np.repeat(total[first] - weight[first], np.diff(first, append=len(beam)))
    within = total - before
    within[np.abs(within - 1.0) < _WEIGHT_TOLERANCE] = 1.0
    return beam.astype(np.float64) + np.minimum(within, 1.0)


def _static_intensity(scanner: Scanner, scan: EmptyScan, directions: Floats) -> Floats:
    """What the static world sends back along each row; of leaves, which look everywhere, at a cosine of 1/2."""
    assert scan.face is not None
    world, on = scanner.opaque_world, scan.face >= 0
    corners = world.triangles_m[scan.face[on]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = np.abs((normals * directions[on]).sum(axis=1)) / np.sqrt((normals**2).sum(axis=1))
    found = np.full(len(directions), 0.5 * REFLECTIVITY["leaves"])
    found[on] = solid_reflectivity(kind for _, kind in world.solids)[world.solid_of_face[scan.face[on]]] * cosine
    return found
