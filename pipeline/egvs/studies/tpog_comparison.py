r"""Compare the traffic of two runs: a recorded TPOG with a simulated one.

Columns of voxels are assigned to the nearest lane in whose strip they are, and to bins of :data:`BIN_M` along it. With
p(c) the share of frames in which the lowest voxels of column c are occupied, at whatever height most often, the
occupancy of a bin is the mean of its columns.

- **Distance** of a lane: the Jensen-Shannon distance (Endres and Schindelin 2003) between the two distributions Q of
  occupancy over its bins, each with the sum 1; M is their mean, logarithms are to base 2:

  .. math:: d = \sqrt{\tfrac12 \sum_i Q_i \log_2 (Q_i / M_i) + \tfrac12 \sum_i Q'_i \log_2 (Q'_i / M_i)}

  It tells where along the lane vehicles are, from 0 (the same) to 1 (never in the same bin). How many there are is a
  number of its own: the mean occupancy of the lane.
- **Entropy**: the sum over its voxels, bits.
- **Ranks**: Kendall's tau-b over the sites of the same name, by the score that ranks, and the share of the best
  recorded score that is lost at the best simulated site.

Standard errors and biases come from the block jackknife over both records together
(:mod:`egvs.scoring.standard_errors`). Entropy is biased low, and distance high, in short records.

Only columns that the recording covered count, except in the ranks: scores are those of the runs. World frame, metres.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.report.basemap import network_file, roads_within, world_outlines
from egvs.report.maps import Backdrop
from egvs.report.ranking import RankedSite, Ranking
from egvs.report.svg_figures import extent
from egvs.runs.stage_registry import recorded_digests
from egvs.scenario.loading import scenario_from_dict
from egvs.scoring.road_locations import LANE, TURN, RoadLocations, disambiguate
from egvs.scoring.standard_errors import BlockGroups, BlockJackknife, ScoreUncertainty
from egvs.stages.base import StageContext
from egvs.stages.inputs import open_folder
from egvs.studies.paired_errors import SiteReplicates, read_replicates
from egvs.studies.score_errors import rank_agreement, regret
from egvs.traffic import network, recorded_tracks
from egvs.world import geolocation

BIN_M = 2.5
"""Length of a bin along a lane."""

MIN_BINS = 3
"""A lane with fewer bins in the region is left out."""


@dataclass(frozen=True)
class Measured:
    """A value, its standard error and its bias; the last two are None where they are unknown."""

    value: float
    se: float | None = None
    bias: float | None = None


@dataclass(frozen=True)
class LaneComparison:
    """A lane, or a turn in a junction.

    Attributes
    ----------
    name, words
        SUMO's id, and a description.
    occupancy
        Mean occupancy, recorded and simulated.
    distance
        Jensen-Shannon distance; None where a run has no traffic on the lane.
    entropy_bit
        Entropy of its voxels, recorded and simulated.
    """

    name: str
    words: str
    occupancy: tuple[Measured, Measured]
    distance: Measured | None
    entropy_bit: tuple[Measured, Measured]


@dataclass(frozen=True)
class RankComparison:
    """Ranks of the sites.

    Attributes
    ----------
    sites
        Number of common sites.
    tau
        Kendall's tau-b.
    lost
        Share of the best recorded score that is lost at the best simulated site.
    best
        The best site, recorded and simulated.
    note
        Why there are no standard errors; empty where there are some.
    """

    sites: int
    tau: Measured
    lost: Measured
    best: tuple[str, str]
    note: str


@dataclass(frozen=True)
class TpogComparison:
    """Two runs.

    Attributes
    ----------
    folders
        The recorded and the simulated run.
    tpogs
        Their TPOGs.
    frames, blocks
        Number of frames of each, and of the groups of blocks that standard errors come from.
    covered_share
        Share of the area of the region's lanes that the recording covered.
    lanes
        By occupancy in the recording, the busiest first.
    distance
        Jensen-Shannon distance over the bins of all lanes.
    occupancy
        Mean occupancy of all lanes, recorded and simulated.
    entropy_bit
        Entropy of the covered voxels: recorded, simulated, and simulated minus recorded.
    ranks
        Agreement of the rankings; None with fewer than two common sites.
    backdrop
        Background of maps.
    """

    folders: tuple[Path, Path]
    tpogs: tuple[Tpog, Tpog]
    frames: tuple[int, int]
    blocks: tuple[int, int]
    covered_share: float
    lanes: tuple[LaneComparison, ...]
    distance: Measured
    occupancy: tuple[Measured, Measured]
    entropy_bit: tuple[Measured, Measured, Measured]
    ranks: RankComparison | None
    backdrop: Backdrop


@dataclass(frozen=True, eq=False)
class LaneBins:
    """Columns of the grid by lane.

    Attributes
    ----------
    lane
        Lane of each column, an index into ``names``, (nx * ny,) int64; -1 for none.
    bin
        Bin of each column, numbered over all lanes, (nx * ny,) int64; -1 for none.
    lane_of_bin
        Lane of each bin.
    names, words
        Id and description of each lane.
    """

    lane: IntArray
    bin: IntArray
    lane_of_bin: IntArray
    names: tuple[str, ...]
    words: tuple[str, ...]


def compare_tpogs(recorded: Path, simulated: Path, progress: ProgressCallback = no_progress) -> TpogComparison:
    """Compare two finished runs.

    Parameters
    ----------
    recorded, simulated
        Their folders. Regions and voxels must be equal.
    progress
        Called while sites are scored again.

    Raises
    ------
    InputError
        When a run is not finished or was changed, regions differ, or a network or blocks are missing.
    """
    runs = [_open_run(folder) for folder in (recorded, simulated)]
    paths = [run.folder.tpog for run in runs]
    tpogs = read_tpog(paths[0]), read_tpog(paths[1])
    if tpogs[0].grid != tpogs[1].grid:
        hint = "Use the same [roi] in both scenarios."
        raise InputError(simulated, f"its region or voxels differ from those of {recorded}", hint)
    jackknives = [_jackknife(path, tpog) for path, tpog in zip(paths, tpogs, strict=True)]
    covered = _covered_columns(runs[0], tpogs[0].grid)
    network_path = _network_file(runs)
    box = extent(tpogs[0].grid, ())
    backdrop = Backdrop(world_outlines(runs[0].world, box), roads_within(network_path, box))
    roads = network.read_net_xml(network_path)
    bins = lane_bins(roads, tpogs[0].grid, covered)
    on_lane = lane_bins(roads, tpogs[0].grid, np.ones_like(covered)).lane >= 0
    covered_share = float(covered[on_lane].mean()) if on_lane.any() else 0.0
    if not len(bins.names):
        raise InputError(recorded, "no lane is in the part of the region that the recording covered", "Check [roi].")
    statistics = [_Statistics.of(jackknife, bins, covered, tpogs[0].grid) for jackknife in jackknives]
    both = _Pair(statistics[0], statistics[1], jackknives[0].groups, jackknives[1].groups)

    occupancy = [both.single(which, lambda each: each.occupancy) for which in (0, 1)]
    entropy = [both.single(which, lambda each: each.lane_entropy_bit) for which in (0, 1)]
    distances = both.joint(lambda first, second: lane_distances(first.bins, second.bins, bins.lane_of_bin))
    lanes = []
    for number in np.argsort(-statistics[0].occupancy[:, 0], kind="stable").tolist():
        has_traffic = all(each.occupancy[number, 0] > 0 for each in statistics)
        lanes.append(
            LaneComparison(
                bins.names[number], bins.words[number], (occupancy[0][number], occupancy[1][number]),
                distances[number] if has_traffic else None, (entropy[0][number], entropy[1][number]),
            )
        )  # fmt: skip
    everywhere = np.zeros_like(bins.lane_of_bin)
    distance = both.joint(lambda first, second: lane_distances(first.bins, second.bins, everywhere))[0]
    mean = [both.single(which, lambda each: each.mean_occupancy)[0] for which in (0, 1)]
    totals = [both.single(which, lambda each: each.entropy_bit)[0] for which in (0, 1)]
    difference = both.joint(lambda first, second: second.entropy_bit - first.entropy_bit)[0]
    return TpogComparison(
        (recorded, simulated), tpogs, (tpogs[0].frames, tpogs[1].frames),
        (both.n_groups(0), both.n_groups(1)), covered_share, tuple(lanes), distance, (mean[0], mean[1]),
        (totals[0], totals[1], difference), _compare_ranks(recorded, simulated, progress), backdrop,
    )  # fmt: skip


def _open_run(folder: Path) -> StageContext:
    """Open a finished run; InputError if it has no scores, its scenario does not exist, or its TPOG was changed."""
    record, record_path = RunRecord.read(folder), RunFolder(folder).run_record
    if "score" not in record.stages:
        raise InputError(record_path, "expected a finished run, but the stage score was not run", "Run egvs run first.")
    source = Path(os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        raise InputError(record_path, f"the scenario folder {source} does not exist", "Move it back to where it was.")
    scenario = scenario_from_dict(record.scenario, source, str(record_path))
    context = open_folder(scenario, folder, recorded=recorded_digests(record))
    context.digests(RunFolder.tpog.name)  # refuses a file that was changed
    return context


def _jackknife(path: Path, tpog: Tpog) -> BlockJackknife:
    jackknife = BlockJackknife.of(path, tpog)
    if jackknife is None:
        raise InputError(path, "has one block, so there are no standard errors", "Set tpog.blocks to 10.")
    return jackknife


def _covered_columns(recorded: StageContext, grid: Grid) -> FloatArray:
    """Return 1 for each column (nx * ny,) that the recording covered, 0 otherwise."""
    covered = np.ones(grid.shape[0] * grid.shape[1])
    if recorded.scenario.traffic.tracks:
        world = geolocation.scenario_georeference(recorded.scenario)
        coverage = recorded_tracks.read_recorded_tracks(recorded.scenario, world).coverage
        if coverage is not None:
            covered = coverage.contains(_column_centres(grid)).astype(np.float64)
    return covered


def _column_centres(grid: Grid) -> FloatArray:
    """Return x, y of the middle of each column, (nx * ny, 2), world frame."""
    axes = [grid.origin_m[axis] + (np.arange(grid.shape[axis]) + 0.5) * grid.voxel_m for axis in (0, 1)]
    return np.column_stack([values.ravel() for values in np.meshgrid(*axes, indexing="ij")])


def _network_file(runs: Sequence[StageContext]) -> Path:
    for run in runs:
        path = network_file(run.folder.path)
        if path is not None:
            return path
    hint = "Set traffic.roads in its scenario, and repeat egvs run."
    raise InputError(runs[0].folder.path, "neither run has a network, so there are no lanes to compare", hint)


def lane_bins(roads: network.Network, grid: Grid, covered: FloatArray) -> LaneBins:
    """Assign the columns of a grid to lanes and bins.

    Parameters
    ----------
    roads
        The network.
    grid
        The grid.
    covered
        1 for columns that count, (nx * ny,).
    """
    locations = RoadLocations.of(roads, grid.roi)
    centres_m = _column_centres(grid)
    lane = np.full(len(centres_m), -1, dtype=np.int64)
    along_m = np.full(len(centres_m), np.nan)
    nearest_m = np.full(len(centres_m), np.inf)
    places = []
    for number, middle in enumerate(locations.lanes):
        owner = locations.locations_of_lane[number][0]
        places.append(owner if locations.locations[owner].by in (LANE, TURN) else -1)
        line = shapely.LineString(middle.points_m)
        low_m, high_m = middle.points_m.min(axis=0) - middle.width_m, middle.points_m.max(axis=0) + middle.width_m
        near = np.flatnonzero(((centres_m >= low_m) & (centres_m <= high_m)).all(axis=1) & (covered > 0))
        if not near.size or line.length == 0.0:
            continue
        points = shapely.points(centres_m[near])
        distance_m = shapely.distance(line, points)
        better = (distance_m <= middle.width_m / 2.0) & (distance_m < nearest_m[near])
        lane[near[better]], nearest_m[near[better]] = number, distance_m[better]
        along_m[near[better]] = shapely.line_locate_point(line, points[better])

    place = np.where(lane >= 0, np.array([*places, -1])[lane], -1)
    on_place = np.flatnonzero(place >= 0)
    keys = np.column_stack([place[on_place], lane[on_place], np.floor(along_m[on_place] / BIN_M)]).astype(np.int64)
    unique, number_of = np.unique(keys, axis=0, return_inverse=True)
    used, lane_of_bin, counts = np.unique(unique[:, 0], return_inverse=True, return_counts=True)
    is_long = counts[lane_of_bin] >= MIN_BINS
    new_bin = np.where(is_long, np.cumsum(is_long) - 1, -1)
    kept = np.flatnonzero(counts >= MIN_BINS)
    new_lane = np.full(used.size, -1, dtype=np.int64)
    new_lane[kept] = np.arange(kept.size)
    column_lane, column_bin = np.full(lane.size, -1, dtype=np.int64), np.full(lane.size, -1, dtype=np.int64)
    column_bin[on_place] = new_bin[number_of.ravel()]
    column_lane[on_place] = new_lane[lane_of_bin][number_of.ravel()]
    described = disambiguate([locations.locations[index] for index in used[kept]])
    return LaneBins(
        column_lane, column_bin, new_lane[lane_of_bin][is_long],
        tuple(each.name for each in described), tuple(each.words for each in described),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Statistics:
    """Numbers of one TPOG: of all frames, then with each group left out. Arrays are (n, 1 + k).

    Attributes
    ----------
    bins
        Occupancy of each bin.
    occupancy
        Mean occupancy of each lane.
    mean_occupancy
        Of all lanes, (1, 1 + k).
    lane_entropy_bit
        Entropy of the voxels of each lane.
    entropy_bit
        Entropy of all covered voxels, (1, 1 + k).
    """

    bins: FloatArray
    occupancy: FloatArray
    mean_occupancy: FloatArray
    lane_entropy_bit: FloatArray
    entropy_bit: FloatArray

    @classmethod
    def of(cls, jackknife: BlockJackknife, bins: LaneBins, covered: FloatArray, grid: Grid) -> _Statistics:
        column = jackknife.cells // grid.shape[2]
        columns = np.zeros((covered.size, jackknife.p.shape[1]))
        np.maximum.at(columns, column, jackknife.p[jackknife.classes])
        entropy = np.zeros_like(columns)
        np.add.at(entropy, column, jackknife.entropies_bit[jackknife.classes])
        on_lane = bins.lane >= 0
        lanes = bins.lane[on_lane]
        return cls(
            _means(columns[on_lane], bins.bin[on_lane], bins.lane_of_bin.size),
            _means(columns[on_lane], lanes, len(bins.names)),
            columns[on_lane].mean(axis=0, keepdims=True),
            _sums(entropy[on_lane], lanes, len(bins.names)),
            entropy[covered > 0].sum(axis=0, keepdims=True),
        )

    def replicate(self, number: int) -> _Statistics:
        """Return the numbers of one column only."""
        part = slice(number, number + 1)
        return _Statistics(
            self.bins[:, part], self.occupancy[:, part], self.mean_occupancy[:, part],
            self.lane_entropy_bit[:, part], self.entropy_bit[:, part],
        )  # fmt: skip


def _sums(values: FloatArray, group: IntArray, n_groups: int) -> FloatArray:
    sums = np.zeros((n_groups, values.shape[1]))
    np.add.at(sums, group, values)
    return sums


def _means(values: FloatArray, group: IntArray, n_groups: int) -> FloatArray:
    means: FloatArray = _sums(values, group, n_groups) / np.bincount(group, minlength=n_groups)[:, None]
    return means


def lane_distances(first: FloatArray, second: FloatArray, lane_of_bin: IntArray) -> FloatArray:
    """Return the Jensen-Shannon distance of each lane, (n_lanes, m); NaN for a lane without traffic.

    Parameters
    ----------
    first, second
        Occupancy of the bins, (n_bins, m) each.
    lane_of_bin
        Lane of each bin, (n_bins,).
    """
    n_lanes = int(lane_of_bin.max(initial=-1)) + 1
    with np.errstate(divide="ignore", invalid="ignore"):
        p, q = (values / _sums(values, lane_of_bin, n_lanes)[lane_of_bin] for values in (first, second))
        middle = (p + q) / 2.0
        terms = [np.where(part == 0.0, 0.0, part * np.log2(part / middle)) for part in (p, q)]
    divergence = _sums((terms[0] + terms[1]) / 2.0, lane_of_bin, n_lanes)
    distances: FloatArray = np.sqrt(np.clip(divergence, 0.0, 1.0))
    return distances


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two TPOGs with their groups of blocks."""

    first: _Statistics
    second: _Statistics
    first_groups: tuple[BlockGroups, ...]
    second_groups: tuple[BlockGroups, ...]

    def n_groups(self, which: int) -> int:
        """Return the number of groups of one TPOG."""
        return sum(len(groups.frames) for groups in (self.first_groups, self.second_groups)[which])

    def single(self, which: int, statistic: Callable[[_Statistics], FloatArray]) -> list[Measured]:
        """Return numbers of one TPOG."""
        groups = (self.first_groups, self.second_groups)[which]
        return measure(statistic((self.first, self.second)[which]), groups)

    def joint(self, statistic: Callable[[_Statistics, _Statistics], FloatArray]) -> list[Measured]:
        """Return numbers that depend on both TPOGs; groups are left out of one at a time."""
        all_first, all_second = self.first.replicate(0), self.second.replicate(0)
        values = [statistic(all_first, all_second)]
        values += [statistic(self.first.replicate(1 + k), all_second) for k in range(self.n_groups(0))]
        values += [statistic(all_first, self.second.replicate(1 + k)) for k in range(self.n_groups(1))]
        return measure(np.hstack(values), (*self.first_groups, *self.second_groups))


def measure(left_out: FloatArray, groups: tuple[BlockGroups, ...]) -> list[Measured]:
    """Return values with standard errors and biases.

    Parameters
    ----------
    left_out
        Values of all frames, then with each group left out, (n, 1 + k).
    groups
        The groups, k in all.
    """
    results = []
    for row in left_out:
        if not np.isfinite(row).all():
            results.append(Measured(float(row[0])))
            continue
        estimate = ScoreUncertainty.of(row[None], groups)
        results.append(Measured(float(row[0]), float(estimate.se[0]), float(estimate.bias[0])))
    return results


def _compare_ranks(recorded: Path, simulated: Path, progress: ProgressCallback) -> RankComparison | None:
    """Compare the rankings over the common sites."""
    rankings = [Ranking.read(folder / RunFolder.scores.name) for folder in (recorded, simulated)]
    sites: list[Mapping[str, RankedSite]] = [{site.site: site for site in ranking.sites} for ranking in rankings]
    names = [name for name in sites[0] if name in sites[1]]
    if len(names) < 2:
        return None
    scores = [np.array([by_name[name].score for name in names]) for by_name in sites]
    best = tuple(names[int(values.argmax())] for values in scores)
    replicates = []
    for number, (folder, by_name) in enumerate(zip((recorded, simulated), sites, strict=True)):
        progress("runs", number, 2)
        replicates.append(read_replicates(folder, {name: by_name[name] for name in names}))
    progress("runs", 2, 2)
    first, second = replicates
    if isinstance(first, str) or isinstance(second, str):
        note = next(text for text in replicates if isinstance(text, str))
        tau, lost = Measured(rank_agreement(scores[1], scores[0], "tau")), Measured(regret(scores[1], scores[0]))
        return RankComparison(len(names), tau, lost, (best[0], best[1]), note)
    values = _rank_replicates(_in_order(first, names), _in_order(second, names))
    tau, lost = measure(values, (*first.groups, *second.groups))
    return RankComparison(len(names), tau, lost, (best[0], best[1]), "")


def _in_order(replicates: SiteReplicates, names: list[str]) -> FloatArray:
    rows: FloatArray = replicates.values[[replicates.names.index(name) for name in names]]
    return rows


def _rank_replicates(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return tau and the lost share of all frames, then with each group left out of one run, (2, 1 + k + l)."""
    pairs = [(first[:, 0], second[:, 0])]
    pairs += [(first[:, number], second[:, 0]) for number in range(1, first.shape[1])]
    pairs += [(first[:, 0], second[:, number]) for number in range(1, second.shape[1])]
    return np.array(
        [
            [rank_agreement(simulated, recorded, "tau") for recorded, simulated in pairs],
            [regret(simulated, recorded) for recorded, simulated in pairs],
        ]
    )
