"""``make validity``: measures, analyses, and writes the tables and figures of docs/validity.md.

What was measured is kept under runs/validity and in the store: an interrupted study goes on, a whole one is analysed
anew in a minute. Sites are looked from on all cores.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.validity import figures, junctions, low_models, poses, study, tables
from benchmarks.validity.junctions import Role, StudyJunction
from benchmarks.validity.looking_from import FAST
from benchmarks.validity.measuring import Part, measure
from benchmarks.validity.record import Record
from benchmarks.validity.study import Extent
from egvs.cli import options
from egvs.core.errors import EgvsError, InputError, MissingBackendError
from egvs.validation.sweeps import POINT_COUNTS_NAME

ROOT = Path(__file__).resolve().parents[2]
DATA = Path("data", "validity")
"""The tables, in the folder of the documentation; docs/validity-tables.md explains them."""

SAID_EVERY_S = 30.0


def main(given: Sequence[str] | None = None) -> int:
    """Run the study; the exit code."""
    try:
        _study(_parser().parse_args(given))
    except EgvsError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.validity", description=__doc__)
    parser.add_argument("--frames", type=int, default=study.FRAMES, help="of unseen traffic (default %(default)s)")
    parser.add_argument(
        "--sensor-frames",
        type=int,
        default=study.SENSOR_FRAMES,
        help="where sensors are compared, 0 for not at all (%(default)s)",
    )
    parser.add_argument("--places", type=int, default=poses.PLACES, help="of the grid (default %(default)s)")
    parser.add_argument("--detector", metavar="NAME,NAME", help="default: all that are installed")
    parser.add_argument("--junction", metavar="NAME,NAME", help="of the shipped ones; default: all")
    parser.add_argument("--osm-training", type=Path, metavar="FILE", help="an OpenStreetMap extract")
    parser.add_argument("--osm-training-at", metavar="LAT,LON", help="its junction; default: the largest")
    parser.add_argument("--osm-held-out", type=Path, metavar="FILE", help="an extract of elsewhere")
    parser.add_argument("--osm-unseen", type=Path, metavar="FILE", help="an extract, for a junction that chose nothing")
    parser.add_argument("--osm-unseen-at", metavar="LAT,LON", help="its junction; default: the largest")
    parser.add_argument("--jobs", type=int, help="processes; default: one a core")
    parser.add_argument("--data", type=Path, default=ROOT / "runs" / "validity", help="what was measured")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="tables and figures")
    return parser


def _study(chosen: argparse.Namespace) -> None:
    begun = time.monotonic()
    detectors, without = _detectors(chosen.detector)
    homes, left_out = _homes(chosen)
    junctions.check_apart(homes)
    chosen.data.mkdir(parents=True, exist_ok=True)
    print(f"preparing {', '.join(name for name, _, _ in homes)}", flush=True)
    each = [_ready(*home, chosen) for home in homes]
    for junction in each:
        junctions.check_unseen(junction.scenario)
    extent = Extent(chosen.frames, chosen.sensor_frames, chosen.places)
    parts = study.parts(each, detectors, extent, chosen.data)
    _tell_plan(parts, chosen.jobs)
    records = {part.name: _measured(part, chosen, begun) for part in parts}
    main_ones = [records[junction.name] for junction in each]
    with_sensors = [records[part.name] for part in parts if part.scores is not None]
    print("analysing")
    made = list(study.tables_of(main_ones, with_sensors, detectors))
    if not with_sensors:
        left_out.append("a comparison of sensors")
    words = study.preface(main_ones, with_sensors, detectors, [*without, *left_out])
    write(chosen.docs, words, made)
    costs = tables.page("Cost of the scores", [], [study.costs(chosen.data, [junction.name for junction in each])])
    (chosen.docs / "validity-costs.md").write_text(costs, encoding="utf-8")
    print(f"{chosen.docs / DATA}: {len(made)} tables, {time.monotonic() - begun:.0f} s")


def write(docs: Path, words: Sequence[str], made: Sequence[tables.Table]) -> None:
    """Write the tables as CSV, and the figures."""
    tables.write(docs / DATA, words, made)
    figures.draw(docs / "images", made)


def _detectors(asked: str | None) -> tuple[list[str], list[str]]:
    """Those asked for, or all that can be made; what is left out, and why."""
    if asked is not None:
        names = [name.strip() for name in asked.split(",") if name.strip()]
        for name in (name for name in names if name != POINT_COUNTS_NAME):
            low_models.make(name)
        return list(dict.fromkeys([POINT_COUNTS_NAME, *names])), []
    found, without = [POINT_COUNTS_NAME], []
    for name in sorted(low_models.names(), key=lambda name: (name not in FAST, name)):
        try:
            low_models.make(name)
            found.append(name)
        except MissingBackendError as error:
            without.append(f"detector {name} ({error})")
    return found, without


def _homes(chosen: argparse.Namespace) -> tuple[list[tuple[str, Role, Path]], list[str]]:
    """The junctions, training ones first; what is left out, and why."""
    names = tuple(chosen.junction.split(",")) if chosen.junction else ()
    if unknown := [name for name in names if name not in junctions.SHIPPED]:
        raise InputError("--junction", repr(unknown[0]), f"one of {', '.join(junctions.SHIPPED)}")
    homes = junctions.shipped(names)
    there = {name for name, _, _ in homes}
    without = [f"{name} (not in this run)" for name in junctions.SHIPPED if name not in there]
    named: dict[Role, tuple[Path | None, str | None]] = {
        "training": (chosen.osm_training, chosen.osm_training_at),
        "held out": (chosen.osm_held_out, None),
        "unseen": (chosen.osm_unseen, chosen.osm_unseen_at),
    }
    for role, (extract, place) in named.items():
        if extract is not None:
            at = options.latitude_and_longitude(place) if place else None
            homes.append(junctions.from_osm(role, extract, at, chosen.data / "junctions"))
        else:
            article = "an" if role == "unseen" else "a"
            without.append(f"{article} {role} junction from OpenStreetMap (no extract was named)")
    return sorted(homes, key=lambda home: junctions.ROLES.index(home[1])), without


def _ready(name: str, role: Role, home: Path, chosen: argparse.Namespace) -> StudyJunction:
    return junctions.ready(name, role, home, chosen.data / "worlds" / name, chosen.places)


def _tell_plan(parts: Sequence[Part], jobs: int | None) -> None:
    """Every part, and how long looking from its sites may take."""
    cores = jobs or os.cpu_count() or 1
    for part in parts:
        looks = ", ".join(f"{name} from {len(sites)}" for name, sites in part.detectors.items())
        print(f"{part.name}: {part.role}, {part.sensor}, {part.frames} frames {part.apart_s:g} s apart, {looks}")
    minutes = sum(study.reckoned_s(part) for part in parts) / cores / 60
    print(f"{len(parts)} parts; looking from all sites takes some {minutes:.0f} minutes on {cores} cores", flush=True)


def _measured(part: Part, chosen: argparse.Namespace, begun: float) -> Record:
    def told(text: str) -> None:
        print(f"{time.monotonic() - begun:6.0f} s  {text}", flush=True)

    said_at = time.monotonic()

    def progress(what: str, done: int, total: int) -> None:
        """A line every half minute."""
        nonlocal said_at
        if time.monotonic() - said_at >= SAID_EVERY_S:
            said_at = time.monotonic()
            told(f"{part.name}: {what} {done}" + (f" of {total}" if total else ""))

    told(f"{part.name}: begins")
    return measure(part, chosen.data, jobs=chosen.jobs, progress=progress, told=told)


if __name__ == "__main__":
    sys.exit(main())
