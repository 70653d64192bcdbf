"""Scores the sites of a run folder one by one, from its TPOG, its scans, and the vehicles of recorded frames.

The scores of a site depend on no other site, so sites may be scored in any order, in any process that has the artefacts
of the stages before. What is large (hits in voxels, blind spots) is written while sites are scored
(:func:`write_site_outputs`), so that many sites need no more memory than a few.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS
from egvs.artefacts.parquet import ArtefactWriter
from egvs.artefacts.readers import ALL_USERS
from egvs.artefacts.tpog import PeriodBlocks, Tpog, read_periods, read_tpog
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.core.threads import map_ordered
from egvs.effects.returns import ReturnProbability
from egvs.kernels import occupancy, traversal
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.score_config import DEFAULT_SCORE, NOTICED
from egvs.scoring.blindspots import SpotVisibility, SpotWriter, VehicleSpots, open_spot_writer
from egvs.scoring.egvs import EntropyField
from egvs.scoring.noticed import group_members, noticed_bounds, noticed_errors, noticed_pools
from egvs.scoring.road_locations import RoadLocations
from egvs.scoring.score_table import MIX, ScoreTable, SiteScores
from egvs.scoring.scorer import PeriodTpog, Scorer, SiteScore
from egvs.scoring.standard_errors import BlockGroups, BlockJackknife, curve_groups, detector_groups
from egvs.scoring.target_scores import (
    DETECTORS,
    TARGET_SCORES,
    SiteTargetScores,
    expected_by_detector,
    group_score,
)
from egvs.scoring.targets import (
    FrameGroups,
    TargetRecord,
    VisibleTargets,
    recorded_frames,
    target_weights,
    visible_targets,
    warn_unused_weights,
    weighted_mean,
    weighted_people,
    weights_in_mix,
)
from egvs.scoring.visibility import Beams, to_voxel_units
from egvs.scoring.zones import reported_zones, weight_zones
from egvs.sensors.sensor import resolve_sensor
from egvs.sensors.sites import Pose, ScannedSite
from egvs.stages.base import StageContext
from egvs.stages.blocked_sites import near_share
from egvs.stages.site_scans import SiteScan, empty_scans
from egvs.statistics.blocks import means_without_each
from egvs.world.carriageway import Carriageway

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

    from egvs.scoring.zone_results import ZoneUsers
NOTICED_BOUNDS = ("noticed_low", "noticed_high")
"""Scores in the table: what people notice if nothing, and if everything outside the measured data was noticed."""

_ROI_HINT = "Check that the region of interest contains the road."


def vehicle_spots(
    context: StageContext, record: TargetRecord, recorded: Sequence[int], weight: FloatArray
) -> VehicleSpots:
    """Return the spots (lanes, turns, cells of the map) where each vehicle-frame of a record is.

    Parameters
    ----------
    context
        The network of its inputs names the lanes.
    record
        Vehicles of recorded frames.
    recorded
        Number of recorded frames of each period.
    weight
        Weight of each vehicle-frame, (n,) float64.
    """
    network = context.inputs.common_network
    roads = None
    if network is not None:
        roads = RoadLocations.of(network, context.scenario.roi.grid.roi)
    return VehicleSpots.of(record, roads, weight, _period_of_rows(record, recorded))


def _period_of_rows(record: TargetRecord, recorded: Sequence[int]) -> IntArray:
    """The period of each vehicle-frame of a record, (n,) int64."""
    period = np.searchsorted(np.cumsum(recorded), record.numbers[record.frame], side="right")
    return period.astype(np.int64)


def zone_users(context: StageContext) -> ZoneUsers:
    """Return the road users of the recorded traffic in the zones of ``[score] zones``.

    Parameters
    ----------
    context
        Its folder has ``trajectories.parquet`` and the ``tpog.parquet`` that was counted from it.
    """
    from egvs.scoring.zone_results import ZoneUsers

    trajectories, tpog = context.folder.trajectories, context.folder.tpog
    frames = context.scenario.score.sampled_frames
    record = TargetRecord.read(trajectories, read_tpog(tpog).grid, frames, NON_VEHICLE_KINDS)
    recorded = recorded_frames(trajectories)
    weight = weights_in_mix(read_periods(tpog), recorded, record)
    network = context.inputs.common_network
    carriageway = None
    if network is not None and context.scenario.effects.pedestrians_bicycles is None:
        carriageway = Carriageway.of(network)
    period = _period_of_rows(record, recorded)
    detectors = context.scenario.score.detectors
    users = ZoneUsers.of(record, reported_zones(context.scenario), weight, period, carriageway, detectors)
    return replace(users, is_recorded=context.scenario.is_recorded)


class TargetScorer:
    """Scores what sites see of the vehicles of recorded frames. Threads may share one.

    Parameters
    ----------
    context
        Its folder has ``trajectories.parquet`` and the ``tpog.parquet`` that was counted from it.
    grid
        Vehicles in its region of interest are the targets.

    Raises
    ------
    InputError
        When one of these scores ranks the sites, and no vehicle has a weight.
    """

    def __init__(self, context: StageContext, grid: Grid) -> None:
        config = context.scenario.score
        trajectories = context.folder.trajectories
        people = weighted_people(config.weights)
        self.record = TargetRecord.read(trajectories, grid, config.sampled_frames, people)
        self._scene = context.scene
        self._names: tuple[str, ...] = tuple(name for name in config.additional if name in TARGET_SCORES)
        self.detectors = config.detectors
        self._config = config.weights
        self._zones: dict[str, BaseGeometry] = {}

        periods = read_periods(context.folder.tpog)
        recorded = recorded_frames(trajectories)
        self._periods = _rows_of_periods(periods, recorded, self.record)
        mix_weight = weights_in_mix(periods, recorded, self.record)
        self._configured_weight = None
        if config.weights.are_given:
            self._zones = weight_zones(context.scenario)
            self._configured_weight = target_weights(config.weights, self._zones, self.record)
        self.weight = mix_weight
        if self._configured_weight is not None:
            self.weight = mix_weight * self._configured_weight
        self._groups = None
        if config.standard_error:
            self._groups = FrameGroups.read(context.folder.tpog, trajectories, self.record)
        self.spots = vehicle_spots(context, self.record, recorded, mix_weight) if config.blindspots else None

        if self.is_empty and config.rank_by in TARGET_SCORES:
            key = f"{context.scenario.file}: score.rank_by = {config.rank_by!r}"
            raise InputError(key, self._no_vehicles_text, f'{_ROI_HINT} Or set rank_by = "egvs".')

    @property
    def is_empty(self) -> bool:
        """Whether no vehicle-frame has a weight."""
        return not math.fsum(self.weight) > 0.0

    def visible(self, beams: Beams) -> VisibleTargets:
        """Return what an empty scan sees of each vehicle."""
        return visible_targets(self.record, beams, ReturnProbability.of(self._scene, beams.sensor))

    @cached_property
    def levels(self) -> dict[str, FloatArray]:
        """Weight of each vehicle-frame in the levels of the run, (n,) float64, by the group of road users.

        All of them together come first. Empty unless the share that detectors find is computed.
        """
        if DEFAULT_SCORE not in self._names or self.is_empty:
            return {}
        levels = {ALL_USERS: np.ones(len(self.record))}
        for group, are_members in group_members(self.record).items():
            if math.fsum(self.weight[are_members]) > 0.0:
                levels[group] = are_members.astype(np.float64)
        return levels

    @cached_property
    def score_groups(self) -> dict[str, tuple[BlockGroups, ...]]:
        """Score -> its detectors or the values of its curves, which come after the groups of frames.

        Empty without standard errors.
        """
        if self._groups is None:
            return {}
        further: dict[str, tuple[BlockGroups, ...]] = {
            DEFAULT_SCORE: detector_groups(len(self.detectors)),
            NOTICED: curve_groups(noticed_pools()),
        }
        of_groups = {group_score(score, group): further[score] for score in further for group in self.levels}
        return further | of_groups

    def weights_by_period(self) -> dict[str, FloatArray]:
        """Return the weight of each vehicle-frame in each period alone, (n,) float64; nothing without periods."""
        weights = {}
        for period, rows in self._periods:
            weights[period] = np.zeros(len(self.record))
            weights[period][rows] = 1.0 if self._configured_weight is None else self._configured_weight[rows]
        return weights

    def scores(self, visible: VisibleTargets) -> SiteTargetScores:
        """Return the requested scores of what a site sees, and where it misses vehicles."""
        by_detector = None
        values: dict[str, FloatArray] = {}
        for name in self._names:
            if name == DEFAULT_SCORE:
                by_detector = expected_by_detector(visible, self.detectors)
                values[name] = by_detector.mean(axis=0)
            else:
                values[name] = TARGET_SCORES[name](visible, self.detectors)
        parts: dict[str, FloatArray] = {}
        if by_detector is not None:
            parts[DEFAULT_SCORE] = by_detector
        if NOTICED in values:
            parts[NOTICED] = noticed_errors(visible)
        scores: dict[str, FloatArray] = {}
        for name, vehicle_values in values.items():
            scores[name] = self._replicates(name, vehicle_values, parts)
        scores |= self._level_scores(visible, scores, values, parts)

        by_period = []
        for _, rows in self._periods:
            by_period.append({name: self._period_mean(values[name], rows) for name in self._names})
        missed = None
        if self.spots is not None:
            chances = values.get(DEFAULT_SCORE)
            if chances is None:
                chances = TARGET_SCORES[DEFAULT_SCORE](visible, self.detectors)
            missed = self.spots.visibility(visible.points, chances)
        return SiteTargetScores(scores, tuple(by_period), missed)

    def _level_scores(
        self,
        visible: VisibleTargets,
        of_run: Mapping[str, FloatArray],
        values: Mapping[str, FloatArray],
        parts: Mapping[str, FloatArray],
    ) -> dict[str, FloatArray]:
        """Return what detectors find and people notice of each group of road users, with bounds of the latter.

        ``of_run`` are the scores of all road users; other parameters are those of :meth:`_replicates`, by score.
        """
        scores: dict[str, FloatArray] = {}
        bounds = dict(zip(NOTICED_BOUNDS, noticed_bounds(visible), strict=True))
        for group, members in self.levels.items():
            for name, bound in bounds.items():
                scores[group_score(name, group)] = np.array([weighted_mean(bound, self.weight * members)])
            if group == ALL_USERS:
                continue
            for score in (DEFAULT_SCORE, NOTICED):
                of_group = of_run[score] if members.all() else self._replicates(score, values[score], parts, members)
                scores[group_score(score, group)] = of_group
        return scores

    def _replicates(
        self,
        name: str,
        values: FloatArray,
        parts: Mapping[str, FloatArray],
        members: FloatArray | None = None,
    ) -> FloatArray:
        """Mean of a score over all vehicle-frames, then with each group of frames, and each further group, left out.

        Parameters
        ----------
        name
            Name of the score.
        values
            Its value of each vehicle-frame, (n,) float64.
        parts
            Values by each detector, or changes by each value of curves, (p, n) float64, by score.
        members
            Further weight of each vehicle-frame, (n,) float64.
        """
        weight, configured = self.weight, self._configured_weight
        if members is not None:
            weight = weight * members
            configured = members if configured is None else configured * members
        if self._groups is None:
            return np.array([weighted_mean(values, weight)])
        means = self._groups.means(values, configured)
        if not self.score_groups.get(name):
            return means
        # most curves have no road user: sums of zeros cost as much as others
        of_parts = np.array([weighted_mean(part, weight) if part.any() else 0.0 for part in parts[name]])
        if name == DEFAULT_SCORE:
            return np.append(means, means_without_each(of_parts))
        return np.append(means, means[0] + of_parts)

    def _period_mean(self, values: FloatArray, rows: slice) -> float:
        weight = None if self._configured_weight is None else self._configured_weight[rows]
        return weighted_mean(values[rows], weight)

    def warn_undefined_scores(self, tpog: Tpog, periods: Sequence[PeriodTpog]) -> Iterator[Diagnostic]:
        """Warn that scores are NaN although the region has traffic: in the mix, or in one of the periods.

        The tpog stage warns about a region without traffic.
        """
        if not self._names or not tpog.counts.any():
            return
        problem = f"{self._no_vehicles_text}: no value for {' and '.join(self._names)}"
        if self.is_empty:
            yield Diagnostic("no vehicles", f"{SCENARIO_FILE}: roi", problem, _ROI_HINT)
        yield from warn_unused_weights(self._config, self._zones, self.record)
        if self.is_empty:
            return
        for (name, rows), period in zip(self._periods, periods, strict=True):
            if period.tpog.counts.any() and not self.weight[rows].any():
                key = f"{SCENARIO_FILE}: traffic.periods ({name})"
                yield Diagnostic("no vehicles", key, problem, _ROI_HINT)

    @property
    def _no_vehicles_text(self) -> str:
        vehicle = "vehicle"
        if self._configured_weight is not None and len(self.record):
            vehicle = "vehicle with a weight above 0 in [score.weights]"
        frames = f"in the {len(self.record.numbers)} frames examined"
        return f"no {vehicle} has its centre in the region of interest {frames}"


def _rows_of_periods(
    periods: Sequence[PeriodBlocks], recorded: Sequence[int], record: TargetRecord
) -> tuple[tuple[str, slice], ...]:
    """Name and vehicle-frames of each period; nothing where there are no periods."""
    first_frames = np.append(0, np.cumsum(recorded))
    ends: list[int] = np.searchsorted(record.numbers[record.frame], first_frames).tolist()
    rows = []
    for period, start, end in zip(periods, ends[:-1], ends[1:], strict=True):
        if period.name:
            rows.append((period.name, slice(start, end)))
    return tuple(rows)


@dataclass(frozen=True)
class BeamAudit:
    """The worst of some beams, see :func:`egvs.kernels.traversal.audit_beams`."""

    worst_sum: float
    longest_gap_m: float
    misplaced_chords: int
    voxels_visited_twice: int

    @classmethod
    def of(cls, beams: Beams, grid: Grid) -> BeamAudit:
        """Check each beam of a site."""
        origins, directions, shape = to_voxel_units(beams, grid)
        visits: NDArray[np.uint32] = np.zeros(int(np.prod(grid.shape)), dtype=np.uint32)
        return cls(*traversal.audit_beams(origins, directions, shape, grid.voxel_m, visits))

    @classmethod
    def worst(cls, audits: Sequence[BeamAudit]) -> BeamAudit:
        """Return the worst of several sites."""
        return cls(
            max(audit.worst_sum for audit in audits),
            max(audit.longest_gap_m for audit in audits),
            sum(audit.misplaced_chords for audit in audits),
            sum(audit.voxels_visited_twice for audit in audits),
        )


@dataclass(frozen=True)
class ScoredSite:
    """A site and its scores; if requested, an audit of its beams, and its hits in the voxels that it sees.

    ``near_share`` is the share of beams that end near the sensor; ``zones`` is what it sees of road users in zones.
    """

    site: ScannedSite
    score: SiteScore
    targets: SiteTargetScores | None
    audit: BeamAudit | None
    visible: dict[str, NDArray[Any]] | None
    near_share: float = 0.0
    zones: SpotVisibility | None = None


class SiteScoring:
    """Everything that the sites of a run folder are scored against, read once. Threads may share one.

    Parameters
    ----------
    context
        Its folder has ``tpog.parquet``, ``statics.ply``, ``scans.parquet`` where scans are kept, and
        ``trajectories.parquet``.
    audit
        Check each beam as well, see :class:`BeamAudit`.
    """

    def __init__(self, context: StageContext, *, audit: bool = False) -> None:
        config = context.scenario.score
        path = context.folder.tpog
        self.context = context
        self._audit = audit
        self._keep_visibility = config.keep_visibility
        self.tpog = read_tpog(path)
        self.leave_out = BlockJackknife.of(path, self.tpog) if config.standard_error else None
        self.periods = _read_period_tpogs(path, standard_errors=config.standard_error)
        self.scorer = Scorer(context.scene, self.tpog, context.folder.trajectories, self.leave_out, self.periods)
        self.targets = TargetScorer(context, self.tpog.grid) if context.scenario.score.needs_vehicles else None
        self.zones = zone_users(context) if config.zones is not None else None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, in order."""
        return tuple(site.name for site in self.context.scene.sites)

    def all_sites(self, only: Collection[str] | None = None) -> Iterator[ScoredSite]:
        """Score the sites in order, on the threads of the context; those named in ``only``, or all."""
        return map_ordered(self.score, empty_scans(self.context, only), self.context.threads)

    def score(self, scan: SiteScan) -> ScoredSite:
        """Score one scan."""
        audit = BeamAudit.of(scan.beams, self.tpog.grid) if self._audit else None
        targets, zones = None, None
        if self.targets is not None:
            visible = self.targets.visible(scan.beams)
            targets = self.targets.scores(visible)
            if self.zones is not None:
                zones = self.zones.visibility(self._visible_in_zones(self.zones, scan.beams, visible))
        near = near_share(scan.beams.ends_m, scan.beams.weight)
        if self._keep_visibility != "all" and scan.site.name not in self._keep_visibility:
            return ScoredSite(scan.site, self.scorer.score(scan.beams), targets, audit, None, near, zones)
        score, hits = self.scorer.score_and_hits(scan.beams)
        return ScoredSite(scan.site, score, targets, audit, _sparse_hits(hits), near, zones)

    def _visible_in_zones(self, zones: ZoneUsers, beams: Beams, visible: VisibleTargets) -> VisibleTargets:
        """What a scan sees of the road users of the zones: ``visible``, unless there are people without a weight."""
        if len(zones.record) == len(visible.record):
            return visible
        return visible_targets(zones.record, beams, ReturnProbability.of(self.context.scene, beams.sensor))

    def score_table(self, sites: Iterable[ScoredSite]) -> ScoreTable:
        """Return the scores of sites as one table."""
        groups = {period.name: period.leave_out.groups for period in self.periods if period.leave_out is not None}
        if self.leave_out is not None:
            groups[MIX] = self.leave_out.groups
        periods = [period.name for period in self.periods]
        limits = {MIX: self.scorer.limit, **dict(zip(periods, self.scorer.limits_by_period, strict=True))}
        scores = (SiteScores(site.site.name, site.score, site.targets) for site in sites)
        score_groups = {} if self.targets is None else self.targets.score_groups
        return ScoreTable.of(scores, groups, limits, periods, score_groups)


_UNIT_GRID = Grid((0.0, 0.0, 0.0), 1.0, (1, 1, 1))


def _unit_beams() -> Beams:
    """A beam through the single voxel of :data:`_UNIT_GRID`."""
    sensor = resolve_sensor("VLP-32C", {}, "")
    return Beams(Pose(-1.0, 0.5, 0.5), sensor, np.array([[3.0, 0.0, 0.0]]))


def prepare_targets() -> None:
    """Load or compile the kernels of scores over vehicles: score a beam that meets a vehicle."""
    box = np.array([[0.5, 0.5, 0.5, 1.0, 1.0, 1.0, 0.0]])
    record = TargetRecord.of([TrafficFrame(0, ("car",), ("passenger",), box, np.zeros(1))], _UNIT_GRID)
    visible = visible_targets(record, _unit_beams())
    for score in TARGET_SCORES.values():
        score(visible, DETECTORS)


def prepare_voxels() -> None:
    """Load or compile the kernels of scores over voxels, without effects: score a beam through a voxel."""
    for counts in (np.int64, np.uint32):  # those of a TPOG, and of its groups of blocks
        occupancy.accumulate(np.zeros(1, dtype=np.int64), np.ones(1, dtype=counts), np.zeros(1, dtype=counts))
    hits = np.zeros(1, dtype=np.uint32)
    traversal.count_hits(*to_voxel_units(_unit_beams(), _UNIT_GRID), _UNIT_GRID.voxel_m, hits)
    EntropyField.of(np.ones(_UNIT_GRID.shape, dtype=np.int64), 2, _UNIT_GRID).score(hits, 1.0)


def _read_period_tpogs(path: Path, *, standard_errors: bool) -> tuple[PeriodTpog, ...]:
    """The TPOG of each period of ``tpog.parquet``; nothing where it has no periods."""
    periods = []
    for period in read_periods(path):
        if not period.name:
            continue
        tpog = read_tpog(path, period.name)
        leave_out = BlockJackknife.of(path, tpog, period.name) if standard_errors else None
        periods.append(PeriodTpog(period.name, tpog, leave_out))
    return tuple(periods)


def _sparse_hits(hits: FloatArray) -> dict[str, NDArray[Any]]:
    """Columns of ``visibility.parquet`` of the voxels that are crossed, in order."""
    ix, iy, iz = np.nonzero(hits)
    return {
        "ix": ix.astype(np.int32),
        "iy": iy.astype(np.int32),
        "iz": iz.astype(np.int32),
        "hits": hits[ix, iy, iz],
    }


class SiteOutputs:
    """Writes ``visibility.parquet`` and ``blindspots.parquet``; :func:`write_site_outputs` makes it."""

    def __init__(self, stack: ExitStack, visibility: Path, spots: SpotWriter | None) -> None:
        self._stack = stack
        self._path = visibility
        self.spots = spots
        self.visibility: ArtefactWriter | None = None

    def write(self, site: ScoredSite) -> ScoredSite:
        """Write the hits and the blind spots of a site; return the site without them."""
        if site.visible is not None:
            if self.visibility is None:
                self.visibility = self._stack.enter_context(parquet.artefact_writer(self._path, "visibility"))
            self.visibility.write({"site": [site.site.name] * len(site.visible["hits"]), **site.visible})
        targets = site.targets
        if self.spots is not None and targets is not None and targets.missed is not None:
            self.spots.add(site.site.name, targets.missed)
            targets = replace(targets, missed=None)
        return replace(site, visible=None, targets=targets)

    def describe(self, metadata: dict[str, Any]) -> None:
        """Set the metadata of the files."""
        for file in (self.visibility, self.spots):
            if file is not None:
                file.describe(metadata)


@contextmanager
def write_site_outputs(scoring: SiteScoring) -> Iterator[SiteOutputs]:
    """Open the requested files; they appear when the block ends well, and those of an earlier run are removed."""
    folder = scoring.context.folder
    with ExitStack() as stack:
        spots = None
        if scoring.targets is not None and scoring.targets.spots is not None:
            mixed = bool(scoring.periods)
            writer = open_spot_writer(folder.blindspots, scoring.targets.spots, len(scoring.names), mixed=mixed)
            spots = stack.enter_context(writer)
        outputs = SiteOutputs(stack, folder.visibility, spots)
        yield outputs
        if outputs.visibility is None:
            folder.visibility.unlink(missing_ok=True)
        if spots is None:
            folder.blindspots.unlink(missing_ok=True)
