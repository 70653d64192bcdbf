r"""Compare the traffic of two runs: a recorded TPOG with a simulated one.

Columns of voxels are assigned to the nearest lane in whose strip they are, and to bins along it
(:mod:`egvs.extensions.tracks.comparison.lane_bins`). With p(c) the share of frames in which column c is occupied, at
the height where that is most often, the occupancy of a bin is the mean of its columns.

- **Distance** of a lane: the Jensen-Shannon distance (Endres and Schindelin 2003) between the two distributions Q of
  occupancy over its bins, each with the sum 1; M is their mean, logarithms are to base 2:

  .. math:: d = \sqrt{\tfrac12 \sum_i Q_i \log_2 (Q_i / M_i) + \tfrac12 \sum_i Q'_i \log_2 (Q'_i / M_i)}

  It tells where along the lane vehicles are, from 0 (the same) to 1 (never in the same bin). How many there are is a
  number of its own: the mean occupancy of the lane.
- **Entropy**: the sum over its voxels, bits.
- **Speeds** (:mod:`egvs.extensions.tracks.comparison.lane_speeds`): mean, and Wasserstein distance of the two
  distributions.
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

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid
from egvs.core.progress import ProgressCallback, no_progress
from egvs.drawing.basemap import network_file, roads_within, world_outlines
from egvs.drawing.maps import Backdrop
from egvs.drawing.svg_figures import extent
from egvs.extensions.tracks.comparison import lane_speeds
from egvs.extensions.tracks.comparison.lane_bins import (
    LaneBins,
    column_centres_m,
    lane_bins,
    lane_distances,
    mean_groups,
    sum_groups,
)
from egvs.results.ranking import RankedSite, Ranking
from egvs.runs.run_context import open_folder
from egvs.runs.stage_registry import recorded_digests
from egvs.scenario.loading import scenario_from_dict
from egvs.scoring.standard_errors import BlockGroups, BlockJackknife, ScoreUncertainty
from egvs.stages.base import StageContext
from egvs.statistics.ranks import rank_agreement, regret
from egvs.studies.paired_errors import SiteReplicates, read_replicates
from egvs.traffic import network, traffic_sources
from egvs.world import geolocation


@dataclass(frozen=True)
class Measured:
    """A value, its standard error and its bias; the last two are None where they are unknown."""

    value: float
    se: float | None = None
    bias: float | None = None


@dataclass(frozen=True, eq=False)
class SpeedComparison:
    """Speeds on a lane.

    Attributes
    ----------
    mean_m_s
        Mean, recorded and simulated.
    distance_m_s
        Wasserstein distance of the distributions.
    vehicles
        Number of vehicles, recorded and simulated.
    cumulative
        Share of speeds up to the end of each bin of :data:`lane_speeds.BIN_M_S`, recorded and simulated.
    """

    mean_m_s: tuple[Measured, Measured]
    distance_m_s: Measured
    vehicles: tuple[int, int]
    cumulative: tuple[FloatArray, FloatArray]


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
    speed
        Speeds of its vehicles; None with few vehicles, or where they are not compared.
    """

    name: str
    words: str
    occupancy: tuple[Measured, Measured]
    distance: Measured | None
    entropy_bit: tuple[Measured, Measured]
    speed: SpeedComparison | None = None


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
        Jensen-Shannon distance over the bins of all lanes; None where a run has no traffic.
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
    distance: Measured | None
    occupancy: tuple[Measured, Measured]
    entropy_bit: tuple[Measured, Measured, Measured]
    ranks: RankComparison | None
    backdrop: Backdrop


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
    speeds = _compare_speeds(runs, bins, tpogs[0].grid, jackknives)
    lanes = []
    for number in np.argsort(-statistics[0].occupancy[:, 0], kind="stable").tolist():
        has_traffic = all(each.occupancy[number, 0] > 0 for each in statistics)
        lanes.append(
            LaneComparison(
                bins.names[number], bins.words[number], (occupancy[0][number], occupancy[1][number]),
                distances[number] if has_traffic else None, (entropy[0][number], entropy[1][number]),
                speeds.get(number),
            )
        )  # fmt: skip
    everywhere = np.zeros_like(bins.lane_of_bin)
    distance: Measured | None = both.joint(lambda first, second: lane_distances(first.bins, second.bins, everywhere))[0]
    if not all(each.mean_occupancy[0, 0] > 0 for each in statistics):
        distance = None
    mean = [both.single(which, lambda each: each.mean_occupancy)[0] for which in (0, 1)]
    totals = [both.single(which, lambda each: each.entropy_bit)[0] for which in (0, 1)]
    difference = both.joint(lambda first, second: second.entropy_bit - first.entropy_bit)[0]
    return TpogComparison(
        (recorded, simulated), tpogs, (tpogs[0].frames, tpogs[1].frames),
        (both.n_groups(0), both.n_groups(1)), covered_share, tuple(lanes), distance, (mean[0], mean[1]),
        (totals[0], totals[1], difference), _compare_ranks(recorded, simulated, progress), backdrop,
    )  # fmt: skip


def _compare_speeds(
    runs: Sequence[StageContext], bins: LaneBins, grid: Grid, jackknives: Sequence[BlockJackknife]
) -> dict[int, SpeedComparison]:
    """Compare the speeds on each lane with enough vehicles; on none where a run has several periods."""
    if any(len(jackknife.groups) > 1 for jackknife in jackknives):
        return {}
    periods_s = [
        float(parquet.read_metadata(run.folder.trajectories, "trajectories")["frame_period_s"]) for run in runs
    ]
    base_s = lane_speeds.common_interval_s(periods_s)
    first, second = (
        lane_speeds.read_lane_speeds(run.folder.trajectories, period_s, base_s, bins, grid, jackknife.groups[0])
        for run, period_s, jackknife in zip(runs, periods_s, jackknives, strict=True)
    )
    counts = first.replicates(), second.replicates()
    distances = [lane_speeds.speed_distances(counts[0][:, :, :1], counts[1][:, :, :1])]
    distances += [
        lane_speeds.speed_distances(counts[0][:, :, k : k + 1], counts[1][:, :, :1])
        for k in range(1, 1 + first.n_groups)
    ]
    distances += [
        lane_speeds.speed_distances(counts[0][:, :, :1], counts[1][:, :, k : k + 1])
        for k in range(1, 1 + second.n_groups)
    ]
    groups = jackknives[0].groups[0], jackknives[1].groups[0]
    measured = measure(np.hstack(distances), groups)
    means = [measure(each.means_m_s(), (of_run,)) for each, of_run in zip((first, second), groups, strict=True)]
    results = {}
    for lane in range(len(bins.names)):
        vehicles = int(first.vehicles[lane]), int(second.vehicles[lane])
        if min(vehicles) >= lane_speeds.MIN_VEHICLES:
            cumulative = first.cumulative(lane), second.cumulative(lane)
            results[lane] = SpeedComparison((means[0][lane], means[1][lane]), measured[lane], vehicles, cumulative)
    return results


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
        coverage = traffic_sources.source_of(recorded.scenario).record(recorded.scenario, world).coverage
        if coverage is not None:
            covered = coverage.contains(column_centres_m(grid)).astype(np.float64)
    return covered


def _network_file(runs: Sequence[StageContext]) -> Path:
    for run in runs:
        path = network_file(run.folder.path)
        if path is not None:
            return path
    hint = "Set traffic.roads in its scenario, and repeat egvs run."
    raise InputError(runs[0].folder.path, "neither run has a network, so there are no lanes to compare", hint)


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
            mean_groups(columns[on_lane], bins.bin[on_lane], bins.lane_of_bin.size),
            mean_groups(columns[on_lane], lanes, len(bins.names)),
            columns[on_lane].mean(axis=0, keepdims=True),
            sum_groups(entropy[on_lane], lanes, len(bins.names)),
            entropy[covered > 0].sum(axis=0, keepdims=True),
        )

    def replicate(self, number: int) -> _Statistics:
        """Return the numbers of one column only."""
        part = slice(number, number + 1)
        return _Statistics(
            self.bins[:, part], self.occupancy[:, part], self.mean_occupancy[:, part],
            self.lane_entropy_bit[:, part], self.entropy_bit[:, part],
        )  # fmt: skip


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
    return replicates.values[[replicates.names.index(name) for name in names]]


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
