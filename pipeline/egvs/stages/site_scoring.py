"""Takes empty scans one by one (stored or cast) and scores each site.

The places at which a run's vehicles were recorded, on the roads that its traffic was simulated on.

Scores of each period beside those of the mix: ``scores_by_period.parquet``, and what rankings disagree on.

The scene of a run's folder, and its empty scans: from ``scans.parquet``, or, with ``scan.keep = false``, cast as
they are asked for.

What sites see of the vehicles of recorded frames: the scores over them that a scenario asks for, and blind spots.

Steps: read some frames of ``trajectories.parquet`` once for all sites; count what a site sees of each vehicle; take the
mean of what that is worth, of all vehicles, with each group of frames left out, and in each period alone; count at each
place how many are seen well.

Scores the sites of a run's folder one by one, from its TPOG, its scans, and the vehicles of recorded frames.

What one site scores depends on no other site, so the sites of a scenario may be scored in any order, and anywhere where
the artefacts of the stages before lie.

What a run keeps of each site alone, written while sites are scored: ``visibility.parquet``, ``blindspots.parquet``.

It is the most that is known of a site; so many sites take no more memory than a few.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.parquet import ArtefactWriter
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import PeriodBlocks, Tpog, read_periods, read_tpog
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import Grid
from egvs.core.runtime import map_ordered
from egvs.kernels import traversal
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scoring.blindspots import SpotWriter, VehicleSpots, open_spot_writer
from egvs.scoring.road_locations import RoadLocations
from egvs.scoring.scorer import PeriodTpog, Scorer, SiteScore
from egvs.scoring.standard_errors import BlockJackknife
from egvs.scoring.target_scores import TARGET_SCORES, SiteTargetScores
from egvs.scoring.targets import (
    Floats,
    FrameGroups,
    TargetRecord,
    VisibleTargets,
    detection_probability,
    recorded_frames,
    target_weights,
    visible_targets,
    warn_unused_weights,
    weighted_mean,
    weighted_people,
    weights_in_mix,
)
from egvs.scoring.visibility import Beams, to_voxel_units
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import ScannedSite
from egvs.stages.base import StageContext


def vehicle_spots(work: StageContext, record: TargetRecord, recorded: list[int], weight: Floats) -> VehicleSpots:
    """Where each vehicle-frame of a record is.

    Parameters
    ----------
    recorded
        Frames that were recorded in each period.
    weight
        How much each vehicle-frame counts, (n,) float64.
    """
    network = work.inputs.common_network
    roads = None if network is None else RoadLocations.of(network, work.scenario.roi.grid.roi)
    period = np.searchsorted(np.cumsum(recorded), record.numbers[record.frame], side="right")
    return VehicleSpots.of(record, roads, weight, period.astype(np.int64))


def period_tpogs(path: Path, *, standard_errors: bool) -> tuple[PeriodTpog, ...]:
    """The TPOG of each period of ``tpog.parquet``; none where it has no periods."""
    found = []
    for name in (period.name for period in read_periods(path) if period.name):
        tpog = read_tpog(path, name)
        found.append(PeriodTpog(name, tpog, BlockJackknife.of(path, tpog, name) if standard_errors else None))
    return tuple(found)


@dataclass(frozen=True)
class SiteScan:
    """One site's empty scan, and what artefacts hold of the site."""

    site: ScannedSite
    beams: Beams


def empty_scans(work: StageContext, only: Collection[str] | None = None) -> Iterator[SiteScan]:
    """The scans in the order of the sites; of the sites named in ``only``, or of all."""
    return _stored_scans(work, only) if work.scenario.scan.keep else _cast_scans(work, only)


def _stored_scans(work: StageContext, only: Collection[str] | None) -> Iterator[SiteScan]:
    path = work.folder.scans
    with parquet.open_artefact(path, "scans") as (file, about):
        if file.num_row_groups != len(about["sites"]):
            raise InputError(path, f"{file.num_row_groups} row groups for {len(about['sites'])} sites", "one a site")
        wanted = [c for c in ("dx_m", "dy_m", "dz_m", "weight") if c in file.schema_arrow.names]
        for group, written in enumerate(about["sites"]):
            site = ScannedSite.from_json(written, path)
            if only is None or site.name in only:
                table = parquet.read_row_group(file, group, path, wanted)
                columns = {name: table.column(name).to_numpy() for name in wanted}
                ends = np.column_stack([columns[name] for name in ("dx_m", "dy_m", "dz_m")])
                sensor = work.scene.sensor(site.sensor, f"site {site.name}")
                yield SiteScan(
                    site,
                    Beams(site.pose, sensor, ends, columns.get("weight"), f"{RunFolder.scans.name}: site {site.name}"),
                )


def _cast_scans(work: StageContext, only: Collection[str] | None) -> Iterator[SiteScan]:
    scanner = work.remember("scanner", (RunFolder.statics.name,), lambda: _scanner(work.scene))
    for site in work.scene.sites:
        if only is None or site.name in only:
            scan = scanner.scan_site(site)
            yield SiteScan(scan.as_site(site.name, site.pole), Beams.of(scan))


def _scanner(scene: Scene) -> Scanner:
    """What scans the sites of a scene, each of which can stand where it is."""
    scanner = Scanner(scene)
    scanner.check(scene.sites)
    return scanner


class TargetScorer:
    """The vehicles of recorded frames, and what they are asked for. Threads may share one.

    Parameters
    ----------
    work
        Holds ``trajectories.parquet`` and the ``tpog.parquet`` that was counted from it.
    grid
        Its region of interest is where vehicles are to be seen.

    Raises
    ------
    InputError
        When one of these scores is to rank the sites, and no vehicle counts.
    """

    def __init__(self, work: StageContext, grid: Grid) -> None:
        wanted, trajectories, tpog = work.scenario.score, work.folder.trajectories, work.folder.tpog
        self.record = TargetRecord.read(trajectories, grid, people=weighted_people(wanted.weights))
        self._scene = work.scene
        self._names: tuple[str, ...] = tuple(name for name in wanted.additional if name in TARGET_SCORES)
        periods, recorded = read_periods(tpog), recorded_frames(trajectories)
        in_mix = weights_in_mix(periods, recorded, self.record)
        self._by_choice = target_weights(wanted.weights, self.record) if wanted.weights.are_given else None
        self._weight = in_mix if self._by_choice is None else in_mix * self._by_choice
        self._weights = wanted.weights
        self._groups = FrameGroups.read(tpog, trajectories, self.record) if wanted.standard_error else None
        self.spots = vehicle_spots(work, self.record, recorded, in_mix) if wanted.blindspots else None
        self._periods = _rows_of_periods(periods, recorded, self.record)
        if self.is_empty and wanted.rank_by in TARGET_SCORES:
            place = f"{work.scenario.file}: score.rank_by = {wanted.rank_by!r}"
            raise InputError(
                place, self._no_vehicles_text, 'traffic that passes the region of interest, or rank_by = "egvs"'
            )

    @property
    def is_empty(self) -> bool:
        """Whether no vehicle counts."""
        return not math.fsum(self._weight) > 0.0

    def see(self, beams: Beams) -> VisibleTargets:
        """What an empty scan sees of each vehicle."""
        return visible_targets(self.record, beams, detection_probability(self._scene, beams.sensor))

    @property
    def counts(self) -> Floats:
        """How much each vehicle-frame counts in a score, (n,) float64."""
        return self._weight

    def counts_by_period(self) -> dict[str, Floats]:
        """The same in the scores of each period alone, by name; empty where there are none."""
        counts = {}
        for name, rows in self._periods:
            counts[name] = np.zeros(len(self.record))
            counts[name][rows] = 1.0 if self._by_choice is None else self._by_choice[rows]
        return counts

    def scores(self, visible: VisibleTargets) -> SiteTargetScores:
        """The scores that are asked for, of what a site sees, and where it misses vehicles."""
        worths = {name: TARGET_SCORES[name](visible) for name in self._names}
        whole = {name: self._means(worth) for name, worth in worths.items()}
        apart = ({name: self._mean_of(worth, rows) for name, worth in worths.items()} for _, rows in self._periods)
        return SiteTargetScores(
            whole, tuple(apart), self.spots.visibility(visible.points) if self.spots is not None else None
        )

    def undefined_score_warnings(self, tpog: Tpog, by_period: Sequence[Tpog]) -> list[Diagnostic]:
        """A warning where scores are no numbers though the region has traffic, at all or in a period; that it has none
        is told where traffic is counted."""
        names = " and ".join(self._names)
        if not names or not tpog.counts.any():
            return []
        cure, idle = (
            "the region of interest should hold the road",
            list(warn_unused_weights(self._weights, self.record)),
        )
        if self.is_empty:
            return [
                Diagnostic(
                    "no vehicles", f"{SCENARIO_FILE}: roi", f"{self._no_vehicles_text}: {names} is no number", cure
                ),
                *idle,
            ]
        return idle + [
            Diagnostic(
                "no vehicles",
                f"{SCENARIO_FILE}: traffic.periods ({name})",
                f"{self._no_vehicles_text}: {names} is no number",
                cure,
            )
            for (name, rows), its in zip(self._periods, by_period, strict=True)
            if not self._counts(rows) and its.counts.any()
        ]

    @property
    def _no_vehicles_text(self) -> str:
        counts = "" if self._by_choice is None or not len(self.record) else " that counts by [score.weights]"
        frames = f"in the {len(self.record.numbers)} frames looked at"
        return f"no vehicle{counts} has its centre in the region of interest {frames}"

    def _means(self, values: Floats) -> Floats:
        if self._groups is None:
            return np.array([weighted_mean(values, self._weight)])
        return self._groups.means(values, self._by_choice)

    def _mean_of(self, values: Floats, rows: slice) -> float:
        """Of some vehicle-frames by themselves."""
        return weighted_mean(values[rows], None if self._by_choice is None else self._by_choice[rows])

    def _counts(self, rows: slice) -> bool:
        """Whether any of these vehicle-frames does."""
        return bool(self._weight[rows].any())


def _rows_of_periods(
    periods: tuple[PeriodBlocks, ...], recorded: list[int], record: TargetRecord
) -> tuple[tuple[str, slice], ...]:
    """The vehicle-frames of each period; none where there are no periods."""
    ends = np.searchsorted(record.numbers[record.frame], np.append(0, np.cumsum(recorded))).tolist()
    named = zip(periods, ends[:-1], ends[1:], strict=True)
    return tuple((period.name, slice(a, b)) for period, a, b in named if period.name)


@dataclass(frozen=True)
class ScoredSite:
    """A site, its scores, and what else was asked for: an audit of its beams, its hits in the voxels that it sees."""

    site: ScannedSite
    score: SiteScore
    targets: SiteTargetScores | None
    audit: BeamAudit | None
    visible: dict[str, NDArray[Any]] | None


@dataclass(frozen=True)
class BeamAudit:
    """The worst of some beams, see :func:`egvs.kernels.traversal.audit_beams`."""

    worst_sum: float
    longest_gap_m: float
    misplaced_chords: int
    voxels_visited_twice: int


class SiteScoring:
    """What all sites of a run's folder are scored against, read once. Threads may share one.

    Parameters
    ----------
    work
        Holds ``tpog.parquet``, ``statics.ply``, ``scans.parquet`` where scans are kept, and ``trajectories.parquet``.
    audit
        Check each beam as well, see :func:`audit_beams`.
    """

    def __init__(self, work: StageContext, *, audit: bool = False) -> None:
        wanted = work.scenario.score
        self.work, self._audit, self._keep_visibility = work, audit, wanted.keep_visibility
        self.tpog = read_tpog(work.folder.tpog)
        self.leave_out = BlockJackknife.of(work.folder.tpog, self.tpog) if wanted.standard_error else None
        self.periods = period_tpogs(work.folder.tpog, standard_errors=wanted.standard_error)
        self.scorer = Scorer(work.scene, self.tpog, work.folder.trajectories, self.leave_out, self.periods)
        self.targets = TargetScorer(work, self.tpog.grid) if needs_targets(work.scenario) else None

    @property
    def names(self) -> tuple[str, ...]:
        """The sites, in order."""
        return tuple(site.name for site in self.work.scene.sites)

    def all_sites(self, only: Collection[str] | None = None) -> Iterator[ScoredSite]:
        """The sites in order, on the workspace's threads; of those named in ``only``, or of all."""
        return map_ordered(self.score, empty_scans(self.work, only), self.work.threads)

    def score(self, scan: SiteScan) -> ScoredSite:
        """Score one scan."""
        checked = audit_beams(scan.beams, self.tpog.grid) if self._audit else None
        its = self.targets.scores(self.targets.see(scan.beams)) if self.targets is not None else None
        if self._keep_visibility == "all" or scan.site.name in self._keep_visibility:
            worth, hits = self.scorer.score_and_hits(scan.beams)
            return ScoredSite(scan.site, worth, its, checked, _sparse_hits(hits))
        return ScoredSite(scan.site, self.scorer.score(scan.beams), its, checked, None)


def needs_targets(scenario: Scenario) -> bool:
    """Whether something is asked for that looks at the vehicles of recorded frames."""
    return scenario.score.blindspots or any(name in TARGET_SCORES for name in scenario.score.additional)


def audit_beams(beams: Beams, grid: Grid) -> BeamAudit:
    """Check each beam of a site, see :func:`egvs.kernels.traversal.audit_beams`."""
    o, d, shape = to_voxel_units(beams, grid)
    return BeamAudit(
        *traversal.audit_beams(o, d, shape, grid.voxel_m, np.zeros(int(np.prod(grid.shape)), dtype=np.uint32))
    )


def _sparse_hits(hits: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """The voxels that are crossed, in order."""
    ix, iy, iz = np.nonzero(hits)
    index = {"ix": ix.astype(np.int32), "iy": iy.astype(np.int32), "iz": iz.astype(np.int32)}
    return {**index, "hits": hits[ix, iy, iz]}


class SiteOutputs:
    """Writes both files. Made by :func:`write_site_outputs`."""

    def __init__(self, files: ExitStack, visibility: Path, spots: SpotWriter | None) -> None:
        self._files, self._path, self._spots = files, visibility, spots
        self._visibility: ArtefactWriter | None = None

    def take(self, site: ScoredSite) -> ScoredSite:
        """Write what is kept of a site; the site without that."""
        if site.visible is not None:
            if self._visibility is None:
                self._visibility = self._files.enter_context(parquet.artefact_writer(self._path, "visibility"))
            self._visibility.write({"site": [site.site.name] * len(site.visible["hits"]), **site.visible})
        targets = site.targets
        if self._spots is not None and targets is not None and targets.missed is not None:
            self._spots.add(site.site.name, targets.missed)
            targets = replace(targets, missed=None)
        return replace(site, visible=None, targets=targets)

    def describe(self, metadata: dict[str, Any]) -> None:
        """Set the metadata of what was written."""
        for file in (self._visibility, self._spots):
            if file is not None:
                file.describe(metadata)


@contextmanager
def write_site_outputs(work: StageContext, targets: TargetScorer | None, sites: int) -> Iterator[SiteOutputs]:
    """Open the files that are asked for, for so many sites; they appear when the block ends well, and those of before
    go."""
    visibility, blindspots = work.folder.visibility, work.folder.blindspots
    with ExitStack() as files:
        spots = None
        if targets is not None and targets.spots is not None:
            mixed = bool(work.scenario.traffic.periods)
            spots = files.enter_context(open_spot_writer(blindspots, targets.spots, sites, mixed=mixed))
        its = SiteOutputs(files, visibility, spots)
        yield its
        for path, file in ((visibility, its._visibility), (blindspots, spots)):
            if file is None:
                path.unlink(missing_ok=True)
