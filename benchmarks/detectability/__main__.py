"""``make detectability``: fit the probability that each detector finds a vehicle, on the study's training junctions.

Writes the file of models that the program contains, and the picture of their calibration. Worlds, traffic and
detections are those of the validity study (``make validity``), whose cached results are reused.
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
from benchmarks.detectability.fitting import cross_validate, fit_model
from benchmarks.validity import junctions, poses, study
from benchmarks.validity.junctions import Role
from benchmarks.validity.study import Extent
from egvs.cli import options
from egvs.core import files
from egvs.core.errors import EgvsError, InputError
from egvs.core.progress import ProgressCallback
from egvs.scoring.target_scores import DETECTORS, MODEL_FILE
from egvs.validation.detectors import base
from egvs.validation.detectors.base import Detector
from egvs.validation.sweeps import POINT_COUNTS_NAME

ROOT = Path(__file__).resolve().parents[2]
REPORT_EVERY_S = 30.0
MIN_JUNCTIONS = 2
"""Each is predicted by the model of the others."""


def main(given: Sequence[str] | None = None) -> int:
    """Fit and write the models, and return the exit code."""
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


def _run(arguments: argparse.Namespace) -> None:
    models = arguments.out / MODEL_FILE.name if arguments.out else MODEL_FILE
    picture = (arguments.out or ROOT / "docs" / "images") / figures.NAME
    if not arguments.only_draw:
        text = _fit_models(arguments)
        models.parent.mkdir(parents=True, exist_ok=True)
        with files.atomic_write(models) as partial:
            partial.write_text(text, encoding="utf-8")
        print(models)
    elif not models.is_file():
        raise InputError("--only-draw", f"no such file ({models})", "Give a folder written by this command.")
    figures.draw(picture, models)
    print(picture)


def _fit_models(arguments: argparse.Namespace) -> str:
    """Return the file of models."""
    start_s = time.monotonic()

    def report(text: str) -> None:
        print(f"{time.monotonic() - start_s:6.0f} s  {text}", flush=True)

    detectors = {name: base.make_detector(name) for name in DETECTORS}
    folders = _junction_folders(arguments)
    arguments.data.mkdir(parents=True, exist_ok=True)
    report(f"preparing {', '.join(name for name, _, _ in folders)}")
    each = {name: _examples((name, role, home), detectors, arguments, report) for name, role, home in folders}
    learnt_on = {
        name: writing.TrainingJunction(
            {detector: len(e.hits) for detector, e in value.by_detector.items()}, value.sensors, value.vehicle_frames
        )
        for name, value in each.items()
    }
    settings = {name: files.hash_json(detector.settings) for name, detector in detectors.items()}
    metadata = writing.TrainingMetadata(learnt_on, arguments.frames, settings, sklearn.__version__)
    models = {}
    for name in detectors:
        report(f"{name}: fitting")
        by_junction = {junction: value.by_detector[name] for junction, value in each.items()}
        models[name] = fit_model(list(by_junction.values())) | {"elsewhere": cross_validate(by_junction)}
        rho = models[name]["elsewhere"]["rho_with_ap"]
        by_other = ", ".join(f"{junction} {value:.3f}" for junction, value in rho.items())
        report(f"{name}: rho with AP at other junctions, {by_other}")
    return writing.text(metadata, models)


def _junction_folders(arguments: argparse.Namespace) -> list[tuple[str, Role, Path]]:
    """Return the training junctions."""
    known = [name for name, role in junctions.SHIPPED.items() if role == "training"]
    names = arguments.junction.split(",") if arguments.junction else known
    if unknown := [name for name in names if name not in known]:
        problem = f"expected training junctions, got {unknown[0]!r}"
        raise InputError("--junction", problem, f"Use some of {', '.join(known)}.")
    folders = junctions.shipped(names)
    at = options.latitude_and_longitude(arguments.osm_training_at) if arguments.osm_training_at else None
    if arguments.osm_training is not None:
        folders.append(junctions.from_osm("training", arguments.osm_training, at, arguments.data / "junctions"))
    elif at is not None:
        raise InputError("--osm-training-at", "used without --osm-training", "Give the extract that contains it.")
    if len(folders) < MIN_JUNCTIONS:
        there = ", ".join(name for name, _, _ in folders) or "none"
        raise InputError("--junction", f"expected at least {MIN_JUNCTIONS} junctions, got {there}", "Add another one.")
    return folders


def _examples(
    home: tuple[str, Role, Path],
    detectors: dict[str, Detector],
    arguments: argparse.Namespace,
    report: Callable[[str], None],
) -> JunctionExamples:
    name = home[0]
    junction = junctions.ready(*home, arguments.data / "worlds" / name, arguments.places)
    junctions.check_unseen(junction.scenario)
    extent = Extent(arguments.frames, 0, arguments.places)
    (part,) = study.parts([junction], [POINT_COUNTS_NAME, *detectors], extent, arguments.data)
    looks = ", ".join(f"{detector} from {len(part.detectors[detector])}" for detector in detectors)
    minutes = study.estimated_s(part) / 60
    report(f"{name}: {part.frames} frames {part.apart_s:g} s apart, {looks}; about {minutes:.0f} minutes on one core")
    return examples.examples_of(part, detectors, arguments.data, jobs=arguments.jobs, progress=_progress(name, report))


def _progress(name: str, report: Callable[[str], None]) -> ProgressCallback:
    """Return a callback that prints a line every half minute."""
    reported_at = time.monotonic()

    def progress(what: str, done: int, total: int) -> None:
        nonlocal reported_at
        if time.monotonic() - reported_at >= REPORT_EVERY_S:
            reported_at = time.monotonic()
            report(f"{name}: {what} {done}" + (f" of {total}" if total else ""))

    return progress


if __name__ == "__main__":
    sys.exit(main())
