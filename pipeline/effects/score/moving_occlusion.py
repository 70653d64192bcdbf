r"""How often do vehicles hide what is behind them?

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
recording is unlucky in both."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from pipeline.artefacts import tables
from pipeline.artefacts.readers import read_tpog
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.effects.registry import Parameters, TransmitScore
from pipeline.kernels import boxes as box_kernels
from pipeline.kernels import occlusion as kernels
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites
from pipeline.sensing.crossings import Crossings

_BOX = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
_SMALLEST_M = 10 * box_kernels.SHRINK_M
_TRAJECTORIES, _SCANS, _TPOG = "trajectories.parquet", "scans.parquet", "tpog.parquet"

Count = Annotated[int, Field(ge=0, strict=True), BeforeValidator(lambda given: 0 if given == "all" else given)]


class Model(Parameters):
    """Parameters of ``[effects.moving_occlusion]``."""

    method: Annotated[
        Literal["frames", "independent"],
        Field(description="Replay recorded frames, or take the TPOG's voxels as independent"),
    ] = "frames"
    frames: Annotated[
        Count,
        Field(
            description='Recorded frames that are replayed, evenly spaced; 0 or "all" (or more than there are): all of them'
        ),
    ] = 500

    @field_validator("frames")
    @classmethod
    def _acts(cls, frames: int, info: ValidationInfo) -> int:
        if info.data.get("method") == "independent":
            raise PydanticCustomError("idle", 'acts on nothing with method = "independent"; remove it')
        return frames


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

    def between(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> Replay:
        """Without the boxes that lie wholly outside the upright box from ``low`` to ``high``."""
        near = ((self.high >= low) & (self.low <= high)).all(axis=1)
        return Replay(self.frames, self.frame[near], self.values[near], self.low[near], self.high[near])

    def holding(self, sensor_m: NDArray[np.float64]) -> int:
        """How many boxes (one a frame each) hold a sensor, given in the grid's frame (3,); they are ignored for it."""
        near = np.flatnonzero(((self.low < sensor_m) & (sensor_m < self.high)).all(axis=1))
        return sum(bool(kernels.holds(self.values[b], sensor_m)) for b in near)

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share of the frames in which the beam gets as far as each crossing, (k,) float64."""
        return (self.frames - self.blocked(crossings)) / self.frames

    def blocked(self, crossings: Crossings) -> NDArray[np.int64]:
        """Frames in which the beam does not get as far as each crossing, (k,) int64."""
        row = np.flatnonzero(np.diff(crossings.first))
        ends = crossings.ends_m[row]
        run = np.hypot(ends[:, 0], ends[:, 1])
        azimuth = np.arctan2(ends[:, 1], ends[:, 0])
        order = np.argsort(azimuth, kind="stable")
        row, ends, run = row[order], ends[order], run[order]
        directions = ends / np.hypot(run, ends[:, 2])[:, None]
        with np.errstate(divide="ignore"):
            slope = ends[:, 2] / run
        blocked = np.zeros(len(crossings.cells), dtype=np.int64)
        kernels.count_blocked(
            _sensor_m(crossings.site, crossings.grid), directions, azimuth[order], slope, row, crossings.first, crossings.enter_m,
            self.frame, self.values, self.low, self.high, blocked,
        )  # fmt: skip
        return blocked


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
class MovingOcclusion(TransmitScore):
    """Vehicles hide what is behind them."""

    NAME: ClassVar[str] = "moving_occlusion"
    SOURCE: ClassVar[str] = "doi:10.1177/03611981251327575 (frames); Julian, Karaman, Rus 2014 (independent)"
    Model: ClassVar[type[Parameters]] = Model
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"frames": (50, 500, 0)}

    ready: Replay | Independent | None = field(default=None, compare=False, repr=False)

    @property
    def reads(self) -> tuple[str, ...]:
        """Trajectories, when they are replayed."""
        return (_TRAJECTORIES,) if self.parameters.method == "frames" else ()

    def prepare(self, scenario: Scenario, out: Path) -> MovingOcclusion:
        """Read the boxes of the frames that are replayed, or the TPOG."""
        if self.parameters.method == "independent":
            tpog = read_tpog(out / _TPOG)
            return replace(self, ready=Independent(tpog.frames, tpog.counts.ravel().astype(np.uint32)))
        grid = Grid.from_json(tables.read_metadata(out / _TPOG, "tpog")["grid"])
        low, high = _between(scenario, out, grid)
        return replace(self, ready=read_replay(out / _TRAJECTORIES, grid, self.parameters.frames, low, high))

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share of the beam that gets as far as each crossing."""
        if self.ready is None:
            raise RuntimeError("moving_occlusion: prepare() returns the effect that can share()")
        return self.ready.share(crossings)


EFFECT = MovingOcclusion


def replayed(recorded: int, wanted: int) -> NDArray[np.int64]:
    """Which of the frames 0 .. recorded - 1 are replayed: the middles of ``wanted`` equal parts; all when 0 or more are
    wanted."""
    if wanted == 0 or wanted >= recorded:
        return np.arange(recorded, dtype=np.int64)
    return (2 * np.arange(wanted, dtype=np.int64) + 1) * recorded // (2 * wanted)


def read_replay(path: Path, grid: Grid, wanted: int, low: NDArray[np.float64], high: NDArray[np.float64]) -> Replay:
    """Boxes of the replayed frames that meet the upright box from ``low`` to ``high`` (grid's frame), one row group at
    a time.

    Raises
    ------
    InputError
        For a file that is corrupt or out of order, or a box that is none.
    """
    with tables.reader(path, "trajectories") as (file, about):
        chosen = replayed(int(about["frames"]), wanted)
        parts, last = [Replay.of(len(chosen), np.empty(0, dtype=np.int64), np.empty((0, 8)))], -1
        column = file.schema_arrow.get_field_index("frame")
        for group in range(file.num_row_groups):
            if not _may_hold(file.metadata.row_group(group).column(column).statistics, chosen):
                continue
            table = tables.read_group(file, group, path, ["frame", *_BOX])
            frame = table.column("frame").to_numpy().astype(np.int64)
            if len(frame) and (np.any(np.diff(frame) < 0) or frame[0] < last):
                raise InputError(path, f"frames are out of order near frame {frame[0]}", "rows sorted by frame")
            last = int(frame[-1]) if len(frame) else last
            mine = np.isin(frame, chosen)
            values = np.column_stack([table.column(name).to_numpy()[mine] for name in _BOX])
            _check(path, frame[mine], values)
            values[:, :3] = grid.to_grid_m(values[:, :3])
            parts.append(Replay.of(len(chosen), frame[mine], values).between(low, high))
    arrays = [np.concatenate([getattr(part, name) for part in parts]) for name in ("frame", "values", "low", "high")]
    return Replay(len(chosen), *arrays)


def _may_hold(statistics: Any, chosen: NDArray[np.int64]) -> bool:
    """Whether a row group may hold one of the chosen frames; yes where the file does not say which it holds."""
    if statistics is None or not statistics.has_min_max:
        return True
    return bool(np.searchsorted(chosen, statistics.min) < np.searchsorted(chosen, statistics.max, side="right"))


def _check(path: Path, frame: NDArray[np.int64], values: NDArray[np.float64]) -> None:
    sound = np.isfinite(values).all(axis=1) & (values[:, 5:8] >= _SMALLEST_M).all(axis=1)
    if not sound.all():
        bad = int(np.flatnonzero(~sound)[0])
        shown = ", ".join(f"{name} = {value:g}" for name, value in zip(_BOX, values[bad], strict=True))
        raise InputError(
            f"{path}: frame {frame[bad]}", f"a box with {shown}", f"finite values, sizes of at least {_SMALLEST_M} m"
        )


def _between(scenario: Scenario, out: Path, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The upright box round the region of interest and all sensors, in the grid's frame: what lies outside hides
    nothing."""
    if scenario.scan.keep:
        where = tables.read_metadata(out / _SCANS, "scans")["sites"]
    else:
        where = [site.to_json() for site in sites.of(scenario)]
    corners = [np.zeros(3), np.asarray(grid.roi.size_m), *(_sensor_m(site, grid) for site in where)]
    return np.min(corners, axis=0), np.max(corners, axis=0)


def _sensor_m(site: dict[str, Any], grid: Grid) -> NDArray[np.float64]:
    """Where a site's sensor stands in the grid's frame, (3,) metres."""
    return grid.to_grid_m(np.array([site["x_m"], site["y_m"], site["z_m"]]))
