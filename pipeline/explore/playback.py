"""A recorded frame of traffic before a moved sensor: which vehicles there are, and the returns that they give.

The returns are those of a point cloud as ``egvs clouds`` makes it (:mod:`pipeline.validation.clouds.point_clouds`), of
the traffic that the run was scored with. A vehicle with :data:`SEEN_WELL_POINTS` of them is seen.

World frame, metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables, traffic_frames
from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core.errors import InputError
from pipeline.explore.session import Session
from pipeline.scoring.targets.scores import SEEN_WELL_POINTS
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import rotation
from pipeline.sensing.sites import Site
from pipeline.stages.shared.target_scores import TRAJECTORIES
from pipeline.validation.clouds import bodies
from pipeline.validation.clouds.bodies import Bodies
from pipeline.validation.clouds.point_clouds import CloudMaker, random_of

Floats = NDArray[np.float64]

AT_ONCE = 240
"""Frames that are read and held together: what is played is a stretch of the record."""


@dataclass(frozen=True, eq=False)
class Moment:
    """A frame, and what a sensor takes of it.

    Attributes
    ----------
    frame
        Every box.
    returns_m
        World frame, (n, 3) float64.
    owner
        The box that each return is of, -1 for the static world, (n,) int64.
    """

    frame: TrafficFrame
    returns_m: Floats
    owner: NDArray[np.int64]

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """Of each box, whether it has enough returns, (boxes,)."""
        counts = np.bincount(self.owner[self.owner >= 0], minlength=len(self.frame.boxes))
        return np.asarray(counts >= SEEN_WELL_POINTS)


class Playback:
    """The record of a session. It holds one stretch of it, and one sensor's empty scan."""

    def __init__(self, session: Session) -> None:
        self._session, self._path = session, session.work.path(TRAJECTORIES)
        self.frames = int(tables.read_metadata(self._path, "trajectories")["frames"])
        self.parts = bodies.parts_of(session.scenario)
        self._shapes = Bodies.of(self.parts)
        self._stretch: tuple[int, list[TrafficFrame]] = (-1, [])
        self._scanner: tuple[Scene, Scanner] | None = None
        self._maker: tuple[Site, CloudMaker] | None = None

    def frame(self, number: int) -> TrafficFrame:
        """A frame of the record; the last one for a higher number."""
        number = max(0, min(number, self.frames - 1))
        first = number - number % AT_ONCE
        if self._stretch[0] != first:
            numbers = np.arange(first, min(first + AT_ONCE, self.frames), dtype=np.int64)
            self._stretch = (first, list(traffic_frames.read(self._path, numbers)))
        return self._stretch[1][number - first]

    def moment(self, site: Site, number: int) -> Moment:
        """A frame before a sensor; without returns where none are known: its empty scan was measured, or no sensor can
        stand there."""
        frame = self.frame(number)
        try:
            maker = self._maker_of(site)
        except InputError:
            return Moment(frame, np.empty((0, 3)), np.empty(0, dtype=np.int64))
        swept = maker.sweep(frame, random_of(self._session.scenario.seed, site.name, frame.number))
        points = swept.sweep.points[:, :3].astype(np.float64) @ rotation(*site.pose.angles_deg).T
        return Moment(frame, points + site.pose.position_m, swept.owner.astype(np.int64))

    def kinds(self, frame: TrafficFrame) -> list[str]:
        """The body of each box of a frame."""
        return [self._shapes.kinds[kind] for kind in self._shapes.of_frame(frame).tolist()]

    def _maker_of(self, site: Site) -> CloudMaker:
        scene = self._session.scene_before(site)
        if self._scanner is None or self._scanner[0] is not scene:
            self._scanner = (scene, Scanner(scene, whole=True, mounts=1))
            self._maker = None
        if self._maker is None or self._maker[0] != site:
            self._maker = (site, CloudMaker.of_site(scene, site, self._scanner[1], self._shapes))
        return self._maker[1]
