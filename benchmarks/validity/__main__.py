"""``make validity``: measure, analyse, and write the tables and figures of docs/validity.md.

Measurements are saved in runs/validity and in the cache, so an interrupted study continues, and a complete one is
analysed again in a minute. Detectors run on all cores.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.validity import figures, junctions, low_models, poses, study, tables
from benchmarks.validity.detector_sites import FAST
from benchmarks.validity.junctions import Role, StudyJunction
from benchmarks.validity.measurement import Part, measure
from benchmarks.validity.record import Record
from benchmarks.validity.study import Extent
from egvs.cli import options
from egvs.clouds.sweeps import POINT_COUNTS_NAME
from egvs.core.errors import EgvsError, InputError, MissingBackendError

ROOT = Path(__file__).resolve().parents[2]
DATA = Path("data", "validity")
"""The tables, in the folder of the documentation; docs/validity-tables.md explains them."""

REPORT_EVERY_S = 30.0


def main(given: Sequence[str] | None = None) -> int:
    """Run the study, and return the exit code."""
    try:
        _study(_parser().parse_args(given))
    except EgvsError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.validity", description=__doc__)
    parser.add_argument("--frames", type=int, default=study.FRAMES, help="of held-out traffic (default %(default)s)")
    parser.add_argument(
        "--sensor-frames",
        type=int,
        default=study.SENSOR_FRAMES,
        help="frames where sensors are compared, 0 for no comparison (%(default)s)",
    )
    parser.add_argument("--places", type=int, default=poses.PLACES, help="locations of the grid (default %(default)s)")
    parser.add_argument("--detector", metavar="NAME,NAME", help="default: all that are installed")
    parser.add_argument("--junction", metavar="NAME,NAME", help="of the shipped ones; default: all")
    parser.add_argument("--osm-training", type=Path, metavar="FILE", help="an OpenStreetMap extract")
    parser.add_argument("--osm-training-at", metavar="LAT,LON", help="its junction; default: the largest")
    parser.add_argument("--osm-held-out", type=Path, metavar="FILE", help="an extract of elsewhere")
    parser.add_argument("--osm-unseen", type=Path, metavar="FILE", help="an extract, for a junction without choices")
    parser.add_argument("--osm-unseen-at", metavar="LAT,LON", help="its junction; default: the largest")
    parser.add_argument("--jobs", type=int, help="processes; default: one a core")
    parser.add_argument("--data", type=Path, default=ROOT / "runs" / "validity", help="folder of the measurements")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="tables and figures")
    return parser


def _study(arguments: argparse.Namespace) -> None:
    start_s = time.monotonic()
    detectors, without = _detectors(arguments.detector)
    folders, left_out = _junction_folders(arguments)
    junctions.check_apart(folders)
    arguments.data.mkdir(parents=True, exist_ok=True)
    print(f"preparing {', '.join(name for name, _, _ in folders)}", flush=True)
    each = [_ready(*junction_folder, arguments) for junction_folder in folders]
    for junction in each:
        junctions.check_unseen(junction.scenario)
    extent = Extent(arguments.frames, arguments.sensor_frames, arguments.places)
    parts = study.parts(each, detectors, extent, arguments.data)
    _print_plan(parts, arguments.jobs)
    records = {part.name: _measured(part, arguments, start_s) for part in parts}
    main_ones = [records[junction.name] for junction in each]
    with_sensors = [records[part.name] for part in parts if part.scores is not None]
    print("analysing")
    made_tables = list(study.tables_of(main_ones, with_sensors, detectors))
    if not with_sensors:
        left_out.append("a comparison of sensors")
    words = study.preface(main_ones, with_sensors, detectors, [*without, *left_out])
    write(arguments.docs, words, made_tables)
    costs = tables.page("Cost of the scores", [], [study.costs(arguments.data, [junction.name for junction in each])])
    (arguments.docs / "validity-costs.md").write_text(costs, encoding="utf-8")
    print(f"{arguments.docs / DATA}: {len(made_tables)} tables, {time.monotonic() - start_s:.0f} s")


def write(docs: Path, words: Sequence[str], made_tables: Sequence[tables.Table]) -> None:
    """Write the tables as CSV, and the figures."""
    tables.write(docs / DATA, words, made_tables)
    figures.draw(docs / "images", made_tables)


def _detectors(requested: str | None) -> tuple[list[str], list[str]]:
    """Return the requested or all available detectors; and which are left out, and why."""
    if requested is not None:
        names = [name.strip() for name in requested.split(",") if name.strip()]
        for name in (name for name in names if name != POINT_COUNTS_NAME):
            low_models.make(name)
        return list(dict.fromkeys([POINT_COUNTS_NAME, *names])), []
    available, without = [POINT_COUNTS_NAME], []
    for name in sorted(low_models.names(), key=lambda name: (name not in FAST, name)):
        try:
            low_models.make(name)
            available.append(name)
        except MissingBackendError as error:
            without.append(f"detector {name} ({error})")
    return available, without


def _junction_folders(arguments: argparse.Namespace) -> tuple[list[tuple[str, Role, Path]], list[str]]:
    """Return the junctions, training ones first; and which are left out, and why."""
    names = tuple(arguments.junction.split(",")) if arguments.junction else ()
    if unknown := [name for name in names if name not in junctions.SHIPPED]:
        known = ", ".join(junctions.SHIPPED)
        raise InputError("--junction", f"expected some of {known}, got {unknown[0]!r}")
    folders = junctions.shipped(names)
    there = {name for name, _, _ in folders}
    without = [f"{name} (not in this run)" for name in junctions.SHIPPED if name not in there]
    named: dict[Role, tuple[Path | None, str | None]] = {
        "training": (arguments.osm_training, arguments.osm_training_at),
        "held out": (arguments.osm_held_out, None),
        "unseen": (arguments.osm_unseen, arguments.osm_unseen_at),
    }
    for role, (extract, location) in named.items():
        if extract is not None:
            at = options.latitude_and_longitude(location) if location else None
            folders.append(junctions.from_osm(role, extract, at, arguments.data / "junctions"))
        else:
            article = "an" if role == "unseen" else "a"
            without.append(f"{article} {role} junction from OpenStreetMap (no extract was named)")
    return sorted(folders, key=lambda junction_folder: junctions.ROLES.index(junction_folder[1])), without


def _ready(name: str, role: Role, junction_folder: Path, arguments: argparse.Namespace) -> StudyJunction:
    return junctions.ready(name, role, junction_folder, arguments.data / "worlds" / name, arguments.places)


def _print_plan(parts: Sequence[Part], jobs: int | None) -> None:
    """Print every part, and the expected time of the detectors."""
    cores = jobs or os.cpu_count() or 1
    for part in parts:
        detectors_text = ", ".join(f"{name} from {len(sites)}" for name, sites in part.detectors.items())
        print(
            f"{part.name}: {part.role}, {part.sensor}, {part.frames} frames {part.apart_s:g} s apart, {detectors_text}"
        )
    minutes = sum(study.estimated_s(part) for part in parts) / cores / 60
    print(f"{len(parts)} parts; detectors take about {minutes:.0f} minutes on {cores} cores", flush=True)


def _measured(part: Part, arguments: argparse.Namespace, start_s: float) -> Record:
    def report(text: str) -> None:
        print(f"{time.monotonic() - start_s:6.0f} s  {text}", flush=True)

    reported_at = time.monotonic()

    def progress(what: str, done: int, total: int) -> None:
        """Print a line every half minute."""
        nonlocal reported_at
        if time.monotonic() - reported_at >= REPORT_EVERY_S:
            reported_at = time.monotonic()
            report(f"{part.name}: {what} {done}" + (f" of {total}" if total else ""))

    report(f"{part.name}: started")
    return measure(part, arguments.data, jobs=arguments.jobs, progress=progress, report=report)


if __name__ == "__main__":
    sys.exit(main())
