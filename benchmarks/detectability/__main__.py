"""``make detectability``: learns anew how likely each detector finds a vehicle, from the study's training junctions.

Writes the file of models that the program has as data, and the picture of their calibration. Worlds, traffic and what
detectors find are those of the study of validity (``make validity``): what it left in the store is not made again.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import sklearn

from benchmarks.detectability import examples, figures, writing
from benchmarks.detectability.examples import JunctionExamples
from benchmarks.detectability.fitting import elsewhere, fitted
from benchmarks.validity import junctions, poses, study
from benchmarks.validity.junctions import Role
from benchmarks.validity.study import Extent
from egvs.cli import options
from egvs.core import files
from egvs.core.errors import EgvsError, InputError
from egvs.core.runtime import ProgressCallback
from egvs.scoring.target_scores import DETECTORS, MODEL_FILE
from egvs.validation.detectors import base
from egvs.validation.detectors.base import Detector
from egvs.validation.sweeps import POINT_COUNTS_NAME

ROOT = Path(__file__).resolve().parents[2]
SAID_EVERY_S = 30.0
FEWEST_JUNCTIONS = 2
"""Each is foretold by the others."""


def main(given: Sequence[str] | None = None) -> int:
    """Learn, and write what was learnt; the exit code."""
    try:
        _run(_parser().parse_args(given))
    except EgvsError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detectability", description=__doc__)
    parser.add_argument("--frames", type=int, default=study.FRAMES, help="of unseen traffic (default %(default)s)")
    parser.add_argument("--places", type=int, default=poses.PLACES, help="of the grid (default %(default)s)")
    parser.add_argument("--junction", metavar="NAME,NAME", help="of the shipped training ones; default: all")
    parser.add_argument("--osm-training", type=Path, metavar="FILE", help="an OpenStreetMap extract")
    parser.add_argument("--osm-training-at", metavar="LAT,LON", help="its junction; default: the largest")
    parser.add_argument("--jobs", type=int, help="processes; default: one a core")
    parser.add_argument("--data", type=Path, default=ROOT / "runs" / "validity", help="the study's folder")
    parser.add_argument("--out", type=Path, metavar="DIR", help="for both files; default: where the program has them")
    parser.add_argument("--only-draw", action="store_true", help="the picture of the models that are there")
    return parser


def _run(chosen: argparse.Namespace) -> None:
    models = chosen.out / MODEL_FILE.name if chosen.out else MODEL_FILE
    picture = (chosen.out or ROOT / "docs" / "images") / figures.NAME
    if not chosen.only_draw:
        text = _learnt(chosen)
        models.parent.mkdir(parents=True, exist_ok=True)
        with files.atomic_write(models) as partial:
            partial.write_text(text, encoding="utf-8")
        print(models)
    elif not models.is_file():
        raise InputError("--only-draw", f"no such file ({models})", "a folder that was written by this command")
    figures.draw(picture, models)
    print(picture)


def _learnt(chosen: argparse.Namespace) -> str:
    """The file of models."""
    begun = time.monotonic()

    def told(text: str) -> None:
        print(f"{time.monotonic() - begun:6.0f} s  {text}", flush=True)

    detectors = {name: base.make_detector(name) for name in DETECTORS}
    homes = _homes(chosen)
    chosen.data.mkdir(parents=True, exist_ok=True)
    told(f"preparing {', '.join(name for name, _, _ in homes)}")
    each = {name: _examples((name, role, home), detectors, chosen, told) for name, role, home in homes}
    learnt_on = {
        name: writing.LearntOn(
            {detector: len(e.hits) for detector, e in its.by_detector.items()}, its.sensors, its.vehicle_frames
        )
        for name, its in each.items()
    }
    settings = {name: files.hash_json(detector.settings) for name, detector in detectors.items()}
    about = writing.About(learnt_on, chosen.frames, settings, sklearn.__version__)
    models = {}
    for name in detectors:
        told(f"{name}: learning")
        mine = {junction: its.by_detector[name] for junction, its in each.items()}
        models[name] = fitted(list(mine.values())) | {"elsewhere": elsewhere(mine)}
        rho = models[name]["elsewhere"]["rho_with_ap"]
        told(f"{name}: rho with AP elsewhere, {', '.join(f'{junction} {its:.3f}' for junction, its in rho.items())}")
    return writing.text(about, models)


def _homes(chosen: argparse.Namespace) -> list[tuple[str, Role, Path]]:
    """The training junctions."""
    known = [name for name, role in junctions.SHIPPED.items() if role == "training"]
    names = chosen.junction.split(",") if chosen.junction else known
    if unknown := [name for name in names if name not in known]:
        raise InputError(
            "--junction", repr(unknown[0]), f"one of {', '.join(known)}: others are quoted, not learnt from"
        )
    homes = junctions.shipped(names)
    at = options.latitude_and_longitude(chosen.osm_training_at) if chosen.osm_training_at else None
    if chosen.osm_training is not None:
        homes.append(junctions.from_osm("training", chosen.osm_training, at, chosen.data / "junctions"))
    elif at is not None:
        raise InputError("--osm-training-at", "no --osm-training", "the extract in which it lies")
    if len(homes) < FEWEST_JUNCTIONS:
        there = ", ".join(name for name, _, _ in homes) or "none"
        raise InputError("--junction", f"{there} alone", "two junctions at least: each is foretold by the others")
    return homes


def _examples(
    home: tuple[str, Role, Path],
    detectors: dict[str, Detector],
    chosen: argparse.Namespace,
    told: Callable[[str], None],
) -> JunctionExamples:
    name = home[0]
    junction = junctions.ready(*home, chosen.data / "worlds" / name, chosen.places)
    junctions.check_unseen(junction.scenario)
    extent = Extent(chosen.frames, 0, chosen.places)
    (part,) = study.parts([junction], [POINT_COUNTS_NAME, *detectors], extent, chosen.data)
    looks = ", ".join(f"{detector} from {len(part.detectors[detector])}" for detector in detectors)
    minutes = study.reckoned_s(part) / 60
    told(f"{name}: {part.frames} frames {part.apart_s:g} s apart, {looks}; some {minutes:.0f} minutes of one core")
    return examples.examples_of(part, detectors, chosen.data, jobs=chosen.jobs, progress=_progress(name, told))


def _progress(name: str, told: Callable[[str], None]) -> ProgressCallback:
    """A line every half minute."""
    said_at = time.monotonic()

    def progress(what: str, done: int, total: int) -> None:
        nonlocal said_at
        if time.monotonic() - said_at >= SAID_EVERY_S:
            said_at = time.monotonic()
            told(f"{name}: {what} {done}" + (f" of {total}" if total else ""))

    return progress


if __name__ == "__main__":
    sys.exit(main())
