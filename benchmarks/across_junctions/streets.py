"""The level of ``expected_detections`` on simulated streets: ``python -m benchmarks.across_junctions levels``.

The models were fitted in worlds with few sizes of vehicles, without losses of returns, and mostly level. The junctions
of ``streets.toml`` have the fleet of a labelled street, slopes, people beside vehicles, street furniture, and losses of
returns by the program's rule. At some of them models may be fitted; the level error is quoted at the others, which have
other roads and no size of vehicle in common.

Every vehicle-frame of unseen traffic is seen from each candidate: its features, from the boxes and the empty scan, as a
run computes them; and whether each installed detector finds it in the simulated sweep, as in
:func:`benchmarks.across_junctions.detections.hits_of`. *Expected* is the mean probability of a model over all vehicle-
frames, *found* the share found of the same; so the error contains no difference between two records of traffic.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.across_junctions.build import candidates_of
from benchmarks.across_junctions.candidates import with_sites
from benchmarks.across_junctions.detections import AP, hits_of, measures_of
from benchmarks.across_junctions.protocol import FOLDER, Junction, Protocol
from benchmarks.across_junctions.records import read_table, write_table
from benchmarks.across_junctions.worlds import make_world
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation.detection_metrics import BLOCKS, frame_blocks
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME, DetectedBoxes, PointCounts
from egvs.extensions.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.scenario.loading import load
from egvs.scoring.noticed import group_members
from egvs.scoring.target_scores import FEATURES, detectability_features
from egvs.scoring.targets import TargetRecord, VisibleTargets, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene

STREETS_FILE = FOLDER / "streets.toml"

CANDIDATES = 24
"""The first of the candidates of each junction are measured."""

GROUPS = ("cars", "larger vehicles")
"""Groups of road users (:func:`egvs.scoring.noticed.group_members`) in the order of their numbers in tables."""

SIZES = ("length", "width", "height")
"""Columns of sizes, in metres."""

_FEATURE_COLUMNS = tuple(f"feature {name}" for name in FEATURES)


@dataclass(frozen=True, eq=False)
class StreetRows:
    """All vehicle-frames of a junction as its candidates see them; m candidates with n vehicle-frames each.

    Attributes
    ----------
    junction
        Name.
    sites, sensors
        Of the candidates.
    features
        As :data:`egvs.scoring.target_scores.FEATURES`, (m, n, f) float64.
    hits
        By detector: share of the two views in which each vehicle was found, (m, n) float64.
    ap
        By detector: the mean AP R40 at IoU 0.7 of each candidate, (m,) float64.
    group
        Index into :data:`GROUPS` of each vehicle-frame, (n,) int64.
    block
        Block of frames of each vehicle-frame, (n,) int64.
    size_m
        Length, width and height of each vehicle-frame, (n, 3) float64.
    points
        Points on each in the sweep, (m, n) float64.
    """

    junction: str
    sites: tuple[str, ...]
    sensors: tuple[str, ...]
    features: FloatArray
    hits: Mapping[str, FloatArray]
    ap: Mapping[str, FloatArray]
    group: NDArray[np.int64]
    block: NDArray[np.int64]
    size_m: FloatArray
    points: FloatArray


def shortened(protocol: Protocol, frames: int | None) -> Protocol:
    """Return the protocol with fewer frames at all junctions, for a trial."""
    if frames is None:
        return protocol
    junctions = tuple(junction.model_copy(update={"frames": None}) for junction in protocol.junctions)
    return protocol.model_copy(update={"frames": frames, "training_frames": frames, "junctions": junctions})


def measure(
    protocol: Protocol,
    junction: Junction,
    folder: Path,
    *,
    losses: bool = True,
    candidates: int = CANDIDATES,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> StreetRows:
    """Return what the candidates of a junction see, and what detectors find there, unless it was measured before.

    Parameters
    ----------
    folder
        For worlds and records.
    losses
        Whether losses of returns are simulated where the program's rule calls for them; never otherwise.
    candidates
        How many of the candidates are measured.
    """
    record = folder / (junction.name + ("" if losses else ".without_losses"))
    if not record.with_suffix(f"{record.suffix}.sites.parquet").is_file():
        _measure(protocol, junction, folder / "worlds", record, losses, candidates, jobs, progress)
    return read_rows(junction.name, record)


def _measure(
    protocol: Protocol, junction: Junction, worlds: Path, record: Path, losses: bool, count: int, jobs: int | None,
    progress: ProgressCallback,
) -> None:  # fmt: skip
    scenario = load(make_world(protocol, junction, None, worlds), [] if losses else ["effects.range_limit=false"])
    candidates = list(candidates_of(protocol, junction, scenario, worlds))[:count]
    detectors = {name: base.make_detector(name) for name in protocol.detectors_of(junction)}
    with tempfile.TemporaryDirectory(prefix=".work-", dir=worlds) as temporary:
        scenario = with_sites(scenario, candidates, Path(temporary) / "sites.csv")
        held_out = prepare_held_out_traffic(
            scenario, Path(temporary) / "unseen", protocol.frames_of(junction), apart_s=protocol.apart_s, jobs=jobs
        )
        frames = list(held_out.read())
        targets = TargetRecord.of(frames, held_out.scenario.roi.grid)
        features = np.stack([detectability_features(seen) for seen in visible_from_sites(held_out.scene, targets)])
        results = run_detectors(held_out.scene.sites, SiteDetectionTask(held_out, detectors), jobs=jobs,
                                progress=progress)  # fmt: skip
        boxes = [frame.boxes[frame.target_rows(held_out.scene.roi)] for frame in frames]
        hits: dict[str, list[FloatArray]] = {name: [] for name in detectors}
        ap: dict[str, list[float]] = {name: [] for name in detectors}
        points: list[FloatArray] = []
        for by_detector in results.values():
            counted = by_detector[POINT_COUNTS_NAME]
            assert isinstance(counted, PointCounts)
            points.append(np.concatenate(counted.points).astype(np.float64))
            for name in detectors:
                found = by_detector[name]
                assert isinstance(found, DetectedBoxes)
                hits[name].append(hits_of(boxes, [each.boxes for each in found.frames]))
                ap[name].append(measures_of(frames, counted, found, held_out)[AP][0])
    members = group_members(targets)
    group = np.select([members[name] for name in GROUPS], range(len(GROUPS)), default=-1)
    rows: dict[str, object] = {
        "site": np.repeat([site.name for site in candidates], len(targets)),
        "group": np.tile(group, len(candidates)),
        "block": np.tile(frame_blocks(len(frames), BLOCKS)[targets.frame], len(candidates)),
    }
    rows |= {name: np.tile(targets.boxes[:, 3 + axis], len(candidates)) for axis, name in enumerate(SIZES)}
    rows |= {"points": np.concatenate(points)} | {name: np.concatenate(each) for name, each in hits.items()}
    rows |= dict(zip(_FEATURE_COLUMNS, features.reshape(-1, len(FEATURES)).T, strict=True))
    write_table(record.with_suffix(f"{record.suffix}.rows.parquet"), rows)
    sites = {"site": [site.name for site in candidates], "sensor": [site.sensor for site in candidates], **ap}
    write_table(record.with_suffix(f"{record.suffix}.sites.parquet"), sites)


def visible_from_sites(scene: Scene, targets: TargetRecord) -> Iterator[VisibleTargets]:
    """Yield what each site of a scene sees of the vehicle-frames of a record."""
    scanner = Scanner(scene)
    for site in scene.sites:
        beams = Beams.of(scanner.scan_site(site))
        yield visible_targets(targets, beams, ReturnProbability.of(scene, beams.sensor))


def read_rows(junction: str, record: Path) -> StreetRows:
    """Return what :func:`measure` wrote."""
    sites = read_table(record.with_suffix(f"{record.suffix}.sites.parquet")).to_pydict()
    rows = read_table(record.with_suffix(f"{record.suffix}.rows.parquet"))
    shape = len(sites["site"]), rows.num_rows // len(sites["site"])
    column = {name: rows[name].to_numpy() for name in rows.column_names if name != "site"}
    names = [name for name in sites if name not in ("site", "sensor")]
    return StreetRows(
        junction, tuple(sites["site"]), tuple(sites["sensor"]),
        np.stack([column[name] for name in _FEATURE_COLUMNS], axis=-1).reshape(*shape, len(FEATURES)),
        {name: column[name].reshape(shape) for name in names}, {name: np.array(sites[name]) for name in names},
        column["group"][: shape[1]], column["block"][: shape[1]],
        np.column_stack([column[name][: shape[1]] for name in SIZES]), column["points"].reshape(shape),
    )  # fmt: skip
