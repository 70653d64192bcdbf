r"""How often vehicles hide what is behind them.

The plain scene scans an empty road. With traffic on it, a beam ends at the first vehicle that it meets. Two models of
the share of a beam b that gets as far as voxel v:

``frames`` (the default) replays recorded traffic against the beams of the empty scan,

.. math:: transmit(b, v) = \frac{1}{F} \, \#\{ f : T_f(b) \ge t_v(b) \},

with :math:`T_f` the range at which b enters the first vehicle box of frame f, :math:`t_v` the range at which it enters
v, and F frames replayed, evenly spaced over those recorded. The voxel in which a beam ends counts. Numerator and
denominator are whole numbers: a voxel that no vehicle ever hides has a share of exactly 1.

``independent`` takes the voxels before v along the beam as independent, each free with the probability that the TPOG
gives,

.. math:: transmit(b, v) = \prod_{u < v} (1 - p(u)).

It needs no replay, and is wrong wherever occupancies are correlated - which they always are: a car fills a dozen voxels
along a beam *together*, but counts here as a dozen chances to be stopped. So it hides too much, and the more the
smaller the voxels. It is here because it is what grid-based planners use; take it to see how far off it is.

Contact: a box stops a beam that passes deeper than 0.1 mm inside (the same shrunk box that occupies voxels), so no
coincidence of a side with a voxel's face or a beam decides anything. A box that holds the sensor is ignored
(:meth:`Replay.holding` counts them): no pole stands in a lane, a recorded box may still sweep over one.

Source: replayed vehicle shapes as dynamic blind zones, as in the roadside LiDAR simulation of
doi:10.1177/03611981251327575 (Transp. Res. Rec., 2025). Independent cells: the inverse beam model of Julian, Karaman
and Rus, "On mutual information-based control of range sensing robots for mapping applications", Int. J. Robot. Res. 33
(2014), where a beam ends in cell v with chance :math:`p(v) \prod_{u < v} (1 - p(u))`.

Calls for it: dense traffic, long vehicles, low sensors. Limits: boxes are opaque and whole (no windows, no gap under
the body); gamma caps the mean over frames, not each frame; the TPOG and the replay share their traffic, so an unlucky
recording is unlucky in both.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from pipeline.artefacts import tables
from pipeline.artefacts.readers import Tpog
from pipeline.artefacts.recorded_boxes import FrameBoxes, read_boxes
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.effects.base import TransmitScore
from pipeline.kernels import occlusion as kernels
from pipeline.scenario.effects import EffectParameters, MovingOcclusionParameters
from pipeline.sensing.crossings import Crossings
from pipeline.sensing.scene import Scene

_AZIMUTHS = 1024  # cells of azimuth, 0.35 degrees each: next to a car at 100 m

Count = Annotated[int, Field(ge=0, strict=True), BeforeValidator(lambda given: 0 if given == "all" else given)]


@dataclass(frozen=True, eq=False)
class Replay:
    """Boxes of the replayed frames that can stand between a sensor and the region of interest.

    Attributes
    ----------
    frames
        How many frames are replayed, with or without boxes.
    frame, values
        Frame of each box, (n,) int64, ascending; its centre in the grid's frame, yaw, pitch and sizes, (n, 8) float64.
    low, high
        Corners of the upright box round each, (n, 3) float64.
    """

    frames: int
    frame: NDArray[np.int64]
    values: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, frames: int, frame: NDArray[np.int64], values: NDArray[np.float64]) -> Replay:
        """From boxes, sorted by frame."""
        low, high = np.empty((len(values), 3)), np.empty((len(values), 3))
        kernels.bounds(values, low, high)
        return cls(frames, frame, values, low, high)

    def holding(self, sensor_m: NDArray[np.float64]) -> int:
        """How many boxes (one a frame each) hold a sensor, given in the grid's frame (3,); they are ignored for it."""
        near = np.flatnonzero(((self.low < sensor_m) & (sensor_m < self.high)).all(axis=1))
        return sum(bool(kernels.holds(self.values[b], sensor_m)) for b in near)

    def seen_from(self, sensor_m: NDArray[np.float64], grid: Grid) -> FacingBoxes:
        """The boxes that can stand between a sensor, given in the grid's frame (3,), and a voxel."""
        most, size_m = len(self.frame), np.asarray(grid.roi.size_m)
        facing, frame, span = np.empty((most, 15)), np.empty(most, dtype=np.int64), np.empty((most, 4))
        kept = kernels.face(sensor_m, self.frame, self.values, self.low, self.high, size_m, facing, frame, span)
        starts, members = kernels.gather(span[:kept], _AZIMUTHS)
        return FacingBoxes(self.frames, frame[:kept], facing[:kept], span[:kept, 2:].copy(), starts, members)


@dataclass(frozen=True, eq=False)
class FacingBoxes:
    """Replayed boxes as one sensor sees them; the fields are those of :mod:`pipeline.kernels.occlusion`."""

    frames: int
    frame: NDArray[np.int64]
    facing: NDArray[np.float64]
    slopes: NDArray[np.float64]
    starts: NDArray[np.int64]
    members: NDArray[np.int64]

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share of the frames in which the beam gets as far as each crossing, (k,) float64."""
        return self._levels(crossings, (self.frames - np.arange(self.frames + 1)) / self.frames)

    def blocked(self, crossings: Crossings) -> NDArray[np.int64]:
        """Frames in which the beam does not get as far as each crossing, (k,) int64."""
        return self._levels(crossings, np.arange(self.frames + 1))

    def _levels(self, crossings: Crossings, levels: NDArray[Any]) -> NDArray[Any]:
        """What ``levels`` says for the frames in which each crossing is not reached."""
        ends = crossings.ends_m
        run = np.hypot(ends[:, 0], ends[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):  # a beam without length crosses nothing
            directions, slope = ends / np.hypot(run, ends[:, 2])[:, None], ends[:, 2] / run
        share = np.empty(len(crossings.cells), dtype=levels.dtype)
        kernels.count_blocked(
            directions, np.arctan2(ends[:, 1], ends[:, 0]), slope, crossings.first, crossings.enter_m,
            self.frame, self.facing, self.slopes, self.starts, self.members, levels, share,
        )  # fmt: skip
        return share


@dataclass(frozen=True, eq=False)
class Independent:
    """The TPOG: frames in which each voxel is occupied, flat, uint32, of ``frames`` frames."""

    frames: int
    counts: NDArray[np.uint32]

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Product of 1 - p over the voxels before each crossing, (k,) float64."""
        share = np.ones(len(crossings.cells))
        kernels.free_of_all(self.counts, float(self.frames), crossings.first, crossings.cells, share)
        return share


@dataclass(frozen=True)
class MovingOcclusion(TransmitScore[MovingOcclusionParameters]):
    """Vehicles hide what is behind them."""

    NAME: ClassVar[str] = "moving_occlusion"
    SOURCE: ClassVar[str] = "doi:10.1177/03611981251327575 (frames); Julian, Karaman, Rus 2014 (independent)"
    Model: ClassVar[type[EffectParameters]] = MovingOcclusionParameters
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"frames": (50, 500, 0)}

    ready: Replay | FacingBoxes | Independent | None = field(default=None, compare=False, repr=False)

    def seen(self, scene: Scene) -> str:
        """Wherever there is traffic."""
        del scene
        return "vehicles hide what is behind them"

    @property
    def reads(self) -> tuple[str, ...]:
        """Trajectories, when they are replayed."""
        return ("trajectories.parquet",) if self.parameters.method == "frames" else ()

    def prepare(self, scene: Scene, tpog: Tpog, trajectories: Path | None) -> MovingOcclusion:
        """Read the boxes of the frames that are replayed, or take the TPOG's counts."""
        del scene
        if self.parameters.method == "independent":
            return replace(self, ready=Independent(tpog.frames, tpog.counts.ravel().astype(np.uint32)))
        if trajectories is None:
            raise InputError("effects.moving_occlusion", "no trajectories to replay", 'method = "independent"')
        return replace(self, ready=read_replay(trajectories, tpog.grid, self.parameters.frames))

    def seen_from(self, sensor_m: NDArray[np.float64], grid: Grid) -> MovingOcclusion:
        """With the boxes turned towards the sensor, where they are replayed."""
        return replace(self, ready=self.ready.seen_from(sensor_m, grid)) if isinstance(self.ready, Replay) else self

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share of the beam that gets as far as each crossing."""
        if not isinstance(self.ready, FacingBoxes | Independent):
            raise RuntimeError("moving_occlusion: prepare() and seen_from() return the effect that can share()")
        return self.ready.share(crossings)


def replayed(recorded: int, wanted: int) -> NDArray[np.int64]:
    """Which of the frames 0 .. recorded - 1 are replayed: the middles of ``wanted`` equal parts; all when 0 or more are
    wanted."""
    if wanted == 0 or wanted >= recorded:
        return np.arange(recorded, dtype=np.int64)
    return (2 * np.arange(wanted, dtype=np.int64) + 1) * recorded // (2 * wanted)


def read_replay(path: Path, grid: Grid, wanted: int) -> Replay:
    """Boxes of the replayed frames in the grid's frame; InputError for a file that is corrupt or out of order."""
    chosen = replayed(int(tables.read_metadata(path, "trajectories")["frames"]), wanted)
    parts = [FrameBoxes(np.empty(0, dtype=np.int64), np.empty((0, 8))), *read_boxes(path, grid, chosen)]
    frame, values = (np.concatenate([getattr(part, name) for part in parts]) for name in ("frame", "values"))
    return Replay.of(len(chosen), frame, values)
