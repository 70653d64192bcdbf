r"""Makes the point cloud that a sensor takes of the static world with traffic in it.

The empty scan of *all* beams of a sensor is cast once; a frame then costs the beams near its bodies alone.

Steps for a frame: where effects weight beams, draw one row of each; hold beams against the bodies of all boxes, the
nearest surface wins (:mod:`pipeline.kernels.bodies`); throw the dice of effects that lose returns; add noise to the
ranges. A point lies where the sensor takes it to be: along the beam's nominal direction, at the measured range.

.. math:: p = (r + \sigma n)\, d_{sensor}, \quad n \sim N(0, 1)

Frames: bodies and beams meet in the world's axes round the sensor, in float64; points come out in the sensor's frame.

Not modelled: the sensor turns while vehicles move (a frame is one instant); mixed returns at edges; a second return.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core.errors import InputError
from pipeline.effects.base import Detect
from pipeline.kernels import bodies as kernels
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose, Site
from pipeline.validation.clouds import bodies, surfaces
from pipeline.validation.clouds.bodies import Bodies
from pipeline.validation.sweeps import LabelledSweep, SiteView, Sweep
from pipeline.world.casting import EmptyScan

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_NEVER_M = -1.0
"""The range of a row that was not drawn: nothing is nearer."""

_WHOLE = 1e-9
"""Weights of a beam that leave no more than this over are all of it."""


def random_of(seed: int, site: str, frame: int) -> np.random.Generator:
    """The random numbers of one sweep: of a site, by its name, in a frame; whatever other sweeps are made, and when."""
    return np.random.default_rng(np.random.SeedSequence((seed, zlib.crc32(site.encode()), frame)))


def check(site: Site) -> None:
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


class CloudMaker:
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
        shapes: Bodies | None = None,
    ) -> None:
        self._scanner = scanner or Scanner(scene, whole=True)
        assert self._scanner.whole
        self._bodies = shapes or bodies.of_scenario(scene.scenario)
        self._detects = scene.acting(Detect)
        scan = self._scanner.scan(pose, sensor).rows
        far = np.sqrt((scan.ends_m**2).sum(axis=1))
        directions = scan.ends_m / far[:, None]
        self._beam, self._returned, self._range_m = scan.beam.astype(np.int64), scan.returned, far
        self._cumulated = None if scan.weight is None else _cumulated(self._beam, scan.weight)
        self._intensity = _intensity(self._scanner, scan, directions)
        cell = np.empty(len(directions), dtype=np.int64)
        kernels.cells(directions, cell)
        self._row = np.argsort(cell, kind="stable")
        self._directions = directions[self._row]
        self._starts = np.searchsorted(cell[self._row], np.arange(kernels.ROWS * kernels.COLUMNS + 1))
        self._nominal = sensor.directions()
        self.view = SiteView(site, pose, sensor, self._empty_range_m(scan, sensor.beams))

    @classmethod
    def of_site(
        cls, scene: Scene, site: Site, scanner: Scanner | None = None, shapes: Bodies | None = None
    ) -> CloudMaker:
        """Of a candidate site.

        Raises
        ------
        InputError
            Where no sensor can stand; or for a site with a measured scan, which does not tell what met nothing.
        """
        check(site)
        return cls(scene, site.pose, scene.sensor(site.sensor, f"site {site.name}"), site.name, scanner, shapes)

    def sweep(self, frame: TrafficFrame, random: np.random.Generator) -> LabelledSweep:
        """The point cloud of one frame.

        Parameters
        ----------
        frame
            Whose boxes stand as bodies. One that holds the sensor is left out, as in the effect moving_occlusion.
        random
            Of this sweep alone, see :func:`random_of`.
        """
        rows = None if self._cumulated is None else self._drawn(self._cumulated, random)
        hits = self.first_hits(frame, rows)
        returned = (hits.owner >= 0) | self._returned
        kept = np.flatnonzero(returned) if rows is None else rows[returned[rows]]
        kept = self._noticed(kept, hits.range_m, random)
        noise = self.view.sensor.range_sigma_m * random.standard_normal(len(kept), dtype=np.float32)
        points = np.empty((len(kept), 4), dtype=np.float32)
        kernels.points(self._beam, kept, hits.range_m, noise, hits.intensity, self._nominal, points)
        return LabelledSweep(Sweep(points, self._beam[kept].astype(np.uint32)), hits.owner[kept])

    def first_hits(self, frame: TrafficFrame, rows: Ints | None = None) -> FirstHits:
        """What the beams meet first, before dice and noise; of some rows of the empty scan, or of all."""
        ranges = self._range_m.copy() if rows is None else np.full(len(self._range_m), _NEVER_M)
        if rows is not None:
            ranges[rows] = self._range_m[rows]
        owner, intensity = np.full(len(ranges), -1, dtype=np.int32), self._intensity.copy()
        boxes = np.column_stack([frame.boxes, frame.pitch_rad])
        boxes[:, :3] -= self.view.pose.position_m
        kinds = self._bodies.of_frame(frame)
        shapes = self._bodies.shapes
        kernels.cast(self._directions, self._row, self._starts, boxes, kinds, shapes, ranges, intensity, owner)
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


def _cumulated(beam: Ints, weight: Floats) -> Floats:
    """Number of its beam plus the weights of its beam up to each row; ascending."""
    total = np.cumsum(weight)
    first = np.flatnonzero(np.diff(beam, prepend=-1))
    before = np.repeat(total[first] - weight[first], np.diff(first, append=len(beam)))
    within = total - before
    within[np.abs(within - 1.0) < _WHOLE] = 1.0
    return beam.astype(np.float64) + np.minimum(within, 1.0)


def _intensity(scanner: Scanner, scan: EmptyScan, directions: Floats) -> Floats:
    """What the static world sends back along each row; of leaves, which look everywhere, at a cosine of 1/2."""
    assert scan.face is not None
    world, on = scanner.opaque_world, scan.face >= 0
    corners = world.triangles_m[scan.face[on]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = np.abs((normals * directions[on]).sum(axis=1)) / np.sqrt((normals**2).sum(axis=1))
    found = np.full(len(directions), 0.5 * surfaces.REFLECTIVITY["leaves"])
    found[on] = surfaces.of_solids(kind for _, kind in world.solids)[world.solid_of_face[scan.face[on]]] * cosine
    return found
