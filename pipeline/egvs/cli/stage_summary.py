"""One line per finished stage of a run: its name, its duration, and what it produced.

The numbers come from the stage's summary in ``run.json``. Keys without a sentence of their own are printed as they are,
so that a new key is never lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from egvs.artefacts.run_record import StageRecord
from egvs.cli.value_text import format_values
from egvs.core.errors import WARNINGS_KEY
from egvs.core.wording import format_percent, number_of
from egvs.results.labels import SCORE_LABELS

COUNTS, ASSUMED_FLOWS = "the counts", "the assumed flows"
FLOWS = "the flows of the scenario"
"""What simulated flows are compared with where it is not known whether they were counted."""

_OMITTED_KEYS = frozenset(
    (
        "flags",
        "missed",
        "overlapping_pairs",
        "rows",
        "settled_in_float64",
        "signals",
        "solids",
        "sumo_seconds",
        "sumo_peak_mb",
        "zones",
        "zones_for_pedestrians",
        WARNINGS_KEY,
    )
)
"""Entries of a summary that are printed elsewhere, or that only ``run.json`` holds."""

_MAX_SIZES = 6
"""Vehicle types whose sizes are printed."""

_STAGE_NAMES = {"tpog": "occupancy"}
"""Stages whose name differs from their command."""


@dataclass(frozen=True)
class Sentence:
    """A sentence about a stage; details are printed on request only."""

    text: str
    is_detail: bool = False


def stage_lines(
    stage: str, state: str, record: StageRecord, *, with_details: bool, flow_source: str = FLOWS
) -> Iterator[str]:
    """Yield the line of a stage; with details, also one line for each period of its traffic.

    Parameters
    ----------
    stage, state, record
        Name of the stage, how it ended, and its record.
    with_details
        Whether all that the stage reports is printed.
    flow_source
        What the simulated flows are compared with: :data:`COUNTS`, :data:`ASSUMED_FLOWS` or :data:`FLOWS`.
    """
    duration = f"{record.cost.seconds:.1f} s"
    if state == "skipped":
        duration = "unchanged"
    elif state == "fetched":
        duration = "from store"

    summary = dict(record.summary)
    periods = {}
    if stage == "traffic":
        periods = summary.pop("periods", {})
    describe = partial(describe_summary, stage, with_details=with_details, flow_source=flow_source)
    text = describe(summary)
    if periods and not with_details:
        text = f"{number_of(len(periods), 'period')}, {text}"
    yield f"{_STAGE_NAMES.get(stage, stage):<10} {duration:>10}   {text}"
    if not with_details:
        return
    for name, period in periods.items():
        yield f"{name:>21}   {describe(period)}"


def describe_summary(stage: str, summary: dict[str, Any], *, with_details: bool, flow_source: str = FLOWS) -> str:
    """Return the summary of a stage in one line; see :func:`stage_lines`."""
    rest = {key: value for key, value in summary.items() if key not in _OMITTED_KEYS}
    sentences: list[Sentence] = []
    if stage in _SENTENCES and _REQUIRED_KEYS[stage] <= summary.keys():
        describe = _SENTENCES[stage]
        if stage == "traffic":
            describe = partial(_traffic_sentences, flow_source=flow_source)
        sentences += describe(rest, summary)
    if rest_text := format_values(rest):
        sentences.append(Sentence(rest_text, is_detail=True))
    return "; ".join(sentence.text for sentence in sentences if with_details or not sentence.is_detail)


def _detail(text: str) -> Sentence:
    return Sentence(text, is_detail=True)


def _check_sentences(rest: dict[str, Any], summary: dict[str, Any]) -> Iterator[Sentence]:
    sites, solids, lanes = rest.pop("sites"), summary["solids"], rest.pop("lanes")
    yield Sentence(f"{number_of(sites, 'site')}, {number_of(solids, 'solid')} and {number_of(lanes, 'lane')} checked")
    for note in (*rest.pop("losses", ()), *rest.pop("notes", ())):
        yield _detail(note)


def _statics_sentences(rest: dict[str, Any], summary: dict[str, Any]) -> Iterator[Sentence]:
    yield Sentence(f"{rest.pop('triangles'):,} triangles in {number_of(summary['solids'], 'solid')}")
    if built := rest.pop("built", None):
        yield _detail("built: " + ", ".join(f"{kind.replace('_', ' ')} ({count:,})" for kind, count in built.items()))
    if repaired := rest.pop("mended", None):
        yield _detail("repaired: " + _describe_counts(repaired))
    if ignored := rest.pop("left_out", None):
        yield _detail("left out: " + _describe_counts(ignored))


def _scan_sentences(rest: dict[str, Any], summary: dict[str, Any]) -> Iterator[Sentence]:
    yield Sentence(f"{number_of(rest.pop('sites'), 'site')} scanned")
    if not rest.pop("kept", True):
        yield _detail("scans not saved")
    elif "beams" in rest:
        yield _detail(f"{rest.pop('returns'):,} returns from {rest.pop('beams'):,} beams towards the region")


def _traffic_sentences(rest: dict[str, Any], summary: dict[str, Any], flow_source: str = FLOWS) -> Iterator[Sentence]:
    frames = number_of(rest.pop("frames"), "frame")
    if seeds := rest.pop("seeds", None):
        frames += f" of {len(seeds)} simulations"
    yield Sentence(frames)
    if "vehicles" in rest:
        yield Sentence(describe_vehicles(rest.pop("vehicles")))
        standing, longest_s = rest.pop("share_standing"), rest.pop("longest_standing_s")
        yield _detail(f"mean speed {3.6 * rest.pop('mean_speed_m_s'):.0f} km/h")
        yield _detail(f"standing {format_percent(standing, 0)} of the time, for at most {longest_s:g} s")
        yield _detail(f"vehicles overlap in {number_of(rest.pop('frames_with_overlap'), 'frame')}")
    if rest.get("collisions") is not None:
        yield _detail(number_of(rest.pop("collisions"), "collision"))
    if (overlaps := rest.pop("overlapping_pairs_in_roi", None)) is not None:
        yield _detail(f"{number_of(overlaps, 'overlap')} in the region")
    if teleports := rest.pop("teleports", 0):
        yield Sentence(f"{number_of(teleports, 'vehicle')} moved on")
    if counts := rest.pop("counts", None):
        worst = max(count["geh"] for count in counts)
        yield Sentence(f"largest GEH against {flow_source} {worst:.1f}")
    if tracks := rest.pop("tracks", None):
        yield from _track_sentences(tracks)
    if sizes := rest.pop("sizes", None):
        yield _detail(describe_sizes(sizes))
    if sumo := rest.pop("sumo", None):
        yield _detail(f"SUMO {sumo}")


def _track_sentences(tracks: dict[str, Any]) -> Iterator[Sentence]:
    """Yield what was read from recorded tracks, changed and left out."""
    text = number_of(tracks["tracks"], "track")
    if coverage := tracks.get("coverage"):
        text += f" cover {format_percent(coverage['share'], 0)} of the {coverage['of']}"
    else:
        text += " of people beside the vehicles"
    yield Sentence(text)
    if alignment := tracks.get("alignment"):
        yield _detail(
            f"{format_percent(alignment['share_on_lanes'], 0)} of the positions of moving vehicles lie on lanes"
        )
    yield _detail(f"{tracks['rows']:,} rows read, {tracks['step_s']:g} s apart")
    for key, words in _TRACK_COUNTS.items():
        if tracks[key]:
            yield _detail(f"{words}: {tracks[key]:,}")
    if tracks["rows_with_height"]:
        scatter = f"the bottoms of boxes scatter by {tracks['height_scatter_m']:.2f} m"
        yield _detail(f"heights of {tracks['rows_with_height']:,} rows are not used; {scatter}")
    if filled := tracks["filled_sizes"]:
        texts = [f"{name} ({number:,})" for name, number in filled.items()]
        yield _detail(f"sizes of classes used for tracks without: {', '.join(texts)}")
    for sentence in tracks.get("sources", ()):
        yield _detail(sentence)


_TRACK_COUNTS = {
    "dropped_rows": "rows without a time or position",
    "duplicates": "duplicate rows dropped",
    "jumps": "jumps, where tracks are cut",
    "headings_from_motion": "headings from the motion",
    "headings_unknown": "headings unknown, set to east",
    "flipped_headings": "headings turned by 180 degrees",
    "interpolated_gaps": "gaps interpolated",
    "unknown_gaps": "longer gaps, in which the position is unknown",
    "outside_coverage": "boxes outside the coverage left out",
}
"""Numbers in the summary of recorded tracks, in words; those that are 0 are not printed."""


def _tpog_sentences(rest: dict[str, Any], summary: dict[str, Any]) -> Iterator[Sentence]:
    users = "road users" if rest.pop("with_people", False) else "vehicles"
    yield Sentence(f"{rest.pop('boxes_in_roi'):.1f} {users} in the region on average")
    yield _detail(f"{number_of(rest.pop('occupied_voxels'), 'voxel')} occupied at least once")
    yield _detail(f"{rest.pop('static_voxels'):,} filled by static solids")
    memory = rest.pop("memory_frames")
    if isinstance(memory, float):
        memory = f"{memory:.4g}"
    yield _detail(f"autocorrelation time {memory} frames")
    if gaps := rest.pop("unknown_gaps", 0):
        scaled, left_out = rest.pop("scaled_voxels"), rest.pop("unknown_voxels")
        text = f"counts of {number_of(scaled, 'voxel')} scaled, and {left_out:,} left out, where tracks have"
        yield _detail(f"{text} {number_of(gaps, 'long gap')}")


def _score_sentences(rest: dict[str, Any], summary: dict[str, Any]) -> Iterator[Sentence]:
    best = rest.pop("best")
    by = SCORE_LABELS[rest.pop("rank_by")]
    limit = rest.pop("egvs_limit")
    yield Sentence(f"{number_of(rest.pop('sites'), 'site')} ranked by {by.noun}")
    if best:
        yield _detail(f"best: {', '.join(best)}")
    if by.name == "egvs":
        yield _detail(f"upper limit {float(limit):,.0f} bit")
    rest.pop("losses", None)  # the check has reported it
    if gamma := rest.pop("gamma_auto", None):
        yield _detail(f"gamma {gamma:g} (auto)")
    if errors := rest.pop("standard_errors_from", None):
        yield _detail(f"standard errors from {errors}")


def _report_sentences(rest: dict[str, Any], summary: dict[str, Any]) -> Iterator[Sentence]:
    rest.pop("best", None)
    rest.pop("worst", None)
    yield Sentence(f"{rest.pop('kilobytes'):,} kB")
    for fit in rest.pop("approaches", ()):
        yield Sentence(_describe_approach(fit))


def _describe_approach(fit: dict[str, Any]) -> str:
    """Return queue and speed of an approach, simulated and observed."""
    texts = []
    if fit["observed_queue_m"] is not None:
        texts.append(f"queue {fit['queue_m']:.0f} m (observed {fit['observed_queue_m']:.0f} m)")
    if fit["observed_speed_kmh"] is not None:
        speed = "no vehicle" if fit["speed_kmh"] is None else f"{fit['speed_kmh']:.0f} km/h"
        texts.append(f"{speed} (observed {fit['observed_speed_kmh']:.0f} km/h)")
    period = f" in {fit['period']}" if fit["period"] else ""
    return f"from {fit['approach']}{period}: {', '.join(texts)}"


_SENTENCES: dict[str, Callable[[dict[str, Any], dict[str, Any]], Iterator[Sentence]]] = {
    "check": _check_sentences,
    "statics": _statics_sentences,
    "scan": _scan_sentences,
    "traffic": _traffic_sentences,
    "tpog": _tpog_sentences,
    "score": _score_sentences,
    "report": _report_sentences,
}
"""Each takes the keys that it prints out of its first argument."""

_REQUIRED_KEYS = {
    "check": {"sites", "solids", "lanes"},
    "statics": {"triangles", "solids"},
    "scan": {"sites"},
    "traffic": {"frames"},
    "tpog": {"occupied_voxels", "static_voxels", "boxes_in_roi", "memory_frames"},
    "score": {"sites", "best", "rank_by", "egvs_limit"},
    "report": {"kilobytes"},
}
"""Without these, a summary is printed as it is."""


def describe_vehicles(vehicles: dict[str, int]) -> str:
    """Return how many vehicles there are at a time and in all."""
    fewest, most = vehicles["fewest"], vehicles["most"]
    range_text = f"{most:,}"
    if fewest != most:
        range_text = f"{fewest:,} to {most:,}"
    return f"{range_text} vehicles at a time, {vehicles['different']:,} in all"


def describe_sizes(sizes: dict[str, dict[str, Any]]) -> str:
    """Return length, width and height of the vehicle types of a finished file, and where each size comes from."""
    sources = sorted({size["source"] for size in sizes.values()})
    texts = []
    for name, size in list(sizes.items())[:_MAX_SIZES]:
        metres = " x ".join(f"{size[key]:g}" for key in ("length_m", "width_m", "height_m"))
        source = f" (from {size['source']})" if len(sources) > 1 else ""
        texts.append(f"{name} {metres} m{source}")
    if len(sizes) > _MAX_SIZES:
        texts.append(f"{len(sizes) - _MAX_SIZES} more in run.json")
    shared_source = f" from {sources[0]}" if len(sources) == 1 else ""
    return f"sizes{shared_source}: {', '.join(texts)}"


def _describe_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count:,} {what.replace('_', ' ')}" for what, count in counts.items())
