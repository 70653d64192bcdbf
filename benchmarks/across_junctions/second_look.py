"""The present score at junctions that were measured with an earlier one: a second look, which tests nothing.

``python -m benchmarks.across_junctions.second_look --data DATA --maps MAPS`` computes ``expected_detections`` again for
the recorded candidates that trained nothing, from the same traffic, and judges it by the recorded detections. It
prints, for the recorded and for the present score: Spearman's rho with AP, the mean of rho within heights, the regret,
the root mean square error of the level in the better half, and how much more is found than expected by sensor.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.across_junctions import calibration, statistics
from benchmarks.across_junctions.candidates import read_candidates
from benchmarks.across_junctions.detections import AP
from benchmarks.across_junctions.measurement import Extent, PartPlan
from benchmarks.across_junctions.protocol import (
    CANDIDATES_FILE,
    Junction,
    Protocol,
    ProtocolFiles,
    of_junction,
    read_protocol,
)
from benchmarks.across_junctions.records import SCORES, JunctionRecord, junction_names, read_junction
from benchmarks.across_junctions.worlds import make_world
from benchmarks.validity.junctions import with_sites
from egvs.core.grid import FloatArray
from egvs.scoring.target_scores import DETECTORS
from egvs.validation import surrogates
from egvs.validation.results import ScoreName

SCORE = "expected_detections"
MAIN = f"{SCORE} (detectors {'+'.join(DETECTORS)})"


@dataclass(frozen=True)
class Judgement:
    """How a score does at one junction, judged by one detector.

    Attributes
    ----------
    rho, rho_within_heights
        Spearman's rho with AP; the mean within heights, weighted by candidates.
    regret
        AP lost by the score's first candidate, in points of 100.
    level_error
        Root mean square of expected minus found, in the better half of the candidates, in points of 100.
    surplus
        Found minus expected, in points of 100, by sensor.
    """

    rho: float
    rho_within_heights: float
    regret: float
    level_error: float
    surplus: Mapping[str, float]


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.across_junctions.second_look")
    parser.add_argument("--data", type=Path, required=True, help="folder with records and worlds")
    parser.add_argument("--maps", type=Path, help="folder of the maps that are not shipped")
    parser.add_argument("--jobs", type=int, help="threads; default: one a core")
    given = parser.parse_args(words)
    protocol = read_protocol()
    recorded: dict[tuple[str, str], Judgement] = {}
    present: dict[tuple[str, str], Judgement] = {}
    print("| junction | detector | rho | within heights | regret | level |")
    print("|---|---|---:|---:|---:|---:|")
    for name in junction_names(given.data / "records"):
        junction = protocol.junction(name)
        record = read_junction(given.data / "records", name)
        if junction.role == "training" or SCORES not in record.infos:
            continue
        scores = compute_score(protocol, junction, given.maps, given.data / "worlds", given.jobs)
        for detector in record.detections:
            recorded[name, detector] = judge(record, detector)
            present[name, detector] = judge(replace(record, scores=scores), detector)
            print(_row(name, detector, recorded[name, detector], present[name, detector]), flush=True)
    held_out = [key for key in recorded if protocol.junction(key[0]).role == "held out"]
    print()
    print("\n".join(_over_junctions(held_out, recorded, present)))


def compute_score(
    protocol: Protocol, junction: Junction, maps: Path | None, worlds: Path, jobs: int | None = None
) -> dict[str, FloatArray]:
    """Return the present score of each candidate by choice of detectors, (n,) float64.

    Raises
    ------
    InputError
        As :func:`benchmarks.across_junctions.worlds.make_world` and a run.
    """
    candidates = of_junction(read_candidates(), junction, CANDIDATES_FILE)
    folder = make_world(protocol, junction, maps, worlds)
    plan = PartPlan(
        protocol, ProtocolFiles().digest, junction, SCORES, folder, candidates, Extent.of(protocol, junction), worlds
    )
    with tempfile.TemporaryDirectory() as temporary:
        scenario = with_sites(plan.load_scenario(), list(candidates), Path(temporary) / "sites.csv")
        scored = surrogates.compute_surrogates(scenario, Path(temporary) / "scores", (SCORE,), jobs=jobs)
    values: dict[str, dict[str, float]] = {}
    for row in scored.rows:
        values.setdefault(str(ScoreName(row.score, row.parameters_json)), {})[row.site] = row.sign * row.value
    return {name: np.array([by_site[site.name] for site in candidates]) for name, by_site in values.items()}


def judge(record: JunctionRecord, detector: str) -> Judgement:
    """Judge the main score of a record by one of its detectors."""
    score, ap = record.scores[MAIN], record.detections[detector][AP].values
    heights, count = np.unique(record.height_m, return_counts=True)
    within = [_rho(score[record.height_m == height], ap[record.height_m == height]) for height in heights]
    level = calibration.level(record, (detector,), MAIN)
    surplus = level.found - level.expected
    sensors = np.array(record.sensors)
    return Judgement(
        _rho(score, ap),
        float(np.average(within, weights=count)),
        float(statistics.regret(score[None, :], ap[None, :])[0]),
        level.rms_error,
        {str(name): float(surplus[sensors == name].mean()) for name in np.unique(sensors)},
    )


def _rho(score: FloatArray, ap: FloatArray) -> float:
    return float(statistics.rho(score[None, :], ap[None, :])[0])


def _row(junction: str, detector: str, recorded: Judgement, present: Judgement) -> str:
    cells = [
        f"{recorded.rho:.3f} → {present.rho:.3f}",
        f"{recorded.rho_within_heights:.3f} → {present.rho_within_heights:.3f}",
        f"{recorded.regret:.1f} → {present.regret:.1f}",
        f"{recorded.level_error:.1f} → {present.level_error:.1f}",
    ]
    return f"| {junction} | `{detector}` | {' | '.join(cells)} |"


def _over_junctions(
    keys: Sequence[tuple[str, str]],
    recorded: Mapping[tuple[str, str], Judgement],
    present: Mapping[tuple[str, str], Judgement],
) -> Iterator[str]:
    """Yield means over the held-out junctions, and the surplus of each sensor."""
    yield "| detector | mean rho | within heights | median regret | worst | mean level error |"
    yield "|---|---:|---:|---:|---:|---:|"
    detectors = list(dict.fromkeys(detector for _, detector in keys))
    for detector in detectors:
        pair = [[each[key] for key in keys if key[1] == detector] for each in (recorded, present)]
        cells = [
            " → ".join(f"{np.mean([j.rho for j in each]):.3f}" for each in pair),
            " → ".join(f"{np.mean([j.rho_within_heights for j in each]):.3f}" for each in pair),
            " → ".join(f"{np.median([j.regret for j in each]):.1f}" for each in pair),
            " → ".join(f"{max(j.regret for j in each):.1f}" for each in pair),
            " → ".join(f"{np.mean([j.level_error for j in each]):.1f}" for each in pair),
        ]
        yield f"| `{detector}` | {' | '.join(cells)} |"
    yield ""
    yield f"| found minus expected | {' | '.join(f'`{detector}`' for detector in detectors)} |"
    yield f"|---|{'---:|' * len(detectors)}"
    for sensor in recorded[keys[0]].surplus:
        cells = [
            " → ".join(
                f"{np.mean([each[key].surplus[sensor] for key in keys if key[1] == detector]):+.1f}"
                for each in (recorded, present)
            )
            for detector in detectors
        ]
        yield f"| {sensor} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
