"""The larger study, by one command: ``python -m benchmarks.across_junctions build``, ``list``, ``measure``, ``tables``.

    build     make the scenarios, draw their candidates, look at their traffic in a short simulation
    detector  train PointPillars (needs PyTorch); an interrupted training continues where it stopped
    list      print the protocol and its hash
    measure   measure what is missing, part by part; an interrupted study continues where it stopped
    fit       compare models of the score on the training junctions, or fit them
    tables    write the tables from the records
    levels    measure the level of the score on simulated streets, or fit its corrections there

Junctions whose maps are not in the folder of ``--maps`` are left out, and named.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.across_junctions import build, candidates, costs, levels, streets, study_detectors, tables, training
from benchmarks.across_junctions.measurement import Extent, PartPlan, measure
from benchmarks.across_junctions.models import figures
from benchmarks.across_junctions.protocol import (
    CANDIDATES_FILE,
    FOLDER,
    ROLES,
    WORLDS_FILE,
    Junction,
    Protocol,
    ProtocolFiles,
    check_frozen,
    detector_junctions,
    of_junction,
    read_protocol,
    write_frozen,
)
from benchmarks.across_junctions.records import NOT_DETECTORS, SCORES, VEHICLES
from benchmarks.across_junctions.worlds import MissingMapError, make_world
from egvs.core import files, plugins
from egvs.core.errors import EgvsError, InputError, MissingBackendError
from egvs.core.progress import ProgressCallback
from egvs.extensions.validation.detectors import base
from egvs.scenario.loading import load
from egvs.scoring.target_scores import CORRECTIONS_FILE

ROOT = Path(__file__).resolve().parents[2]
RECORDS = ROOT / "docs" / "data" / "larger_study" / "records"
REPORT_EVERY_S = 30.0

TRAINING_STEPS = 4000
"""Of PointPillars; the shipped model was trained with as many."""

MIN_FRAMES = 20
"""Of a trial: two for each block."""


def main(given: Sequence[str] | None = None) -> int:
    """Run one step of the study, and return the exit code."""
    try:
        arguments = _parser().parse_args(given)
        code: int = arguments.step(arguments)
    except EgvsError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.across_junctions",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    common = argparse.ArgumentParser(add_help=False)
    data = argparse.ArgumentParser(add_help=False)
    data.add_argument("--data", type=Path, default=ROOT / "runs" / "across_junctions", help="folder of the study")
    common.add_argument("--maps", type=Path, metavar="DIR", help="folder of the maps that are not shipped")
    common.add_argument("--junction", metavar="NAME,NAME", help="default: all (build), or all with candidates")
    steps = parser.add_subparsers(required=True, metavar="build|list|detector|measure|fit|tables|levels")

    step = steps.add_parser("build", parents=[data, common], help="make the scenarios")
    step.add_argument(
        "--write",
        action="store_true",
        help="write the rows of these junctions in candidates.csv and worlds.csv, which changes the hash",
    )
    step.set_defaults(step=_build)

    step = steps.add_parser("list", parents=[data], help="print the protocol and its hash")
    step.add_argument("--freeze", action="store_true", help="write the hashes of score, detectors and statistics")
    step.add_argument("--again", metavar="REASON", help="freeze after a held-out junction was measured; recorded")
    step.add_argument("--renamed", metavar="OLD=NEW,OLD=NEW", help="frozen modules that were moved or merged; recorded")
    step.set_defaults(step=_list)

    step = steps.add_parser("detector", parents=[data], help="train PointPillars (needs PyTorch)")
    step.add_argument("--maps", type=Path, metavar="DIR", help="folder of the maps that are not shipped")
    step.add_argument("--steps", type=int, default=TRAINING_STEPS, help="of the training (default %(default)s)")
    step.add_argument("--write", type=Path, metavar="FILE", required=True, help="the model, .onnx")
    step.set_defaults(step=_detector)

    step = steps.add_parser("measure", parents=[data, common], help="measure what is missing")
    step.add_argument(
        "--part", metavar="NAME,NAME", help=f"detectors, {SCORES}, {VEHICLES}; default: as the protocol says"
    )
    step.add_argument("--role", choices=ROLES, help="only junctions of this role")
    step.add_argument("--held-out", action="store_true", help="allow held-out junctions, which can be spent only once")
    step.add_argument("--frames", type=int, help="fewer than the protocol says: a trial, at training junctions only")
    step.add_argument("--candidates", type=int, help="the first of the protocol's candidates: a trial, too")
    step.add_argument(
        "--again", metavar="REASON", help="measure a part again that is not of a training junction; recorded"
    )
    step.add_argument("--jobs", type=int, help="processes; default: one a core")
    step.set_defaults(step=_measure)

    step = steps.add_parser("fit", parents=[data], help="compare models on the training junctions, each on the others")
    step.add_argument("--detector", metavar="NAME,NAME", help="to compare for; default: those that train the score")
    step.add_argument("--without", metavar="NAME,NAME", help="leave these junctions out of the comparison")
    step.add_argument("--write", type=Path, metavar="FILE", help="fit the shipped form and write it, .json")
    step.add_argument("--figure", type=Path, metavar="FILE", help="draw the calibration of --write, .png")
    step.set_defaults(step=_fit)

    step = steps.add_parser("tables", parents=[data], help="write the tables")
    step.add_argument("--out", type=Path, metavar="DIR", help="for the tables; default: below the folder of the study")
    step.set_defaults(step=_tables)

    step = steps.add_parser("levels", help="level of the score on simulated streets, without and with corrections")
    step.add_argument("--data", type=Path, default=ROOT / "runs" / "levels", help="folder of the streets")
    step.add_argument("--junction", metavar="NAME,NAME", help="measure these only, and write no table")
    step.add_argument("--fit", action="store_true", help="compare corrections, and write the chosen ones")
    step.add_argument(
        "--order", action="store_true", help="order of sites at held-out junctions of the larger study without maps"
    )
    step.add_argument("--frames", type=int, help="fewer than the streets have: a trial, which writes below --data only")
    step.add_argument("--candidates", type=int, help="fewer than are measured: a trial, too")
    step.add_argument("--out", type=Path, default=ROOT / "docs" / "data", metavar="DIR", help="for the tables")
    step.add_argument("--jobs", type=int, help="processes; default: one a core")
    step.set_defaults(step=_levels)
    return parser


def _selected(protocol: Protocol, names: str | None, default: Sequence[Junction]) -> list[Junction]:
    """Return the junctions of ``--junction``, or the default."""
    if names is None:
        return list(default)
    return [protocol.junction(name.strip()) for name in names.split(",") if name.strip()]


def _build(arguments: argparse.Namespace) -> int:
    protocol = read_protocol()
    built = []
    for junction in _selected(protocol, arguments.junction, protocol.junctions):
        start_s = time.monotonic()
        built.append(build.build(protocol, junction, arguments.maps, arguments.data / "worlds"))
        print(f"{junction.name}: {time.monotonic() - start_s:.0f} s", flush=True)
    build.print_table(built)
    incomplete = [entry for entry in built if entry.problem]
    if arguments.write:
        if incomplete:
            names = ", ".join(entry.junction.name for entry in incomplete)
            raise InputError("--write", f"{names} could not be built", "Name the folder of the maps with --maps.")
        _write(protocol, built)
        print(f"SHA-256 of the protocol: {ProtocolFiles().digest}")
        return 0
    different = _differences(built)
    for text in different:
        print(text)
    return 1 if incomplete or different else 0


def _write(protocol: Protocol, built: Sequence[build.BuiltJunction]) -> None:
    """Replace the rows of the built junctions in the files of the protocol; rows of others stay."""
    drawn = candidates.read_candidates() if (FOLDER / CANDIDATES_FILE).is_file() else {}
    digests = build.read_worlds() if (FOLDER / WORLDS_FILE).is_file() else {}
    for entry in built:
        if entry.candidates:
            drawn[entry.junction.name] = dict(entry.candidates)
        digests[entry.junction.name] = entry.digest
    names = [junction.name for junction in protocol.junctions]
    candidates.write_candidates({name: drawn[name] for name in names if name in drawn})
    build.write_worlds({name: digests[name] for name in names if name in digests})


def _differences(built: Sequence[build.BuiltJunction]) -> list[str]:
    """Return what differs from the files of the protocol."""
    drawn, digests = candidates.read_candidates(), build.read_worlds()
    texts = []
    for entry in built:
        if entry.problem:
            continue
        if of_junction(digests, entry.junction, WORLDS_FILE) != entry.digest:
            texts.append(f"{entry.junction.name}: the scenario differs from the one of the protocol")
        if entry.candidates and of_junction(drawn, entry.junction, CANDIDATES_FILE) != entry.candidates:
            texts.append(f"{entry.junction.name}: the candidates differ from those of the protocol")
    return texts


def _list(arguments: argparse.Namespace) -> int:
    if not arguments.freeze and (arguments.again or arguments.renamed):
        raise InputError("--again, --renamed", "expected --freeze beside them", "Add it.")
    if arguments.freeze:
        renamed = dict(_renamed_module(pair) for pair in (arguments.renamed or "").split(",") if pair.strip())
        print(write_frozen(arguments.data / "records", again=arguments.again or "", renamed=renamed))
    protocol, digests = read_protocol(), ProtocolFiles()
    rule = protocol.candidates
    installed = base.detector_names()
    for junction in protocol.junctions:
        heights = ", ".join(f"{height:g}" for height in protocol.heights_m(junction))
        frames = f"{protocol.frames_of(junction)} frames" if heights else ""
        print(f"{junction.name:16} {junction.role:11} {f'{heights} m' if heights else '':14} {frames:11}"
              f" {junction.differs_in}")  # fmt: skip
        for entry in junction.files:
            print(f"{'':56}{entry.name} {entry.sha256}")
    print(f"{rule.count} candidates per junction: pitch {rule.pitch_deg[0]:g} to {rule.pitch_deg[1]:g}, roll"
          f" {rule.roll_deg[0]:g} to {rule.roll_deg[1]:g} degrees; seed {protocol.seed}")  # fmt: skip
    print(f"sensors: {', '.join(rule.sensors)}")
    print(f"frames at least {protocol.apart_s:g} s apart")
    for role, names in (("training", protocol.detectors.training), ("held out", protocol.detectors.held_out)):
        texts = [name if name in installed else f"{name} (not installed)" for name in names]
        print(f"detectors at {role} junctions: {', '.join(texts)}")
    for name, digest in digests.digests.items():
        print(f"{digest}  {name}")
    print(f"SHA-256 of the protocol: {digests.digest}")
    return 0


def _levels(arguments: argparse.Namespace) -> int:
    if arguments.order:
        return _order(arguments)
    protocol = read_protocol(streets.STREETS_FILE)
    data, out, corrections = arguments.data, arguments.out, CORRECTIONS_FILE
    if arguments.frames is not None or arguments.candidates is not None:
        protocol = streets.shortened(protocol, arguments.frames)
        out = data = data / f"trial_{arguments.frames or 'all'}_frames_{arguments.candidates or 'all'}_candidates"
        corrections = data / CORRECTIONS_FILE.name
    start_s = time.monotonic()
    rows = {}
    for junction in _selected(protocol, arguments.junction, protocol.junctions):
        rows[junction.name] = streets.measure(
            protocol,
            junction,
            data,
            candidates=arguments.candidates or streets.CANDIDATES,
            jobs=arguments.jobs,
            progress=_progress(junction.name, start_s),
        )
        print(f"{time.monotonic() - start_s:6.0f} s  {junction.name}", flush=True)
    if arguments.junction is not None:
        return 0
    fitting, others = (
        [rows[junction.name] for junction in protocol.junctions if junction.role == role]
        for role in ("training", "held out")
    )
    if arguments.fit:
        print(levels.comparison_text(levels.compare(fitting)))
        models = levels.models_by(levels.CHOSEN, fitting)
        files.write_text(corrections, levels.corrections_text(models, fitting))
    else:
        models = levels.corrected_models()
    table = [*levels.table(others, levels.uncorrected_models(), "uncorrected"),
             *levels.table(others, models, "corrected")]  # fmt: skip
    files.write_text(out / "street_levels.csv", levels.table_text(table))
    print(levels.summary_text(table))
    return 0


def _order(arguments: argparse.Namespace) -> int:
    protocol = read_protocol()
    orders = []
    for junction in _selected(protocol, arguments.junction, protocol.junctions):
        if junction.role == "held out" and not junction.files:
            orders += levels.study_orders(protocol, junction, RECORDS, arguments.data / "study")
    table = levels.orders_text(orders)
    files.write_text(arguments.out / "street_levels_order.csv", table)
    print(table, end="")
    return 0


def _renamed_module(pair: str) -> tuple[str, str]:
    """Return the old and the new name of a module."""
    old, _, new = pair.partition("=")
    return old.strip(), new.strip()


def _detector(arguments: argparse.Namespace) -> int:
    plugins.require_libraries("training", "train", "torch", "onnx", "onnxscript", "onnxruntime")
    from egvs.extensions.validation.training.train import Recipe, train

    protocol = read_protocol()
    scenarios = []
    for junction in detector_junctions(protocol):
        folder = _world(protocol, junction, arguments)
        if folder is None:
            raise InputError("--maps", f"{junction.name} has no scenario", "Name the folder of the maps.")
        scenarios.append(load(folder).model_copy(update={"name": junction.name}))
    recipe = Recipe(steps=arguments.steps)
    train(scenarios, arguments.write, recipe, progress=_progress("detector", time.monotonic()))
    print(arguments.write)
    return 0


def _measure(arguments: argparse.Namespace) -> int:
    plans = _plans(arguments)
    start_s = time.monotonic()
    measured = []
    for plan in plans:
        print(f"{time.monotonic() - start_s:6.0f} s  {plan.name}", flush=True)
        info = measure(plan, jobs=arguments.jobs, progress=_progress(plan.name, start_s))
        measured.append(info)
        took = f"{info.seconds:.0f} s, {info.vehicles} different vehicles"
        print(f"{time.monotonic() - start_s:6.0f} s  {plan.name}: {took}")
    print(costs.estimate(measured, read_protocol()))
    return 0


def _plans(arguments: argparse.Namespace) -> list[PartPlan]:
    """Return the parts to measure; check everything before the first one."""
    protocol = read_protocol()
    selected = [
        junction for junction in _selected(protocol, arguments.junction, protocol.measured_junctions)
        if arguments.role in (None, junction.role)
    ]  # fmt: skip
    for junction in selected:
        _check_role(junction, arguments)
    if any(junction.role == "held out" for junction in selected):
        check_frozen()
    digest, each = ProtocolFiles().digest, candidates.read_candidates()
    plans = []
    for junction in selected:
        extent = _extent(protocol, junction, arguments)
        folder = _world(protocol, junction, arguments)
        if folder is not None:
            drawn = of_junction(each, junction, CANDIDATES_FILE)
            records = arguments.data / ("records" if extent == Extent.of(protocol, junction) else "trial")
            plans += [
                PartPlan(protocol, digest, junction, part, folder, drawn, extent, records, arguments.again or "")
                for part in _parts(protocol, junction, arguments.part)
            ]
    return plans


def _check_role(junction: Junction, arguments: argparse.Namespace) -> None:
    if junction.role not in ROLES:
        problem = f"{junction.name} is for training detectors, so nothing is measured there"
        raise InputError("--junction", problem, "Use other junctions.")
    if junction.role != "training" and (arguments.frames is not None or arguments.candidates is not None):
        problem = f"a trial at {junction.name} would spend a junction that is {junction.role}"
        raise InputError("--frames, --candidates", problem, "Use a training junction.")
    if junction.role == "held out" and not arguments.held_out:
        problem = f"{junction.name} is held out, and can be measured only once"
        raise InputError("--junction", problem, "Add --held-out when all choices are made, or use --role training.")


def _extent(protocol: Protocol, junction: Junction, arguments: argparse.Namespace) -> Extent:
    """Return what is measured at a junction: what the protocol says, or less."""
    whole = Extent.of(protocol, junction)
    frames = whole.frames if arguments.frames is None else arguments.frames
    count = whole.candidates if arguments.candidates is None else arguments.candidates
    if not (MIN_FRAMES <= frames <= whole.frames and 1 <= count <= whole.candidates):
        problem = f"expected {MIN_FRAMES} to {whole.frames} frames and 1 to {whole.candidates} candidates"
        raise InputError("--frames, --candidates", f"{problem}, got {frames} and {count}")
    return Extent(frames, count)


def _world(protocol: Protocol, junction: Junction, arguments: argparse.Namespace) -> Path | None:
    """Return the scenario of a junction if its maps are there and it is the one of the protocol."""
    try:
        folder = make_world(protocol, junction, arguments.maps, arguments.data / "worlds")
    except MissingMapError as error:
        print(f"without {junction.name}: {error}")
        return None
    if of_junction(build.read_worlds(), junction, WORLDS_FILE) != build.world_digest(folder):
        problem = "the scenario differs from the one of the protocol"
        raise InputError(folder, problem, "Use the versions of SUMO and of the libraries that constraints.txt names.")
    return folder


def _parts(protocol: Protocol, junction: Junction, names: str | None) -> list[str]:
    """Return the requested parts of a junction, or those of the protocol; detectors must be installed."""
    of_protocol = (*NOT_DETECTORS, *protocol.detectors_of(junction))
    known = (*of_protocol, study_detectors.SENSOR) if junction.role == "training" else of_protocol
    parts = list(of_protocol) if names is None else [name.strip() for name in names.split(",") if name.strip()]
    for name in parts:
        if name not in known:
            raise InputError("--part", f"expected some of {', '.join(known)} at {junction.name}, got {name!r}")
        if name not in NOT_DETECTORS:
            _check_detector(name)
    return parts


def _check_detector(name: str) -> None:
    try:
        study_detectors.make(name, "--part")
    except MissingBackendError as error:
        raise InputError("--part", str(error)) from None


def _progress(name: str, start_s: float) -> ProgressCallback:
    """Return a callback that prints a line every half minute."""
    reported_at = time.monotonic()

    def progress(what: str, done: int, total: int) -> None:
        nonlocal reported_at
        if time.monotonic() - reported_at >= REPORT_EVERY_S:
            reported_at = time.monotonic()
            text = f"{what} {done}" + (f" of {total}" if total else "")
            print(f"{reported_at - start_s:6.0f} s  {name}: {text}", flush=True)

    return progress


def _fit(arguments: argparse.Namespace) -> int:
    protocol, records = read_protocol(), arguments.data / "records"
    without = [name.strip() for name in (arguments.without or "").split(",") if name.strip()]
    for name in without:
        protocol.junction(name)
    if arguments.write is not None and (without or arguments.detector):
        problem = "the shipped models are of all detectors and training junctions"
        raise InputError("--write", problem, "Leave out --detector and --without.")
    if arguments.figure is not None and arguments.write is None:
        raise InputError("--figure", "it shows the models of --write", "Add --write FILE.")
    if arguments.write is not None:
        files.write_text(arguments.write, training.fitted_models(records, protocol))
        print(arguments.write)
        if arguments.figure is not None:
            figures.draw(arguments.figure, arguments.write)
            print(arguments.figure)
        return 0
    for name in (arguments.detector or ",".join(protocol.detectors.training)).split(","):
        rows = training.read_training(records, protocol, name, without)
        lines = training.compare(rows, name, arguments.data / ("fit_without" if without else "fit"))
        print("\n".join(lines), flush=True)
    return 0


def _tables(arguments: argparse.Namespace) -> int:
    out = arguments.out or arguments.data / "tables"
    for text in tables.write_tables(arguments.data / "records", out, read_protocol(), ProtocolFiles().digest):
        print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
