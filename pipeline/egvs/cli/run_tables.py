"""Tables of many commands: ranking, files and costs of a run, findings of a check, sensors, effects, the store."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from egvs.artefacts import parquet
from egvs.artefacts.readers import DISTINCT_PROBABILITY, PeriodRank, PeriodRanking
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.cli.console import (
    NARROW,
    WIDE,
    Column,
    console,
    format_or_dash,
    make_table,
    print_sentences,
    print_table,
)
from egvs.core.errors import collect_warnings
from egvs.core.wording import format_percent
from egvs.report import ranking_text
from egvs.report.sensor_text import detection_level
from egvs.results.labels import SCORE_LABELS, ScoreLabel, format_probability
from egvs.results.levels import GROUPS_NOTE, DetectionLevel, GroupLevel, read_levels
from egvs.results.ranking import Pole, RankedSite, companion_score, group_by_pole
from egvs.scenario.score_config import ALL_DETECTORS, DEFAULT_SCORE, NOTICED
from egvs.sensors.return_model import NEGLIGIBLE_LOSS, ReturnModel
from egvs.sensors.sensor import FEW_BEAMS, FEW_BEAMS_HINT, describe_few_beams

if TYPE_CHECKING:
    from egvs.runs.store import Store, StoreEntry
    from egvs.scenario.model import Scenario
    from egvs.scenario.sensor_config import SensorConfig
    from egvs.sensors.beam_files import BeamFile
    from egvs.sensors.sensor import Sensor
    from egvs.stages.check import CheckReport
    from egvs.stages.scene_checks import PoleSurroundings
    from egvs.studies.effect_study import EffectChange, EffectCost, EffectStatus

_RESULT_FILE_WIDTH = 150
_LIST_FILE_WIDTH = 160
DARK_REFLECTIVITY = 0.1
"""Reflectivity of dark vehicles, the default of the effect ``range_limit``."""
_EXTRA_COLUMNS_WIDTH = 130
"""Terminals at least this wide show the entropy seen and the companion score next to the ranking score."""


def print_costs(folder: Path, record: RunRecord) -> None:
    """Print the artefacts of each stage, and what they cost, from the rounded costs that ``run.json`` has."""
    costs = {name: stage.cost.to_json() for name, stage in record.stages.items()}
    columns = [
        Column[str]("stage", str, "left"),
        Column[str]("artefact", lambda stage: "\n".join(_artefact_paths(folder, record, stage)), "left", wrap=True),
        Column[str]("seconds", lambda stage: f"{costs[stage]['seconds']:.2f}"),
        Column[str]("peak MB", lambda stage: f"{costs[stage]['peak_mb']:.0f}"),
    ]
    console(_RESULT_FILE_WIDTH).print(make_table(columns, record.stages))


def _artefact_paths(folder: Path, record: RunRecord, stage: str) -> list[str]:
    return [str(folder / name) for name in record.stages[stage].artefacts]


def print_stage_files(
    folder: Path, scenario: Scenario, stage: str, record: RunRecord, *, top: int | None = None
) -> None:
    """Print the files that one stage wrote; after the score stage, the ranking too."""
    out = console(_RESULT_FILE_WIDTH)
    if stage == "score":
        print_scores(folder, scenario, record, top)
        print_audit(record)
    clouds = record.stages[stage].summary.get("clouds", ())
    for path in (*_artefact_paths(folder, record, stage), *(str(folder / name) for name in clouds)):
        out.print(path)


def print_scores(
    folder: Path, scenario: Scenario, record: RunRecord, top: int | None = None, *, before_answer: bool = False
) -> None:
    """Print the ranking, the best candidate of each pole, and the ranking by period; ``top`` of each, or all.

    Parameters
    ----------
    folder
        The run folder.
    scenario, record
        Its scenario and its record.
    top
        How many of the best sites, poles and so on are printed; all for None.
    before_answer
        Whether the answer of the run follows, which has the poles and the lanes where fewest vehicles are found.
    """
    out = console(_RESULT_FILE_WIDTH)
    sites = RankedSite.read(folder / "scores.parquet")
    summary = record.stages["score"].summary
    if not any(site.score > 0 for site in sites):
        for warning in collect_warnings([summary]):
            out.print(str(warning))
        return

    out.print(ranking_table(sites, out.width, top))
    for line in _outcome_sentences(folder, record, sites):
        out.print(line)
    best = next(site for site in sites if site.rank == 1)
    levels = read_levels(RunFolder(folder).levels, best.site)
    if len(levels) > 1:
        out.print(levels_table(best.site, detection_level(scenario, scenario.score.detectors, best.sensor, levels)))
    if top is not None and len(sites) > top:
        out.print(f"... and {len(sites) - top:,} more; omit --top, or see {folder / 'scores.parquet'}")
    if not before_answer and len({site.pole for site in sites}) < len(sites):
        out.print(poles_table(sites, top))
    by_period = PeriodRanking.read(folder)
    if by_period is not None:
        out.print(period_table(by_period, top))
    if not before_answer and (missed := summary.get("missed")):
        out.print(missed)


def print_audit(record: RunRecord) -> None:
    """Print the result of an audit of the scores, if there was one."""
    if audit := record.stages["score"].summary.get("audit"):
        console(_RESULT_FILE_WIDTH).print(
            f"audit: chord lengths differ from the beam length by at most {audit['worst_sum']:.1e} of it, the longest "
            f"gap between voxels is {audit['longest_gap_m'] * 1e6:.2f} micrometres, {audit['misplaced_chords']} chords "
            f"are misplaced, {audit['voxels_visited_twice']} voxels are visited twice"
        )


def _outcome_sentences(folder: Path, record: RunRecord, sites: Sequence[RankedSite]) -> list[str]:
    """Return what the best site achieves, and where another score prefers other sites."""
    metadata = parquet.read_metadata(folder / "scores.parquet", "scores")
    sentences = []
    best = next((site for site in sites if site.rank == 1), None)
    if best is not None and best.rank_by != "egvs":
        sentence = f"{best.site} {best.by.sentence(best.score)}"
        if best.by.counts_vehicles and "weights" in metadata:
            sentence += " (weighted by class)"
        sentences.append(sentence)

    egvs_setting = ranking_text.egvs_setting(
        float(metadata["gamma"]),
        metadata["grid"]["voxel_m"],
        moving_occlusion="moving_occlusion" in record.scenario.get("effects", {}),
    )
    detectors = [record.scenario.get("score", {}).get("detector", ALL_DETECTORS)]
    if disagreement := ranking_text.ranking_disagreement(sites, egvs_setting, detectors=detectors):
        sentences.append(disagreement)
    return sentences


def ranking_table(sites: Sequence[RankedSite], width: int = WIDE, top: int | None = None) -> Table:
    """Return the ranking as a table.

    Parameters
    ----------
    sites
        All sites, in any order.
    width
        Width of the terminal; without poses and sensors where it is narrow.
    top
        How many of the best sites are listed; all for None.
    """
    by = _ranking_score(sites)
    companion = companion_score(sites)
    by_rank = sorted(sites, key=lambda site: site.rank)
    best_score = max((site.score for site in sites), default=0.0)

    columns: list[Column[RankedSite]] = [
        Column("rank", lambda site: str(site.rank)),
        Column("site", lambda site: site.site, "left", wrap=True),
        Column("x m", lambda site: f"{site.x_m:.2f}", min_width=NARROW),
        Column("y m", lambda site: f"{site.y_m:.2f}", min_width=NARROW),
        Column("z m", lambda site: f"{site.z_m:.2f}", min_width=NARROW),
        Column("sensor", lambda site: site.sensor, "left", min_width=NARROW),
        _score_column(by),
    ]
    if any(site.egvs_se is not None for site in sites):
        columns.append(Column("std error", lambda site: by.error(site.score, site.score_se)))
        columns.append(Column("beats next", lambda site: _format_beats_next(site, by_rank[-1])))
    columns.append(Column("of best", partial(_format_share_of_best, best_score)))
    if sites and all(site.noticed is not None for site in sites):
        noticed_head = SCORE_LABELS[NOTICED].head
        columns.append(Column(noticed_head, lambda site: site.noticed_cell, min_width=_EXTRA_COLUMNS_WIDTH))
    if companion is not None:
        columns.append(_score_column(companion))
    if "entropy seen" not in [column.title for column in columns]:
        min_width = 0 if companion is None else _EXTRA_COLUMNS_WIDTH
        columns.append(Column("entropy seen", lambda site: format_percent(site.entropy_seen), min_width=min_width))
    columns.append(Column("beams in ROI", lambda site: str(site.beams_in_roi), min_width=NARROW))

    shown = by_rank[:top]
    caption = None
    if not all(site.is_separable for site in shown):
        chance = f"the probability that it truly scores higher is below {format_percent(DISTINCT_PROBABILITY, 0)}"
        caption = f"~ not separable from the next site: {chance}"
    return make_table(columns, shown, width=width, caption=caption)


def levels_table(site: str, found: DetectionLevel) -> Table:
    """Return what detectors should find and people would notice of each group of road users from a site."""
    columns: list[Column[GroupLevel]] = [
        Column(f"from {site}", lambda level: level.road_users, "left"),
        Column("observations", lambda level: f"{level.observations:,}"),
        Column(SCORE_LABELS[DEFAULT_SCORE].head, found.group_text),
        Column(SCORE_LABELS[NOTICED].head, lambda level: level.noticed.text),
    ]
    return make_table(columns, found.groups, caption=GROUPS_NOTE)


def _ranking_score(sites: Sequence[RankedSite]) -> ScoreLabel:
    if not sites:
        return SCORE_LABELS["egvs"]
    return SCORE_LABELS[sites[0].rank_by]


def _format_share_of_best(best_score: float, site: RankedSite) -> str:
    if not best_score > 0:
        return "-"
    return format_percent(site.score / best_score)


def _score_column(label: ScoreLabel) -> Column[RankedSite]:
    return Column(label.head, lambda site: _format_score(label, site))


def _format_score(label: ScoreLabel, site: RankedSite) -> str:
    """Return the value of a score; the EGVS to a tenth of a bit."""
    value = site.value_of(label.name)
    if value is None:
        return "-"
    if label.name == "egvs":
        return f"{value:.1f}"
    return label.value(value)


def _format_beats_next(site: RankedSite, last: RankedSite) -> str:
    if site.beats_next is None or site is last:
        return "-"
    text = format_probability(site.beats_next)
    return text if site.is_separable else f"~ {text}"


def poles_table(sites: Sequence[RankedSite], top: int | None = None) -> Table:
    """Return the best candidate of each of the ``top`` poles, how it is mounted, and its lead over the worst one."""
    by = _ranking_score(sites)
    gain_head = f"beats worst by, {by.change_head}" if by.is_share else "beats worst by"
    columns: list[Column[Pole]] = [
        Column("rank", lambda pole: str(pole.best.rank)),
        Column("pole", lambda pole: pole.name, "left", wrap=True),
        Column("best candidate", lambda pole: pole.best.site, "left", wrap=True),
        Column("z m", lambda pole: f"{pole.best.z_m:g}"),
        Column("ccw yaw deg", lambda pole: f"{pole.best.yaw_deg:.1f}"),
        Column("pitch deg", lambda pole: f"{pole.best.pitch_deg:z.1f}"),
        Column(by.head, lambda pole: _format_score(by, pole.best)),
        Column("candidates", lambda pole: str(len(pole.sites))),
        Column(gain_head, lambda pole: pole.gain_text or "-"),
    ]
    poles = group_by_pole(sorted(sites, key=lambda site: site.rank))
    return make_table(columns, poles[:top], title="best candidate on each pole")


def period_table(by_period: PeriodRanking, top: int | None = None) -> Table:
    """Return the ``top`` sites by their rank in the mix, with rank and share of the best in each period."""
    columns: list[Column[_PeriodRow]] = [
        Column("mix", lambda row: str(row[1])),
        Column("site", lambda row: row[0], "left", wrap=True),
    ]
    for number, name in enumerate(by_period.periods):
        columns.append(Column(name, partial(_format_period, number)))
    weights = zip(by_period.periods, by_period.shares, strict=True)
    mix = ", ".join(f"{name} {format_percent(share)}" for name, share in weights)
    caption = f"rank and share of the best in each period; in the mix: {mix}"
    return make_table(columns, by_period.sites[:top], caption=caption)


_PeriodRow = tuple[str, int, tuple[PeriodRank, ...]]
"""Site, rank in the mix, and ranks in each period."""


def _format_period(number: int, row: _PeriodRow) -> str:
    result = row[2][number]
    return f"{result.rank} ({format_percent(result.of_best)})"


def print_verification(folder: Path, differences: list[str]) -> None:
    """Print every difference that ``egvs verify`` found."""
    out = console(_RESULT_FILE_WIDTH)
    for line in differences:
        out.print(f"{folder}: {line}")
    if not differences:
        out.print(f"{folder}: all artefacts are unaltered, and a second run reproduces them byte for byte")


MAX_POLES = 30
"""Poles that ``egvs check`` lists unless all details are printed."""


def print_check(checked: CheckReport, *, with_details: bool = False) -> None:
    """Print where the poles stand, and all findings of a check: errors first, grouped by rule."""
    out = console(_RESULT_FILE_WIDTH)
    if checked.poles:
        columns: list[Column[PoleSurroundings]] = [
            Column("pole", lambda pole: pole.pole, "left"),
            Column("x m", lambda pole: f"{pole.x_m:.1f}"),
            Column("y m", lambda pole: f"{pole.y_m:.1f}"),
            Column("kerb m", lambda pole: _format_distance(pole.kerb_m)),
            Column("wall m", lambda pole: _format_distance(pole.wall_m)),
            Column("stands", lambda pole: pole.where or "-", "left", wrap=True),
        ]
        shown = checked.poles if with_details else checked.poles[:MAX_POLES]
        print_table(columns, shown, file_width=_RESULT_FILE_WIDTH)
        if hidden := len(checked.poles) - len(shown):
            out.print(f"{hidden} more poles; --verbose lists them")
        out.print("kerb: distance to the edge of the carriageway; wall: to the nearest building or other surface")
    for severity, findings in (("error", checked.errors), ("warning", checked.warnings), ("note", checked.notes)):
        if not findings:
            continue
        plural = "s" if len(findings) > 1 else ""
        out.print(f"{len(findings)} {severity}{plural}")
        for rule in dict.fromkeys(finding.rule for finding in findings):
            out.print(f"  {rule}")
            for finding in findings:
                if finding.rule == rule:
                    out.print(f"    {finding}")
    if not (checked.errors or checked.warnings):
        out.print("no errors or warnings")
    out.print(f"checked {checked.sites} sites, {checked.solids} solids and {checked.lanes} lanes")


def print_signals(scenario: Scenario) -> None:
    """Print the plans of the signals in the region, as they will be simulated; nothing where traffic is recorded."""
    from egvs.traffic import sumo_folder
    from egvs.traffic.signal_descriptions import describe_simulated, format_plan
    from egvs.traffic.signal_plans import planned_signals

    first = next(iter(scenario.by_period().values()))
    path, roads = sumo_folder.network_path(first), sumo_folder.read_network(first)
    if path is None or roads is None or not roads.stop_lines or first.traffic.is_finished:
        return
    for plan in describe_simulated(first, planned_signals(first, path, roads)):
        console(_RESULT_FILE_WIDTH).print(format_plan(plan))


def print_mounts(scenario: Scenario) -> None:
    """Print which sensors hang upside down at how many sites; nothing where all stand."""
    from egvs.sensors.sites import candidate_sites

    sites = candidate_sites(scenario)
    for sensor in dict.fromkeys(site.sensor for site in sites if site.pose.is_inverted):
        mounts = [site.pose.is_inverted for site in sites if site.sensor == sensor]
        print_sentences([f"{sensor} hangs upside down at {sum(mounts):,} of {len(mounts):,} sites"])


def _format_distance(distance_m: float) -> str:
    return format_or_dash(None if math.isnan(distance_m) else distance_m, ".1f")


def print_protections(missing: Sequence[str]) -> None:
    """Print whether this system confines the programs that read a user's files, and what it cannot enforce."""
    if not missing:
        print_sentences(["SUMO and the readers of foreign formats are confined to their files."])
    for protection in missing:
        print_sentences([f"not protected: {protection}"])


def print_demo_hints(results: Path) -> None:
    """Print what to try after ``egvs demo``."""
    out = console(_RESULT_FILE_WIDTH)
    run = shlex.quote(str(results))
    out.print(f"next: egvs place {run} --count 2   (the best two sensors together)")
    out.print(f"      egvs explore {run}   (move a sensor and see its score; needs egvs[explore])")
    out.print("      egvs new mytown --from extract.osm.pbf   (your own junction, from OpenStreetMap)")


def print_sensors(sensors: Iterable[Sensor]) -> None:
    """Print the sensor catalogue: one line per sensor, and what the columns mean."""
    columns: list[Column[Sensor]] = [
        Column("sensor", lambda sensor: sensor.name, "left"),
        Column("rings", lambda sensor: str(sensor.channels or "-")),
        Column("view deg", _format_view),
        Column("beams", lambda sensor: str(sensor.beams)),
        Column("max m", lambda sensor: f"{sensor.range_m:g}"),
        Column("rated m", _format_rating),
        Column(format_percent(DARK_REFLECTIVITY, 0), _format_dark_range),
    ]
    print_table(columns, sensors, file_width=_LIST_FILE_WIDTH)
    print_sentences(
        (
            "view: azimuth x elevation. beams: of one turn or frame of 0.1 s, so ten times as many points per second.",
            "max: no beam is longer. rated: how far the maker's sensor still detects a target of this reflectivity; "
            f"the last column converts it to {format_percent(DARK_REFLECTIVITY, 0)} (dark vehicles), so "
            "that sensors can be compared; a: assumed, the maker states no reflectivity, or rates another version; "
            "u: unchecked, quoted from others; without a letter, it was checked against the maker's text. "
            "Losses of returns follow from it, where they can change a result: docs/effects.md.",
            "The catalogue has no prices, and does not say which sensors are still sold. Set prices with "
            "--set 'costs.sensor={\"NAME\" = PRICE}' or in [costs].",
            "egvs sensors NAME prints sources and assumptions; egvs compare SCENARIO --sensors NAME,NAME compares.",
        )
    )


def dark_range_m(sensor: Sensor) -> float | None:
    """Return the rated range for dark vehicles, by the power law of ``range_limit``; None where none is stated."""
    if sensor.rated_range_m is None:
        return None
    return sensor.rated_range_m * math.sqrt(DARK_REFLECTIVITY / sensor.rated_reflectivity)


def _format_dark_range(sensor: Sensor) -> str:
    """The rated range for dark vehicles, with a letter where it was not checked against the maker's text."""
    mark = " "
    for word in ("unchecked", "assumed"):
        if word in (sensor.rated_source or ""):
            mark = word[0]
    return f"{format_or_dash(dark_range_m(sensor), '.0f')} {mark}"


def print_sensor_details(sensors: Iterable[Sensor], scenario: Scenario | None = None) -> None:
    """Print all that is known of some sensors, with the sources; ``scenario`` is that of custom sensors."""
    for sensor in sensors:
        config = None if scenario is None else scenario.sensors.get(sensor.name)
        step = ""
        if sensor.azimuth_step_deg is not None:
            step = f", {sensor.azimuth_step_deg:.12g} deg apart in azimuth"
        if any(sensor.azimuth_offsets_deg):
            step += f"; azimuth offsets {_format_span(sensor.azimuth_offsets_deg)}, counter-clockwise"
        rings = f"{sensor.channels} rings" if sensor.channels else "scan pattern without rings"
        divergence_mrad = " x ".join(f"{angle:g}" for angle in sensor.divergence_mrad)
        lines = [
            sensor.name,
            f"  beams: {sensor.pulses} of one turn or frame; {rings}{step}",
            f"  view: azimuth {_format_azimuths(sensor)} deg, elevation {_format_elevations(sensor)} deg",
            f"  range: {sensor.range_m:g} m; rated: {_format_rating(sensor, ' m')}",
            f"  laser: {sensor.wavelength_nm:g} nm, divergence {divergence_mrad} mrad, range noise "
            f"{sensor.range_sigma_m:g} m",
            f"  source: {sensor.source if config is None else _describe_source(sensor, config, scenario)}",
        ]
        if config is not None:
            mount = "upside down" if config.mount == "inverted" else "upright"
            lines.append(f"  mount: {mount}, unless [sites] or a row says otherwise")
        if sensor.rated_range_m is not None:
            model = ReturnModel.of(sensor)
            lines.append(
                f"  losses of returns from cars: half are lost at {model.limit_m(model.target_reflectivity()):.0f} m, "
                f"{format_percent(NEGLIGIBLE_LOSS, 0)} at {model.lossless_range_m:.0f} m, and "
                f"{format_percent(model.dropout, 0)} at any range (reflectivity {model.target_reflectivity():g}, "
                f"softness {model.softness:g}: fitted on two units); rated range: "
                f"{sensor.rated_source or 'the scenario'}"
            )
        if sensor.assumed:
            lines.append(f"  assumed: {sensor.assumed}")
        few = describe_few_beams(sensor)
        if few is not None:
            lines.append(f"  warning: {few}. {FEW_BEAMS_HINT}")
        print_sentences(lines)


def _describe_source(sensor: Sensor, config: SensorConfig, scenario: Scenario | None) -> str:
    """Return the table of a custom sensor, and the file of its beams."""
    file = "" if config.beam_file is None else f", {config.beam_file[0]} from {config.beam_file[1]}"
    return f"[sensors.{sensor.name}] of {'the scenario' if scenario is None else scenario.file}{file}"


def print_beam_file(path: Path, file: BeamFile) -> None:
    """Print what was read of a file of beams, and how a scenario uses it."""
    from egvs.sensors.beam_files import BeamTable
    from egvs.sensors.sensor import describe_odd_angles

    beams = file.beams
    if isinstance(beams, BeamTable):
        elevations, azimuths = beams.elevation_deg.tolist(), beams.azimuth_deg.tolist()
        lines = [
            f"{path}: {file.kind}",
            f"  {len(beams):,} single beams, one per row; azimuths {_format_span(azimuths)}",
        ]
        count: int | None = len(beams)
    else:
        elevations, azimuths = beams.elevations_deg, beams.azimuth_offsets_deg
        lines = [
            f"{path}: {file.kind}",
            f"  {len(elevations)} rings; azimuth offsets {_format_span(azimuths)}, counter-clockwise",
        ]
        count = None if beams.azimuths is None else beams.azimuths * len(elevations)
        if beams.azimuths is None:
            lines.append("  columns: not stated; set azimuth_step_deg")
        else:
            view = "the full circle"
            if beams.azimuth_deg is not None:
                view = f"azimuths from {beams.azimuth_deg[0]:.4g} to {beams.azimuth_deg[1]:.4g} deg"
            lines.append(f"  columns: {beams.azimuths:,}, {view}; {count:,} beams")
        if beams.axis_distance_m:
            lines.append(f"  beams leave {1000 * beams.axis_distance_m:.4g} mm beside the axis (not simulated)")
        if beams.vertical_offsets_m:
            offsets_mm = [1000 * offset_m for offset_m in beams.vertical_offsets_m]
            lines.append(f"  vertical offsets {_format_span(offsets_mm, 'mm')} (not simulated)")
    lines.append(f"  elevations {_format_span(elevations)}: {_first_values(elevations)}")
    keys = f'beams = "{path.name}", range_m = METRES'
    if file.dwell_s is not None:
        keys = f'range_m = METRES, pattern = {{kind = "file", file = "{path.name}", samples = PULSES OF A FRAME}}'
    if not isinstance(beams, BeamTable) and beams.azimuths is None:
        keys += ", azimuth_step_deg = DEGREES"
    lines.append(f"  in a scenario: [sensors.NAME] with {keys}")
    if count is not None and count < FEW_BEAMS:
        lines.append(f"  warning: {count:,} beams in a turn or frame; a LiDAR has thousands. {FEW_BEAMS_HINT}")
    odd = describe_odd_angles(path.name, elevations, () if isinstance(beams, BeamTable) else beams.azimuth_offsets_deg)
    if odd is not None:
        lines.append(f"  warning: {odd[0]}. {odd[1]}")
    print_sentences(lines)


def _format_span(values: Sequence[float], unit: str = "deg") -> str:
    return f"{min(values):.4g} to {max(values):.4g} {unit}"


def _first_values(values: Sequence[float], count: int = 8) -> str:
    text = ", ".join(f"{value:g}" for value in values[:count])
    return text if len(values) <= count else f"{text}, ..."


def _format_view(sensor: Sensor) -> str:
    """Return the field of view, azimuth x elevation, e.g. "360 x -25 to 15"."""
    width_deg = 360.0
    if sensor.azimuth_span_deg is not None:
        width_deg = sensor.azimuth_span_deg[1] - sensor.azimuth_span_deg[0]
    return f"{width_deg:.3g} x {_format_elevations(sensor)}"


def _format_elevations(sensor: Sensor) -> str:
    low_deg, high_deg = sensor.elevation_span_deg
    return f"{low_deg:.3g} to {high_deg:.3g}"


def _format_azimuths(sensor: Sensor) -> str:
    if sensor.azimuth_span_deg is None:
        return "360"
    first_deg, last_deg = sensor.azimuth_span_deg
    return f"{first_deg:.4g} to {last_deg:.4g}"


def _format_rating(sensor: Sensor, unit: str = "") -> str:
    if sensor.rated_range_m is None:
        return "-"
    return f"{sensor.rated_range_m:g}{unit} at {format_percent(sensor.rated_reflectivity, 0)}"


def print_effects(effects: Sequence[EffectStatus], costs: Mapping[str, EffectCost] | None = None) -> None:
    """Print effects, whether they are on, and why; what each costs and changes, if a study measured it."""
    columns: list[Column[EffectStatus]] = [
        Column("effect", lambda effect: effect.name, "left"),
        Column("acts in", lambda effect: effect.stage, "left", wrap=True, min_width=NARROW),
        Column("kind", lambda effect: effect.kind, "left", wrap=True, min_width=NARROW),
        Column("state", lambda effect: effect.state, "left", wrap=True),
        Column("why", lambda effect: effect.why, "left", wrap=True),
    ]
    if any(effect.change for effect in effects):
        columns.append(Column("expected change", lambda effect: effect.change, "left", wrap=True))
    if costs is not None:
        columns.append(Column("costs", lambda effect: _format_cost(costs.get(effect.name)), "left"))
        columns.append(Column("changes", lambda effect: _format_cost_change(costs.get(effect.name)), "left", wrap=True))
    columns.append(Column("source", lambda effect: effect.source, "left", wrap=True, min_width=NARROW))
    print_table(columns, effects, file_width=_LIST_FILE_WIDTH)


def _format_cost(cost: EffectCost | None) -> str:
    if cost is None:
        return ""
    return f"{cost.seconds:+z.2f} s"


def _format_cost_change(cost: EffectCost | None) -> str:
    if cost is None:
        return ""
    loss = f"the choice loses {cost.loss_points:.2f} points"
    return f"scores by up to {format_percent(cost.change)}; {loss}; tau {cost.tau:.2f}"


def print_ablation(changes: Sequence[EffectChange]) -> None:
    """Print by how much each effect changes the scores of the plain scene, which is the first of ``changes``."""
    from egvs.cli import study_conclusions

    plain = changes[0]
    titles = {**dict(enumerate(plain.sites)), _SECONDS_ROW: "seconds"}
    columns = [
        Column[int]("site", lambda row: titles[row], "left"),
        Column[int](f"plain, {SCORE_LABELS[plain.rank_by].head}", lambda row: _format_plain(plain, row)),
    ]
    columns += [Column(change.effect, partial(_format_change, plain, change)) for change in changes[1:]]
    title = "change in each site's score compared with the plain scene (and rank, where it changes)"
    out = console(_LIST_FILE_WIDTH, soft_wrap=False)
    out.print(make_table(columns, titles, title=title, truncate=True))
    out.print()
    print_sentences([study_conclusions.ablation_conclusion(changes)])


_SECONDS_ROW = -1
"""Row of the ablation table that holds seconds, below those of the sites."""


def _format_plain(plain: EffectChange, row: int) -> str:
    if row == _SECONDS_ROW:
        return f"{plain.seconds:.2f}"
    return f"{SCORE_LABELS[plain.rank_by].value(plain.scores[row])} ({plain.ranks[row]})"


def _format_change(plain: EffectChange, change: EffectChange, row: int) -> str:
    """Return the relative change of a score, and the ranks before and after where they differ."""
    if row == _SECONDS_ROW:
        return f"{change.seconds:.2f}"
    percent = math.nan
    if plain.scores[row]:
        percent = 100 * (change.scores[row] / plain.scores[row] - 1)
    if change.ranks[row] == plain.ranks[row]:
        return f"{percent:+z.2f} %"
    return f"{percent:+z.2f} % ({plain.ranks[row]} to {change.ranks[row]})"


def print_store(store: Store) -> None:
    """Print the entries of the store, last used first, and their total."""
    if store.folder is None:
        console(120).print("EGVS_STORE is empty: results are not cached")
        return
    entries = store.entries()
    now = time.time()
    columns: list[Column[StoreEntry]] = [
        Column("stage", lambda entry: entry.stage, "left"),
        Column("key", lambda entry: entry.key[:12], "left"),
        Column("size", lambda entry: format_size(entry.bytes)),
        Column("age", lambda entry: format_age(now - entry.created)),
        Column("last used", lambda entry: f"{format_age(now - entry.last_used)} ago"),
    ]
    out = console(120)
    out.print(make_table(columns, entries, truncate=True))
    out.print(f"{store.folder}: {_format_total(entries)}, of at most {format_size(store.bound_bytes)}")


def print_removed(store: Store, removed: list[StoreEntry]) -> None:
    """Print what was removed from the store, and what is left."""
    print(f"{store.folder}: removed {_format_total(removed)}; {_format_total(store.entries())} remain")


def _format_total(entries: list[StoreEntry]) -> str:
    size = sum(entry.bytes for entry in entries)
    return f"{len(entries)} entries, {format_size(size)}"


def format_size(size_bytes: float) -> str:
    """Return a size as text, e.g. "2.5 MB"."""
    for unit, unit_bytes in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("KB", 1e3)):
        if size_bytes >= unit_bytes:
            return f"{size_bytes / unit_bytes:.3g} {unit}"
    return f"{size_bytes:.3g} B"


def format_age(seconds: float) -> str:
    """Return a duration as text in its largest unit, e.g. "3 h"."""
    for unit, unit_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= unit_s:
            return f"{seconds / unit_s:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
