"""``egvs validate``, ``clouds``, ``scores`` and ``train``: does a score predict what detectors find?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from egvs.cli import options, sources
from egvs.cli.commands import Command
from egvs.cli.options import Jobs, Out, Set, SettingsPath
from egvs.core.errors import InputError, MissingBackendError

if TYPE_CHECKING:
    from egvs.scenario.model import Scenario

_Reading = tuple[list[str], list[str], str | None, str | None]
"""Sensors, sites, convention of headings, and columns of measured sweeps or labels."""

DEFAULT_FRAMES = 250
"""Frames of a validation or a dataset."""

_FRAMES_HELP = "Number of frames of held-out traffic."

Spacing = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Minimum time between two frames. \\[default: 7, or what the traffic allows, at least 2]",
    ),
]


def validate(
    scenario: Annotated[
        Path | None,
        typer.Argument(
            metavar="SCENARIO|RUN",
            help="Scenario folder or its scenario.toml, or a run, to use its settings; optional with --against.",
        ),
    ] = None,
    out: Out = None,
    set_: Set = None,
    frames: Annotated[int, typer.Option(min=10, help=_FRAMES_HELP)] = DEFAULT_FRAMES,
    spacing: Spacing = None,
    detector: Annotated[
        str,
        typer.Option(
            metavar="NAME,NAME", help="Detectors to run: points, cluster, pointpillars, range_image, or a plug-in."
        ),
    ] = "points,cluster",
    detections: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="KITTI results of other detectors: DIR/SITE/DETECTOR/FRAME.txt. With --labels: detections in the "
            "labelled sweeps.",
        ),
    ] = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="Also write ground truth and detections as KITTI labels and results.")
    ] = False,
    plan: Annotated[
        bool,
        typer.Option(
            "--plan",
            help="Validate this run's plan (egvs place), in the fused clouds of its first 1, 2, ... sensors.",
        ),
    ] = False,
    plan_from: Annotated[
        Path | None, typer.Option("--plan-from", metavar="DIR", help="Validate the plan in another run's folder.")
    ] = None,
    against: Annotated[
        list[Path] | None,
        typer.Option(metavar="SWEEPS", help="Compare measured sweeps with the simulation: files or a folder."),
    ] = None,
    labels: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LABELS",
            help="Labelled boxes of the sweeps: a file or a folder. Without --against, one of each sensor of a place: "
            "what does one list have of the other?",
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Sensor of the sweeps; of several lists, one for each.")
    ] = None,
    site: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Site of the scenario where the sensor stands; one for each list."),
    ] = None,
    yaw: Annotated[
        str | None,
        typer.Option(metavar="CONVENTION", help="Headings of labels: x-ccw, x-cw, y-ccw or y-cw; by default, found."),
    ] = None,
    columns: Annotated[
        str | None, typer.Option(metavar="VALUE=COLUMN,...", help="Columns of a table of labels, as type=class,x_m=cx.")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Simulate detection from each site, and test which score predicts it; or validate a plan, or measured sweeps."""
    from egvs.cli.console import ProgressDisplay

    of_sweeps = {"--sensor": sensor, "--site": site, "--yaw": yaw, "--columns": columns}
    if against or labels:
        unread = {"--plan": plan, "--plan-from": plan_from, "--keep": keep, "--detections": against and detections}
        for option, unread_value in unread.items():
            if unread_value:
                raise InputError(option, "not available with measured sweeps", f"Omit {option}.")
        reading = sensor or [], site or [], yaw, columns
        if against:
            _validate_against(scenario, set_, out, (tuple(against), tuple(labels or ())), reading, detector)
        else:
            _compare_labels(scenario, set_, out, (tuple(labels or ()), detections), reading)
        return
    for option, value in of_sweeps.items():
        if value is not None:
            raise InputError(option, "only available with measured sweeps", "Add --against SWEEPS or --labels LABELS.")
    if scenario is None:
        raise InputError("SCENARIO", "expected a scenario or a run, got none", "Name one; or use --against SWEEPS.")
    of_plan = plan or plan_from is not None
    if of_plan and (detections is not None or keep):
        option = "--keep" if keep else "--detections"
        raise InputError(option, "not available with a plan", f"Omit {option}, or omit --plan and --plan-from.")
    detectors = [name.strip() for name in detector.split(",") if name.strip()]
    loaded, folder = sources.open_source(scenario, set_, out)
    with ProgressDisplay("validate") as screen:
        from egvs.extensions.validation import plan_validation, site_validation
        from egvs.extensions.validation import tables as validation_tables
        from egvs.extensions.validation.held_out_traffic import FrameSampling
        from egvs.extensions.validation.kitti_results import KittiFiles

        sampling = FrameSampling(frames, spacing)
        if of_plan:
            plan_result = plan_validation.validate_plan(
                loaded, folder, plan_from or folder, sampling=sampling, detectors=detectors, jobs=jobs,
                progress=screen.progress, listener=validation_tables.PlanRunDisplay(screen.say),
            )  # fmt: skip
        else:
            validation = site_validation.validate_sites(
                loaded, folder, sampling=sampling, detectors=detectors, kitti=KittiFiles(detections, keep), jobs=jobs,
                progress=screen.progress, listener=validation_tables.DetectorRunDisplay(screen.say),
            )  # fmt: skip
    if of_plan:
        validation_tables.print_plan_validation(plan_result)
    else:
        validation_tables.print_validation(loaded, folder, validation)


def _validate_against(
    scenario: Path | None,
    set_: list[str] | None,
    out: Path | None,
    sweeps_and_labels: tuple[tuple[Path, ...], tuple[Path, ...]],
    reading: _Reading,
    detector: str,
) -> None:
    """Compare measured sweeps with the simulation, or without labels, with one another."""
    from egvs.cli.console import ProgressDisplay
    from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
    from egvs.extensions.validation.measured import tables
    from egvs.extensions.validation.measured.comparison import ComparisonRequest, compare_labelled, compare_unlabelled

    sweeps, labels = sweeps_and_labels
    sensors, sites, yaw, columns = reading
    for option, names in (("--sensor", sensors), ("--site", sites)):
        if len(names) > 1:
            raise InputError(option, f"expected one name, got {len(names)}", "Sweeps are of one sensor.")
    loaded = _load_for_sweeps(scenario, set_, yaw)
    named = [name.strip() for name in detector.split(",") if name.strip()]
    detectors = tuple(name for name in dict.fromkeys(named) if name != POINT_COUNTS_NAME)
    request = ComparisonRequest(
        sweeps, labels, sensors[0] if sensors else None, sites[0] if sites else None, yaw,
        columns=_column_names(columns), detectors=detectors,
    )  # fmt: skip
    if not labels:
        for option, value in (("--out", out), ("--site", sites), ("--yaw", yaw), ("--columns", columns)):
            if value:
                raise InputError(option, "only available with labels", f"Add --labels LABELS, or omit {option}.")
        with ProgressDisplay("validate"):
            repetition = compare_unlabelled(request, loaded)
        tables.print_repetition(repetition)
        return
    with ProgressDisplay("validate"):
        comparison = compare_labelled(request, loaded)
    tables.print_comparison(comparison)
    if out is not None:
        for path in tables.write_comparison(comparison, out, loaded):
            print(f"wrote {path}")


def _compare_labels(
    scenario: Path | None,
    set_: list[str] | None,
    out: Path | None,
    labels_and_detections: tuple[tuple[Path, ...], Path | None],
    reading: _Reading,
) -> None:
    """Compare lists of labels of one place, or detections with labels."""
    from egvs.cli.console import ProgressDisplay
    from egvs.extensions.validation.measured import agreement_tables
    from egvs.extensions.validation.measured.label_agreement import AgreementRequest, compare_lists

    labels, detections = labels_and_detections
    sensors, sites, yaw, columns = reading
    if detections is None and len(labels) < 2:
        hint = "Add the labels of another sensor of the place, --detections DETECTIONS, or --against SWEEPS."
        raise InputError("--labels", "expected two lists without sweeps, got one", hint)
    if detections is not None and len(labels) > 1:
        problem = f"expected the labels of one sensor with detections, got {len(labels)} lists"
        raise InputError("--labels", problem, "Compare one list at a time.")
    if len(sensors) not in (0, 1, len(labels)):
        problem = f"expected one sensor for each of {len(labels)} lists, or one for all, got {len(sensors)}"
        raise InputError("--sensor", problem, "Repeat --sensor in the order of the lists.")
    if sites and (scenario is None or len(sites) != len(labels)):
        problem = f"expected a scenario, and a site for each of {len(labels)} lists, got {len(sites)}"
        raise InputError("--site", problem, "Repeat --site in the order of the lists.")
    loaded = _load_for_sweeps(scenario, set_, yaw)
    request = AgreementRequest(labels, detections, tuple(sensors), tuple(sites), yaw, _column_names(columns))
    with ProgressDisplay("validate"):
        results = compare_lists(request, loaded)
    agreement_tables.print_agreement(results)
    if out is not None:
        for path in agreement_tables.write_agreement(results, out, loaded):
            print(f"wrote {path}")


def _load_for_sweeps(scenario: Path | None, set_: list[str] | None, yaw: str | None) -> Scenario | None:
    """Return the scenario of measured sweeps, if one is named."""
    from egvs.extensions.validation.measured.yaw_conventions import CONVENTIONS
    from egvs.scenario.loading import load

    if scenario is None and set_:
        raise InputError("--set", "expected a scenario, got none", "Name the scenario.")
    if yaw is not None and yaw not in CONVENTIONS:
        raise InputError("--yaw", f"expected {', '.join(CONVENTIONS)}, got {yaw!r}", "Omit it to find it.")
    return None if scenario is None else load(scenario, set_ or ())


def _column_names(text: str | None) -> dict[str, str]:
    """Return the columns of ``--columns``."""
    names: dict[str, str] = {}
    for item in (text or "").split(","):
        if item.strip():
            value, separator, column = item.partition("=")
            if not separator or not value.strip() or not column.strip():
                raise InputError("--columns", f"expected VALUE=COLUMN, got {item!r}", "For example type=class,x_m=cx.")
            names[value.strip()] = column.strip()
    return names


def clouds(
    scenario: SettingsPath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="A new or empty folder.")],
    site: Annotated[
        list[str] | None, typer.Option(metavar="SITE", help="Only this site (repeatable); all by default.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help=_FRAMES_HELP)] = DEFAULT_FRAMES,
    spacing: Spacing = None,
    kind: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="kitti, openpcdet, ply or pcd. Points are in a levelled frame at the sensor; the README in the folder"
            " says how to turn them back for egvs accept.",
        ),
    ] = "kitti",
    set_: Set = None,
    jobs: Jobs = None,
) -> None:
    """Write labelled point clouds with traffic, for use with any detector."""
    from egvs.cli.console import ProgressDisplay
    from egvs.extensions.validation import tables as validation_tables
    from egvs.extensions.validation.dataset import write_dataset
    from egvs.runs.run_sources import SettingsSource

    loaded = SettingsSource.of(scenario, set_).load()
    with ProgressDisplay("clouds") as screen:
        dataset = write_dataset(
            loaded,
            out,
            sites=site or (),
            frames=frames,
            spacing_s=spacing,
            kind=kind,
            jobs=jobs,
            progress=screen.progress,
        )
    validation_tables.print_export(dataset)


def scores() -> None:
    """Print the scores that a validation compares: formula, whether higher or lower is better, and source."""
    from egvs.extensions.validation import surrogates
    from egvs.extensions.validation import tables as validation_tables

    validation_tables.print_scores(surrogates.score_catalogue())


def train(
    scenarios: Annotated[list[Path], typer.Argument(metavar="SCENARIO...", help="One or more training junctions.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The model file to write, .onnx.")],
    set_: Set = None,
    steps: Annotated[int, typer.Option(min=10, help="Training steps, each on 8 crops of sweeps.")] = 3000,
    frames: Annotated[int, typer.Option(min=10, help="Training frames per junction.")] = 400,
    heights: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Range of mounting heights, in metres above the ground.")
    ] = "2,8",
    convention: Annotated[
        str, typer.Option(help="Origin of point heights: ground, or sensor (as for detectors on cars).")
    ] = "ground",
    seed: Annotated[int, typer.Option(min=0, help="Seed for traffic, poses, samples and initial weights.")] = 1,
    jobs: Jobs = None,
) -> None:
    """Train the PointPillars detector on simulated sweeps of junctions (needs the extra `train`)."""
    from egvs.cli.console import ProgressDisplay
    from egvs.core import files, plugins
    from egvs.extensions.validation import tables as validation_tables
    from egvs.scenario.loading import load

    model = _model_file(out)
    plugins.require_libraries("training", "train", "torch", "onnx", "onnxscript", "onnxruntime")
    try:
        from egvs.extensions.validation.training import train
    except ImportError as error:
        raise MissingBackendError(f"training cannot start: {error}. Run pip install 'egvs[train]'") from None

    if convention not in ("ground", "sensor"):
        raise InputError("--convention", f"expected ground or sensor, got {convention!r}", "Use --convention ground.")
    recipe = train.Recipe(
        steps=steps,
        frames=frames,
        heights_m=options.heights_m(heights),
        seed=seed,
        convention="sensor" if convention == "sensor" else "ground",
    )
    loaded = [load(path, set_ or ()) for path in scenarios]
    files.ensure_writable_folder(model)
    with ProgressDisplay("train") as screen:
        metadata = train.train(loaded, model, recipe, jobs=jobs, progress=screen.progress)
    validation_tables.print_training(model, metadata)


COMMANDS = tuple(Command(verb.__name__, "Study", verb) for verb in (validate, scores, clouds, train))


def _model_file(path: Path) -> Path:
    """Return ``--out`` of ``egvs train``, whose name must end in .onnx."""
    if path.suffix != ".onnx":
        raise InputError("--out", f"expected a file that ends in .onnx, got {str(path)!r}", "Use --out model.onnx.")
    return path
