"""What a right decision costs at each scenario, how that grows with the area, and predicted against measured loss.

``python -m benchmarks.decision_costs scenarios SCENARIO...`` studies scenarios as ``egvs accuracy --budget 2m`` does.
``... area SCENARIO`` studies one with other regions of interest around the same centre.
``... detectors SCENARIO...`` compares the loss of each mount in vehicles that it should find with the loss in AP of
what a detector finds from there.

With ``--markdown docs/accuracy.md`` each writes its rows to a table of the page; the other rows stay. All work is in
``--folder`` (runs/decisions), so an interrupted command continues. Seconds are processor seconds.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

import egvs
from benchmarks import page_tables
from benchmarks.page_tables import Cells
from egvs.artefacts import parquet
from egvs.core import files
from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.extensions.validation.files import DETECTION
from egvs.extensions.validation.held_out_traffic import FrameSampling
from egvs.extensions.validation.site_validation import validate_sites
from egvs.results.labels import SCORE_LABELS
from egvs.results.studies import SettingResult, Tolerance
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.sensors import sites
from egvs.studies.accuracy import AccuracyStudy, StudyOptions, run_accuracy_study
from egvs.studies.study_settings import DEFAULT_VALUES, SettingValues

TOLERANCE = Tolerance(1.0)
BUDGET_S = 120.0
ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "runs" / "decisions"
DATA = ROOT / "docs" / "data" / "predicted_loss.csv"
DETECTOR = "cluster"
FRAMES = 250
"""Frames in which a detector looks for vehicles."""

SEEDS = 4
"""Seeds of the traffic that predictions are from."""

SAMPLED_FRAMES = 750
"""Frames of each seed that predictions use."""

AREA_FACTORS = (0.25, 0.5, 1.0, 2.0)
"""Areas that are studied, as multiples of the scenario's."""

ONLY_FRAMES = SettingValues(
    traffic_factors=(), sampled_factors=(), frame_periods_s=(), steps_s=(), thinning_factors=(), voxels_m=(), gammas=(),
    detectors=False, unnamed_effects=False, traffic_options=False,
)  # fmt: skip
"""The scenario with all of its traffic, and with parts of it."""


# ---- scenarios

SCENARIO_MARKS = ("<!-- costs of scenarios -->", "<!-- end of costs of scenarios -->")
SCENARIO_HEADINGS = (
    "scenario", "mounts, poles", "ranks by", "frames", "seconds", "right", "loss", "cheapest within 1 point", "seconds",
    "right", "loss",
)  # fmt: skip


def format_share(probability: float) -> str:
    """Return a probability in per cent, e.g. ``"97 %"``."""
    return format_percent(probability, 0)


def study_scenario(path: Path, overrides: Sequence[str], out: Path, values: SettingValues) -> AccuracyStudy:
    """Run a study with one thread, so that seconds of stages are those of one core."""
    options = StudyOptions(TOLERANCE, BUDGET_S, jobs=1, values=values)
    return run_accuracy_study(path, overrides, out, options)


def price_cells(row: SettingResult) -> Cells:
    """Return seconds, probability and loss of a setting as text."""
    return f"{row.seconds:.1f}", format_share(row.probability), f"{row.loss_points:z.1f}"


def scenario_cells(scenario: Scenario, study: AccuracyStudy) -> Cells:
    """Return the row of a scenario."""
    candidates = sites.candidate_sites(scenario)
    poles = len({site.pole for site in candidates})
    label = SCORE_LABELS[study.rank_by]
    ranks_by = "vehicles found" if study.rank_by == DEFAULT_SCORE else label.noun
    cheapest = study.recommended.label if study.is_within else "none"
    best = price_cells(study.recommended) if study.is_within else ("", "", "")
    whole = price_cells(study.scenario)
    return (
        scenario.name,
        f"{len(candidates)}, {poles}",
        ranks_by,
        f"{study.scenario.frames:,}",
        *whole,
        cheapest,
        *best,
    )


def run_scenarios(paths: Sequence[Path], folder: Path, page: Path | None) -> None:
    """Study scenarios, and write the row of each as soon as it is known."""
    for path in paths:
        scenario = egvs.load(path)
        study = study_scenario(path, (), folder / f"{scenario.name}-costs", DEFAULT_VALUES)
        write_rows(
            page, SCENARIO_MARKS, SCENARIO_HEADINGS, [scenario_cells(scenario, study)], text_columns=(0, 1, 2, 7)
        )


# ---- area

AREA_MARKS = ("<!-- costs by area -->", "<!-- end of costs by area -->")
AREA_HEADINGS = (
    "scenario", "region, m", "ha", "seconds", "traffic", "tpog", "scan", "score", "right", "loss", "loss with a tenth",
)  # fmt: skip


def region_overrides(scenario: Scenario, factor: float) -> tuple[str, ...]:
    """Return the overrides that scale the area of the region of interest around its centre, to whole metres."""
    x_m, y_m, z_m = scenario.roi.size_m
    scale = math.sqrt(factor)
    return (f"roi.size_m=[{2 * round(x_m * scale / 2)}, {2 * round(y_m * scale / 2)}, {z_m:g}]",)


def area_cells(scenario: Scenario, study: AccuracyStudy) -> Cells:
    """Return the row of a region."""
    x_m, y_m, _ = scenario.roi.size_m
    row = study.scenario
    parts = [setting for setting in study.rows if setting.knob == "frames" and setting.frames < row.frames]
    shortest = min(parts, key=lambda setting: setting.frames)
    stages_s = (row.seconds, row.traffic_s, row.tpog_s, row.scan_s, row.score_s)
    return (
        scenario.name, f"{x_m:g} x {y_m:g}", f"{x_m * y_m / 1e4:.2f}", *(f"{value:.1f}" for value in stages_s),
        format_share(row.probability), f"{row.loss_points:z.2f}", f"{shortest.loss_points:z.2f}",
    )  # fmt: skip


def run_area(path: Path, folder: Path, page: Path | None) -> None:
    """Study a scenario with several regions of interest."""
    plain = egvs.load(path)
    for factor in AREA_FACTORS:
        overrides = region_overrides(plain, factor)
        study = study_scenario(path, overrides, folder / f"{plain.name}-area-{factor:g}", ONLY_FRAMES)
        cells = area_cells(egvs.load(path, overrides), study)
        write_rows(page, AREA_MARKS, AREA_HEADINGS, [cells], key_columns=2, text_columns=(0, 1))


# ---- detectors

DETECTOR_MARKS = ("<!-- predicted and measured loss -->", "<!-- end of predicted and measured loss -->")
DETECTOR_HEADINGS = (
    "scenario", "detector", "frames", "mounts", "AP per point", "correlation", "chosen", "loss of AP", "best by AP",
    "predicted loss",
)  # fmt: skip
DATA_COLUMNS = (
    "scenario", "detector", "mount", "found", "predicted_loss_points", "predicted_loss_se_points", "ap", "ap_se",
    "ap_loss_points",
)  # fmt: skip


@dataclass(frozen=True)
class MountLoss:
    """Predicted and measured loss of a mount, against the mount that should find most vehicles.

    Attributes
    ----------
    mount
        Its name.
    found
        Share of the vehicles that it should find, 0 to 1, mean over seeds.
    predicted_points, predicted_se_points
        What it finds less, in percentage points, and the standard error over the seeds.
    ap, ap_se
        AP of a detector, 0 to 1, and its standard error.
    measured_points
        What it detects less, in points of AP; below 0 if it detects more.
    """

    mount: str
    found: float
    predicted_points: float
    predicted_se_points: float
    ap: float
    ap_se: float
    measured_points: float


def mount_losses(found: Mapping[str, FloatArray], ap: Mapping[str, tuple[float, float]]) -> list[MountLoss]:
    """Compare mounts with the one that should find most vehicles, which comes first.

    Parameters
    ----------
    found
        Mount -> share of vehicles that it should find with each seed, (k,) float64.
    ap
        Mount -> AP and its standard error, 0 to 1. Mounts whose AP is NaN are left out.
    """
    means = {mount: float(shares.mean()) for mount, shares in found.items() if not math.isnan(ap[mount][0])}
    order = sorted(means, key=lambda mount: -means[mount])
    best = order[0]
    losses = []
    for mount in order:
        differences = 100.0 * (found[best] - found[mount])
        se = float(differences.std(ddof=1)) / math.sqrt(len(differences))
        measured = 100.0 * (ap[best][0] - ap[mount][0])
        losses.append(MountLoss(mount, means[mount], float(differences.mean()), se, *ap[mount], measured))
    return losses


def regression(losses: Sequence[MountLoss]) -> tuple[float, float]:
    """Return points of AP per predicted point (least squares through the origin), and Pearson's correlation."""
    x = np.array([loss.predicted_points for loss in losses])
    y = np.array([loss.measured_points for loss in losses])
    return float(x @ y / (x @ x)), float(np.corrcoef(x, y)[0, 1])


def detector_cells(name: str, detector: str, frames: int, losses: Sequence[MountLoss]) -> Cells:
    """Return the row of a scenario and a detector, which saw ``frames`` frames."""
    slope, correlation = regression(losses)
    chosen, best = losses[0], max(losses, key=lambda loss: loss.ap)
    lost = 100.0 * (best.ap - chosen.ap)
    lost_se = 100.0 * math.hypot(best.ap_se, chosen.ap_se) if best is not chosen else 0.0
    predicted = f"{best.predicted_points:z.1f} ± {best.predicted_se_points:.1f}"
    return (
        name, f"`{detector}`", f"{frames:,}", str(len(losses)), f"{slope:.2f}", f"{correlation:.2f}", chosen.mount,
        f"{lost:z.1f} ± {lost_se:.1f}", best.mount, predicted,
    )  # fmt: skip


def expected_shares(path: Path, folder: Path) -> dict[str, FloatArray]:
    """Run a scenario with several seeds, and return the share of vehicles that each mount should find, (k,) each."""
    scenario = egvs.load(path)
    by_seed = []
    for seed in range(scenario.seed, scenario.seed + SEEDS):
        frames = f"score.sampled_frames={SAMPLED_FRAMES}"
        overrides = [f"score.rank_by={DEFAULT_SCORE}", frames, f"seed={seed}"]
        egvs.run(egvs.load(path, overrides), folder / f"{scenario.name}-seed-{seed}")
        table = egvs.read_scores(folder / f"{scenario.name}-seed-{seed}" / "scores.parquet").to_pydict()
        by_seed.append(dict(zip(table["site"], table[DEFAULT_SCORE], strict=True)))
    return {mount: np.array([shares[mount] for shares in by_seed]) for mount in by_seed[0]}


class DetectorResults(NamedTuple):
    """Number of frames, and AP at IoU 0.7 (mean of BEV and 3D) of each mount with its standard error, 0 to 1."""

    frames: int
    ap: dict[str, tuple[float, float]]


def measure_ap(path: Path, folder: Path, frames: int) -> DetectorResults:
    """Return what a detector finds from each mount; the scenario is validated unless the folder has that already."""
    scenario = egvs.load(path, [f"score.rank_by={DEFAULT_SCORE}"])
    out = folder / scenario.name
    detection = out / DETECTION.name
    if not detection.is_file():
        validate_sites(scenario, out, sampling=FrameSampling(frames, None), detectors=(DETECTOR,))
    rows = parquet.read_artefact(detection, "detection")[0].to_pylist()
    chosen = [row for row in rows if row["detector"] == DETECTOR and row["objects_of"] == "vehicles"]
    ap = {row["site"]: (row["ap_mean_r40_iou70"], row["ap_mean_r40_iou70_se"]) for row in chosen}
    return DetectorResults(chosen[0]["frames"], ap)


def write_losses(name: str, losses: Sequence[MountLoss]) -> None:
    """Replace the rows of a scenario and the detector in the file of losses."""
    rows = []
    if DATA.is_file():
        with DATA.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if (row["scenario"], row["detector"]) != (name, DETECTOR)]
    for loss in losses:
        values = (
            loss.found,
            loss.predicted_points,
            loss.predicted_se_points,
            loss.ap,
            loss.ap_se,
            loss.measured_points,
        )
        cells = (name, DETECTOR, loss.mount, *(f"{value:z.4f}" for value in values))
        rows.append(dict(zip(DATA_COLUMNS, cells, strict=True)))
    text = io.StringIO()
    writer = csv.DictWriter(text, DATA_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    files.write_text(DATA, text.getvalue())


def run_detectors(paths: Sequence[Path], folder: Path, page: Path | None, frames: int) -> None:
    """Compare predicted and measured losses at scenarios."""
    for path in paths:
        name = egvs.load(path).name
        predicted = expected_shares(path, folder)
        detected = measure_ap(path, folder, frames)
        losses = mount_losses(predicted, detected.ap)
        cells = detector_cells(name, DETECTOR, detected.frames, losses)
        if page is not None:
            write_losses(name, losses)
        write_rows(page, DETECTOR_MARKS, DETECTOR_HEADINGS, [cells], key_columns=2, text_columns=(0, 1, 6, 8))


# ---- all


def write_rows(
    page: Path | None,
    marks: tuple[str, str],
    headings: Cells,
    rows: Sequence[Cells],
    *,
    key_columns: int = 1,
    text_columns: Sequence[int] = (0,),
) -> None:
    """Print rows, and write them to the table of a page."""
    for row in rows:
        print(*row, sep="   ", flush=True)
    if page is None:
        return

    def update(table: str) -> str:
        old = page_tables.read_rows(table, len(headings))
        return page_tables.format_table(headings, page_tables.merge_rows(old, rows, key_columns), text_columns)

    page_tables.replace_between(page, marks, update)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print or write the rows."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.decision_costs", description=__doc__)
    parser.add_argument("what", choices=("scenarios", "area", "detectors"))
    parser.add_argument("scenarios", nargs="+", type=Path, metavar="SCENARIO")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="intermediate results (default runs/decisions)")
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames for the detector (default %(default)s)")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the rows to this page")
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    if options.what == "scenarios":
        run_scenarios(options.scenarios, options.folder, options.markdown)
    elif options.what == "detectors":
        run_detectors(options.scenarios, options.folder, options.markdown, options.frames)
    else:
        for path in options.scenarios:
            run_area(path, options.folder, options.markdown)


if __name__ == "__main__":
    main()
