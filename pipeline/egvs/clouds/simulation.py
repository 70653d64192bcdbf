r"""Point clouds of a static world with traffic: vehicle meshes, first hits, intensity, noise, lost returns.

The empty scan of *all* beams of a sensor is cast once; a frame then costs only the beams near its vehicles.

Steps for a frame: where effects weight the sub-beams of a beam, draw one of them; intersect beams with the bodies of
all boxes, of which the nearest surface wins (:mod:`egvs.kernels.mesh_casting`); where an effect asks for it, make one
return of what the whole cone of a pulse meets; drop returns that effects lose, by range and by surface; add noise to
the ranges. A point is where the sensor measures it: along the nominal direction of the beam, at the measured range.

.. math:: p = (r + \sigma n)\, d_{sensor}, \quad n \sim N(0, 1)

Frames: bodies and beams are intersected along the world's axes around the sensor, in float64; points are returned in
the sensor's frame. Not modelled: the rotation of the sensor while vehicles move (a frame is one instant), second
returns; mixed returns at edges only with :mod:`egvs.effects.mixed_returns`.

**Intensity** of a return from a diffuse surface (Lambert), with reflectivity :math:`\rho` and angle of incidence
:math:`\theta`:

.. math:: I = \rho \cos\theta, \quad 0 \le I \le 1

The power of a return also falls as :math:`1/r^2` (Höfle and Pfeifer 2007, ISPRS J. Photogramm. Remote Sens. 62(6),
415-433); sensors that report a calibrated reflectivity correct for that, as here. Gloss, retroreflectors and worn paint
are not modelled.

Reflectivities at 900 nm are from Wehr and Lohr (1999, ISPRS J. Photogramm. Remote Sens. 54, 68-82, table of typical
reflectivities): asphalt with pebbles 17 %, smooth concrete 24 %, deciduous trees 60 %, black rubber of a tyre's wall
2 %. Assumed: paint 45 %, one value between a dark vehicle (10 %) and a white one (80 %); windows 10 %, because glass
reflects specularly most of what it does not transmit, so that returns come from frames, dirt and seats; cloth 30 %.

**Bodies** of vehicles and people are closed meshes that are scaled to the boxes of traffic. A body touches all six
faces of its box and never leaves it. The built-in bodies are prisms across the vehicle, defined in ``bodies.toml``
beside this module; a scenario may name a mesh file for a kind of body (``[validation] bodies``). ``bodies.toml`` also
maps SUMO's vClasses to kinds. Articulated vehicles, except buses, are a tractor with trailers. Cars, and all vClasses
that are not listed, get a kind by size:

======================================================= ==========
box                                                     kind
======================================================= ==========
up to 3.4 m long and 1.48 m wide (kei car)              ``kei``
up to 5.3 m long, lower than 1.9 m                      ``sedan``
up to 6.5 m long                                        ``van``
any other                                               ``truck``
======================================================= ==========
"""

from __future__ import annotations

import hashlib
import tomllib
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.sweeps import LabelledSweep, SiteView, Sweep
from egvs.core import files, plugins
from egvs.core.errors import InputError, MissingBackendError, check_list
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.effects.base import Echo, Echoes, checked_shares
from egvs.effects.merge import Cones, Merge
from egvs.effects.returns import ReturnProbability
from egvs.formats import meshes
from egvs.kernels import mesh_casting
from egvs.scenario.loading import check_is_scenario
from egvs.scenario.model import Scenario
from egvs.sensors.return_model import class_of
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, Site
from egvs.world.mesh import World
from egvs.world.ray_casting import EmptyScan

REFLECTIVITY = {"paint": 0.45, "glass": 0.10, "tyre": 0.02, "cloth": 0.30, "ground": 0.17, "leaves": 0.60, "wall": 0.24}

_SOLID_SURFACES = {"ground": "ground", "tree_crown": "leaves"}
"""Kinds of solids that do not reflect like walls."""

BODIES_FILE = Path(__file__).with_name("bodies.toml")

MAX_TRIANGLES = 5000
"""Largest number of triangles of a user's mesh; each beam near a body is tested against all of them."""

_OCTAGON = np.array([(1, 0), (0.5**0.5, 0.5**0.5), (0, 1), (-(0.5**0.5), 0.5**0.5)])
_OCTAGON = np.concatenate([_OCTAGON, -_OCTAGON])
"""Outline of a wheel of radius 1."""

_TRIANGLES_PER_PART = 16
"""Triangles of a user's mesh that share a bounding box."""

_BY_SIZE = "by size"
_KEI_LENGTH_M, _KEI_WIDTH_M = 3.4, 1.48  # limits of Japan's class of light vehicles
BUS_LENGTHS_M = (10.0, 15.0)
"""A vehicle of unknown class with such a length is a bus; other long vehicles are trucks."""

_ROUNDING = 1e-9

_NOT_DRAWN_M = -1.0
"""Range of a row that was not drawn: the kernel never replaces a negative range."""

_WEIGHT_TOLERANCE = 1e-9
"""Weights of a beam that sum to 1 up to this sum to 1."""


def solid_reflectivity(kinds: Iterable[str]) -> FloatArray:
    """Return the reflectivity of each solid of the static world, (solids,)."""
    return np.array([REFLECTIVITY[_SOLID_SURFACES.get(kind, "wall")] for kind in kinds], dtype=np.float64)


@dataclass(frozen=True)
class MeshPart:
    """A part of a body.

    Attributes
    ----------
    triangles
        Corners of its triangles in the unit box around 0, (m, 3, 3) float64.
    surface
        Key of :data:`REFLECTIVITY`.
    closed
        Whether the triangles enclose a volume and face outwards.
    """

    triangles: FloatArray
    surface: str
    closed: bool = True


@dataclass(frozen=True)
class VehicleMeshes:
    """The bodies of all kinds.

    Attributes
    ----------
    kinds
        Names of the kinds.
    shapes
        The bodies in the form that :func:`egvs.kernels.mesh_casting.cast_meshes` takes.
    surfaces
        Key of :data:`REFLECTIVITY` of each triangle of ``shapes``, (m,).
    """

    kinds: tuple[str, ...]
    shapes: tuple[IntArray, FloatArray, BoolArray, IntArray, FloatArray, FloatArray, FloatArray]
    surfaces: NDArray[np.str_]

    @classmethod
    def from_parts(cls, parts_by_kind: Mapping[str, tuple[MeshPart, ...]]) -> VehicleMeshes:
        """Prepare the parts of each kind of body."""
        parts = list(chain.from_iterable(parts_by_kind.values()))
        sides = np.concatenate([part.triangles for part in parts])
        corners = sides[:, :1].copy()
        sides[:, 1:] -= corners
        normal_lengths = np.sqrt((np.cross(sides[:, 1], sides[:, 2]) ** 2).sum(axis=1))
        boxes = [np.append(part.triangles.min(axis=(0, 1)), part.triangles.max(axis=(0, 1))) for part in parts]
        padding = np.repeat([-_ROUNDING, _ROUNDING], 3)
        closed = np.array([part.closed for part in parts])

        triangle_counts = [len(part.triangles) for part in parts]
        surfaces = np.repeat([part.surface for part in parts], triangle_counts)
        reflectivity = np.array([REFLECTIVITY[surface] for surface in surfaces])
        part_starts = np.cumsum([0, *map(len, parts_by_kind.values())])
        triangle_starts = np.cumsum([0, *triangle_counts])
        shapes = (part_starts, np.array(boxes) + padding, closed, triangle_starts, sides, normal_lengths, reflectivity)
        return cls(tuple(parts_by_kind), shapes, surfaces)

    def kinds_of_boxes(self, frame: TrafficFrame) -> IntArray:
        """Return the index in :attr:`kinds` of each box of a frame, (n,)."""
        articulated = frame.several_parts().tolist()
        sizes_m = frame.boxes[:, 3:6].tolist()
        indices = []
        for row, vclass in enumerate(frame.kinds):
            kind = body_kind(vclass, sizes_m[row], int(frame.part[row]), articulated[row])
            indices.append(self.kinds.index(kind))
        return np.array(indices, dtype=np.int64)


def body_kind(vclass: str, size_m: list[float], part: int = 0, articulated: bool = False) -> str:
    """Return the kind of body of a box.

    Parameters
    ----------
    vclass
        SUMO's vClass.
    size_m
        Length, width, height.
    part
        0 for the front part of a vehicle, 1.. for rear parts.
    articulated
        Whether the vehicle has several parts.
    """
    kind = str(_read_bodies_file()["classes"].get(vclass, _BY_SIZE))
    if articulated and kind != "bus":
        return "trailer" if part else "tractor"
    if kind == _BY_SIZE:
        return _kind_by_size(*size_m)
    return kind


def _kind_by_size(length_m: float, width_m: float, height_m: float) -> str:
    if length_m <= _KEI_LENGTH_M + _ROUNDING and width_m <= _KEI_WIDTH_M + _ROUNDING:
        return "kei"
    if length_m <= 5.3 and height_m < 1.9:
        return "sedan"
    if length_m <= 6.5:
        return "van"
    return "bus" if BUS_LENGTHS_M[0] <= length_m <= BUS_LENGTHS_M[1] else "truck"


@cache
def _read_bodies_file() -> dict[str, Any]:
    with BODIES_FILE.open("rb") as file:
        return tomllib.load(file)


@cache
def builtin_bodies() -> Mapping[str, tuple[MeshPart, ...]]:
    """Return the closed parts of each built-in body, by kind."""
    kinds = {kind: entry for kind, entry in _read_bodies_file().items() if kind != "classes"}
    return {kind: tuple(_prism_parts(entry["parts"])) for kind, entry in kinds.items()}


def vehicle_meshes(scenario: Scenario) -> VehicleMeshes:
    """Return the bodies of a scenario; raises an InputError as :func:`body_parts`."""
    return VehicleMeshes.from_parts(body_parts(scenario))


def body_parts(scenario: Scenario) -> Mapping[str, tuple[MeshPart, ...]]:
    """Return the parts of each kind of body of a scenario.

    Raises
    ------
    InputError
        If a mesh file that it names is missing or not usable.
    """
    parts = dict(builtin_bodies())
    for kind, name in scenario.validation.bodies.items():
        key = f"validation.bodies.{kind}"
        parts[kind] = read_body(scenario.find(name, key), key)
    return parts


def hash_body_files(scenario: Scenario) -> dict[str, str]:
    """Return the sha256 of each file that defines bodies, for cache keys."""
    hashes = {BODIES_FILE.name: files.hash_file(BODIES_FILE)}
    for kind, name in scenario.validation.bodies.items():
        hashes |= meshes.mesh_digests(scenario.find(name, f"validation.bodies.{kind}"), name)
    return hashes


def read_body(path: Path, where: str) -> tuple[MeshPart, ...]:
    """Read a user's mesh as a painted body in the unit box.

    Parameters
    ----------
    path
        The mesh file.
    where
        The key that names it, for messages.

    Raises
    ------
    InputError
        If the file cannot be read, or contains no triangles, too many, a flat mesh, or corners that are not finite.
    """
    where = f"{where}: {path}"
    mesh = meshes.load_mesh(path, where)
    if len(mesh.faces) > MAX_TRIANGLES:
        problem = f"expected at most {MAX_TRIANGLES:,} triangles, got {len(mesh.faces):,}"
        raise InputError(where, problem, "Simplify the mesh.")
    triangles = np.asarray(mesh.vertices, dtype=np.float64)[mesh.faces]
    if not np.isfinite(triangles).all():
        raise InputError(where, "a triangle has a non-finite vertex", "Use finite coordinates.")
    low = triangles.min(axis=(0, 1))
    high = triangles.max(axis=(0, 1))
    flat_axes = ["xyz"[axis] for axis in range(3) if not high[axis] > low[axis]]
    if flat_axes:
        problem = f"the mesh has no extent along {', '.join(flat_axes)}"
        raise InputError(where, problem, "Use a mesh with a length, a width and a height.")

    unit = np.clip((triangles - low) / (high - low), 0.0, 1.0) - 0.5
    unit = unit[np.lexsort(np.floor(unit.mean(axis=1) * 4).T)]  # neighbours share a part, so that its box is small
    starts = range(0, len(unit), _TRIANGLES_PER_PART)
    return tuple(MeshPart(unit[start : start + _TRIANGLES_PER_PART], "paint", closed=False) for start in starts)


def _prism_parts(entries: list[dict[str, Any]]) -> Iterator[MeshPart]:
    """Yield the prisms of a built-in body."""
    for entry in entries:
        if "wheel" in entry:
            x, length, height = entry["wheel"]
            outline = _OCTAGON * (length, height) + (x, height)
        else:
            outline = np.array(entry["profile"], dtype=np.float64)
        outline = outline - 0.5
        if "y" in entry:
            right, left = entry["y"]
        else:
            left = np.asarray(entry["half"])
            right = -left
        yield MeshPart(_prism(outline, right, left), entry["surface"])
        if entry.get("mirrored"):
            yield MeshPart(_prism(outline, -left, -right), entry["surface"])


def _prism(outline: FloatArray, right: FloatArray | float, left: FloatArray | float) -> FloatArray:
    """Return the triangles of a closed prism across a vehicle, facing outwards, (4 n - 4, 3, 3).

    The outline (n, 2) has x and z; from the right side (-y), with x to the right and z up, it is counter-clockwise.
    ``right`` and ``left`` are the y of each corner, or of all.
    """
    n = len(outline)
    near = np.column_stack([outline[:, 0], np.broadcast_to(right, n), outline[:, 1]])
    far = np.column_stack([outline[:, 0], np.broadcast_to(left, n), outline[:, 1]])
    next_near, next_far = np.roll(near, -1, axis=0), np.roll(far, -1, axis=0)
    near_cap = np.stack([np.broadcast_to(near[0], (n - 2, 3)), near[1:-1], near[2:]], axis=1)
    far_cap = np.stack([np.broadcast_to(far[0], (n - 2, 3)), far[2:], far[1:-1]], axis=1)
    first_half = np.stack([near, far, next_far], axis=1)
    second_half = np.stack([near, next_far, next_near], axis=1)
    return np.concatenate([near_cap, far_cap, first_half, second_half])


def sweep_rng(seed: int, site: str, frame: int) -> np.random.Generator:
    """Return the random generator of one sweep; it depends on no other sweep.

    Parameters
    ----------
    seed
        Seed of the scenario.
    site
        Name of the site.
    frame
        Number of the frame.
    """
    return np.random.default_rng(np.random.SeedSequence((seed, zlib.crc32(site.encode()), frame)))


def vehicle_draws(vehicles: Sequence[str], seed: int) -> FloatArray:
    """Return a number from 0 to 1 for each vehicle, by its name and the seed of the scenario, (n,)."""
    draws = []
    for vehicle in vehicles:
        digest = hashlib.blake2b(f"{seed} {vehicle}".encode(), digest_size=8).digest()
        draws.append(int.from_bytes(digest, "big") / 2.0**64)
    return np.array(draws)


def check_no_measured_scan(site: Site) -> None:
    """Raise an InputError for a site with a measured scan, which does not contain the beams without a return."""
    if site.points is not None:
        problem = f"its empty scan was measured ({site.points}), and does not contain the beams without a return"
        raise InputError(f"site {site.name}", problem, "Use a site without points; its empty scan is simulated.")


@dataclass(frozen=True)
class FirstHits:
    """What the beams hit first, one element per row of the empty scan (a beam, or a sub-beam where effects add some).

    Attributes
    ----------
    range_m
        Range without noise, (n,) float64; infinite without a hit, negative for a row that was not drawn.
    owner
        Row of the frame's boxes, -1 for the static world, (n,) int32.
    intensity
        From 0 to 1, (n,) float64.
    triangle
        Triangle of the body, -1 for the static world, (n,) int32.
    """

    range_m: FloatArray
    owner: NDArray[np.int32]
    intensity: FloatArray
    triangle: NDArray[np.int32]


class BodyCaster:
    """Intersects beams from one position with the bodies of traffic.

    Parameters
    ----------
    directions
        Unit vectors along the world's axes, (n, 3).
    bodies
        The bodies.
    """

    def __init__(self, directions: FloatArray, bodies: VehicleMeshes) -> None:
        self._bodies = bodies
        cell = np.empty(len(directions), dtype=np.int64)
        mesh_casting.direction_cells(directions, cell)
        self._row = np.argsort(cell, kind="stable")
        self._directions = directions[self._row]
        self._starts = np.searchsorted(cell[self._row], np.arange(mesh_casting.ROWS * mesh_casting.COLUMNS + 1))

    def cast(
        self, frame: TrafficFrame, position_m: tuple[float, float, float], range_m: FloatArray, intensity: FloatArray
    ) -> FirstHits:
        """Return the first hits of all beams.

        Parameters
        ----------
        frame
            The traffic.
        position_m
            Where the beams start.
        range_m
            Range of the static world along each beam, (n,); replaced where a body is nearer.
        intensity
            Intensity of the static world, (n,).
        """
        owner = np.full(len(range_m), -1, dtype=np.int32)
        triangle = owner.copy()
        intensity = intensity.copy()
        boxes = np.column_stack([frame.boxes, frame.pitch_rad])
        boxes[:, :3] -= position_m
        mesh_casting.cast_meshes(
            self._directions, self._row, self._starts, boxes, self._bodies.kinds_of_boxes(frame), self._bodies.shapes,
            range_m, intensity, owner, triangle,
        )  # fmt: skip
        return FirstHits(range_m, owner, intensity, triangle)


class CloudSimulator:
    """Simulates point clouds of one sensor at one pose. Threads may share one.

    Parameters
    ----------
    scene
        The static world and its effects.
    pose, sensor, site
        Pose and sensor, and the name of the site.
    scanner
        A ``Scanner(scene, full_sweep=True)`` that several simulators share; by default, a new one.
    bodies
        The bodies of traffic; by default, those of the scenario.

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
        bodies: VehicleMeshes | None = None,
    ) -> None:
        self._scanner = scanner or Scanner(scene, full_sweep=True)
        assert self._scanner.full_sweep
        self._bodies = bodies or vehicle_meshes(scene.scenario)
        self._return_probability = ReturnProbability.of(scene, sensor)
        self._echo_effects = scene.acting(Echo)
        self._merge = next(iter(scene.acting(Merge)), None)
        if self._merge is not None:
            if (refusal := self._merge.refusal(scene)) is not None:
                raise refusal
            self._scanner = _cone_scanner(self._scanner, self._merge)
        self._seed = scene.scenario.seed

        scan = self._scanner.scan(pose, sensor).rows
        self._range_m = np.sqrt((scan.ends_m**2).sum(axis=1))
        directions = scan.ends_m / self._range_m[:, None]
        self._beam = scan.beam.astype(np.int64)
        self._returned = scan.returned
        self._cumulated_weight: FloatArray | None = None
        if scan.weight is not None:
            self._cumulated_weight = _cumulate_weights(self._beam, scan.weight)
        self._weight = scan.weight
        self._static_object = _static_objects(self._scanner.opaque_world, scan) if self._merge else None
        assert scan.face is not None
        self._static_cosine, reflectivity = static_surfaces(self._scanner.opaque_world, scan.face, directions)
        self._intensity = reflectivity * self._static_cosine

        self._body_caster = BodyCaster(directions, self._bodies)
        self._nominal = sensor.directions()
        self.view = SiteView(site, pose, sensor, self._empty_range_m(scan, sensor.beams))

    @classmethod
    def of_site(
        cls, scene: Scene, site: Site, scanner: Scanner | None = None, bodies: VehicleMeshes | None = None
    ) -> CloudSimulator:
        """Return the simulator of a candidate site.

        Raises
        ------
        InputError
            Where no sensor can stand, and for a site with a measured scan.
        """
        check_no_measured_scan(site)
        return cls(scene, site.pose, scene.sensor(site.sensor, f"site {site.name}"), site.name, scanner, bodies)

    def sweep(self, frame: TrafficFrame, rng: np.random.Generator) -> LabelledSweep:
        """Return the point cloud of one frame.

        Parameters
        ----------
        frame
            The traffic. A box that contains the sensor is left out, as in the effect moving_occlusion.
        rng
            Generator of this sweep only, see :func:`sweep_rng`.
        """
        drawn = None
        if self._cumulated_weight is not None:
            drawn = self._draw_rows(self._cumulated_weight, rng)
        power = None
        if self._merge is None or drawn is None:
            hits = self.first_hits(frame, drawn)
            returned = (hits.owner >= 0) | self._returned
            rows = np.flatnonzero(returned) if drawn is None else drawn[returned[drawn]]
        else:
            rows, hits, power = self._merge_pulses(self._merge, drawn, frame)
        rows = self._drop_lost_returns(rows, hits, power, frame, rng)
        sigma_m: float | FloatArray = self.view.sensor.range_sigma_m
        if self._echo_effects:
            echoes = self._echoes(rows, hits, frame)
            probability, variance_m2 = np.ones(len(rows)), np.zeros(len(rows))
            for effect in self._echo_effects:
                probability *= checked_shares(effect, effect.probability(echoes), len(rows), "returns")
                variance_m2 += checked_shares(effect, effect.sigma_m(echoes), len(rows), "returns", np.inf) ** 2
            sigma_m = np.sqrt(sigma_m**2 + variance_m2)
            is_kept = rng.random(len(rows)) < probability
            rows, sigma_m = rows[is_kept], sigma_m[is_kept]
        noise = sigma_m * rng.standard_normal(len(rows), dtype=np.float32)
        intensity = hits.intensity if power is None else hits.intensity * power
        points = np.empty((len(rows), 4), dtype=np.float32)
        mesh_casting.fill_returns(self._beam, rows, hits.range_m, noise, intensity, self._nominal, points)
        return LabelledSweep(Sweep(points, self._beam[rows].astype(np.uint32)), hits.owner[rows])

    def first_hits(self, frame: TrafficFrame, rows: IntArray | None = None) -> FirstHits:
        """Return the first hits of all rows of the empty scan, or of some, before losses and noise."""
        if rows is None:
            range_m = self._range_m.copy()
        else:
            range_m = np.full(len(self._range_m), _NOT_DRAWN_M)
            range_m[rows] = self._range_m[rows]
        hits = self._body_caster.cast(frame, self.view.pose.position_m, range_m, self._intensity)
        range_m[(hits.owner < 0) & ~self._returned & (range_m >= 0.0)] = np.inf
        return hits

    def _merge_pulses(
        self, effect: Merge[Any], drawn: IntArray, frame: TrafficFrame
    ) -> tuple[IntArray, FirstHits, FloatArray]:
        """Return the rows of the pulses' returns, hits with the ranges that are measured, and the power of each row.

        A cone that meets one object only has the hit of its axis. The power is that in units of a whole cone on the
        surface of the row, (n,).
        """
        assert self._weight is not None and self._static_object is not None
        count = len(effect.cone.expand(np.eye(1, 3), self.view.sensor, self.view.pose).weight)
        pulses = (drawn // count)[:, None] * count + np.arange(count)
        hits = self.first_hits(frame, pulses.ravel())
        owner, range_m = hits.owner[pulses], hits.range_m[pulses]
        surface = np.where(owner >= 0, owner, self._static_object[pulses])
        is_hit = np.isfinite(range_m)
        on_one_object = is_hit.all(axis=1) & (surface == surface[:, :1]).all(axis=1)
        at_edge = is_hit.any(axis=1) & ~on_one_object

        edges = pulses[at_edge]
        weight = self._weight[edges] / self._weight[edges].sum(axis=1, keepdims=True)
        merged = effect.merge(Cones(range_m[at_edge], weight, hits.intensity[edges], surface[at_edge]))
        rows = pulses[:, 0].copy()
        rows[at_edge] = edges[np.arange(len(edges)), merged.sub_beam]
        measured_m, power = hits.range_m.copy(), np.ones(len(hits.range_m))
        measured_m[rows[at_edge]] = merged.range_m
        power[rows[at_edge]] = merged.power
        return rows[on_one_object | at_edge], replace(hits, range_m=measured_m), power

    def _echoes(self, rows: IntArray, hits: FirstHits, frame: TrafficFrame) -> Echoes:
        """Return the surfaces that some rows meet."""
        owner, triangle = hits.owner[rows], hits.triangle[rows]
        on_body = owner >= 0
        cosine = self._static_cosine[rows]
        cosine[on_body] = hits.intensity[rows][on_body] / self._bodies.shapes[-1][triangle[on_body]]
        is_glass = np.zeros(len(rows), dtype=np.bool_)
        is_glass[on_body] = self._bodies.surfaces[triangle[on_body]] == "glass"
        draw = np.full(len(rows), np.nan)
        draw[on_body] = vehicle_draws(frame.vehicles, self._seed)[owner[on_body]]
        return Echoes(hits.range_m[rows], cosine, is_glass, draw)

    def _draw_rows(self, cumulated_weight: FloatArray, rng: np.random.Generator) -> IntArray:
        """Draw one row of each beam by weight; where the weights of a beam sum to less than 1, possibly none."""
        beams = np.arange(self.view.sensor.beams)
        rows = np.searchsorted(cumulated_weight, beams + rng.random(len(beams)), side="right")
        inside = rows < len(cumulated_weight)
        rows = rows[inside]
        drawn: IntArray = rows[self._beam[rows] == beams[inside]]
        return drawn

    def _drop_lost_returns(
        self,
        rows: IntArray,
        hits: FirstHits,
        power: FloatArray | None,
        frame: TrafficFrame,
        rng: np.random.Generator,
    ) -> IntArray:
        """Return the rows whose return is detected, drawn by the probability that effects give it."""
        if self._return_probability is None:
            return rows
        owner, triangle = hits.owner[rows], hits.triangle[rows]
        on_body = owner >= 0
        reflectivity: FloatArray = hits.intensity[rows].astype(np.float64)  # of the static world, times the cosine
        classes = [class_of(vclass) for vclass in frame.kinds]
        whole = np.array([road_users.reflectivity for road_users in classes])
        body = np.array([road_users.body_reflectivity for road_users in classes])
        glass = np.array([road_users.glass_reflectivity for road_users in classes])
        is_glass = self._bodies.surfaces[triangle[on_body]] == "glass"
        reflectivity[on_body] = np.where(is_glass, glass[owner[on_body]], body[owner[on_body]])
        if power is not None:
            reflectivity *= power[rows]
        of_class = np.full(len(rows), np.nan)
        of_class[on_body] = whole[owner[on_body]]
        probability = self._return_probability(hits.range_m[rows], reflectivity, of_class)
        return rows[rng.random(len(rows)) < probability]

    def _empty_range_m(self, scan: EmptyScan, beams: int) -> FloatArray:
        """Return the range of each beam in the empty scan, of its sub-beam with the largest weight; (beams,)."""
        row_ranges = np.where(self._returned, self._range_m, np.inf)
        rows = np.arange(len(row_ranges)) if scan.weight is None else np.lexsort((-scan.weight, self._beam))
        _, first = np.unique(self._beam[rows], return_index=True)
        ranges = np.full(beams, np.inf)
        ranges[self._beam[rows[first]]] = row_ranges[rows[first]]
        return ranges


def _cumulate_weights(beam: IntArray, weight: FloatArray) -> FloatArray:
    """Return, for each row, the number of its beam plus the weights of this beam up to the row; ascending."""
    total = np.cumsum(weight)
    first = np.flatnonzero(np.diff(beam, prepend=-1))
    before = np.repeat(total[first] - weight[first], np.diff(first, append=len(beam)))
    within_beam = total - before
    within_beam[np.abs(within_beam - 1.0) < _WEIGHT_TOLERANCE] = 1.0
    return beam.astype(np.float64) + np.minimum(within_beam, 1.0)


@lru_cache(maxsize=1)
def _cone_scanner(scanner: Scanner, effect: Merge[Any]) -> Scanner:
    """Return a scanner that splits each beam last into the cone of an effect: its rows follow one another."""
    others = (other for other in scanner.scene.effects if other.NAME != effect.cone.NAME)
    return Scanner(replace(scanner.scene, effects=(*others, effect.cone)), full_sweep=True)


def _static_objects(world: World, scan: EmptyScan) -> IntArray:
    """Return a number below 0 for the solid of the static world along each row, (n,); -1 if there is none."""
    assert scan.face is not None
    number = np.full(len(scan.face), -1, dtype=np.int64)
    on_face = scan.face >= 0
    number[on_face] = -2 - world.solid_of_face[scan.face[on_face]].astype(np.int64)
    return number


def static_surfaces(world: World, face: IntArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how a static world reflects beams.

    Parameters
    ----------
    world
        The static world.
    face
        Face that each beam ends on, (n,) int64; below 0 for leaves, which have any orientation and a cosine of 1/2.
    directions
        Unit vectors of the beams, (n, 3).

    Returns
    -------
    cosine, reflectivity
        Cosine of the angle of incidence, and reflectivity of the surface, (n,) float64 each.
    """
    on_face = face >= 0
    corners = world.triangles_m[face[on_face]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = np.full(len(directions), 0.5)
    cosine[on_face] = np.abs((normals * directions[on_face]).sum(axis=1)) / np.sqrt((normals**2).sum(axis=1))
    reflectivity = np.full(len(directions), REFLECTIVITY["leaves"])
    reflectivity[on_face] = solid_reflectivity(kind for _, kind in world.solids)[world.solid_of_face[face[on_face]]]
    return cosine, reflectivity


WRITERS_GROUP = "egvs.cloud_writers"
"""Entry points of what :func:`write_clouds` calls."""


def write_clouds(
    scenario: Scenario,
    folder: str | Path,
    *,
    sites: Sequence[str] = (),
    frames: int,
    spacing_s: float | None = None,
    format: str = "kitti",
    jobs: int | None = None,
) -> Path:
    """Write labelled point clouds of a scenario's sites, as ``egvs clouds`` does, and return their folder.

    Parameters
    ----------
    scenario
        From :func:`egvs.load`.
    folder
        New or empty; nothing is overwritten. It gets a folder for each site, and a README.
    sites
        Names of sites; all by default.
    frames
        Number of frames of each site.
    spacing_s
        Minimum time between two frames, in seconds; by default 7 s, or what the traffic allows.
    format
        ``"kitti"``, ``"openpcdet"``, ``"ply"`` or ``"pcd"``.
    jobs
        Number of threads; one per core when None. The files do not depend on it.

    Raises
    ------
    InputError
        For wrong arguments, and a scenario that a stage refuses; nothing is written then.

    Examples
    --------
    >>> import egvs
    >>> scenario = egvs.load("roundabout", ["traffic.frames=100"])
    >>> egvs.write_clouds(scenario, "clouds", sites=["kerb_NE"], frames=2).name
    'clouds'
    """
    check_is_scenario(scenario)
    check_list("sites", sites)
    if frames < 1:
        raise InputError("frames", f"expected at least 1, got {frames}", "Use, for example, frames=100.")
    names = plugins.plugin_names(WRITERS_GROUP)
    if not names:
        raise MissingBackendError("write_clouds needs the extension validation, which is not installed.")
    write = plugins.load_plugin(WRITERS_GROUP, names[0])
    write(scenario, Path(folder), sites=sites, frames=frames, spacing_s=spacing_s, kind=format, jobs=jobs)
    return Path(folder)
