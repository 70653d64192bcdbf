"""The verbs that ask whether a score foretells detection: each parses, calls, prints; nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.cli import arguments
from pipeline.cli.arguments import Jobs, Out, ScenarioPath, Set
from pipeline.core.errors import InputError, MissingBackendError

if TYPE_CHECKING:
    from pipeline.scenario.models import Scenario

DEFAULT_FRAMES = 1000
"""Of validation: average precision, BEV + 3D on a scale from 0 to 200, then had a standard error of 2.4 to 6.5."""

_Scenarios = Annotated[list[Path], typer.Argument(metavar="SCENARIO...", help="Training junctions, one or more.")]


def clouds(
    scenario: ScenarioPath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="A new folder, or an empty one.")],
    site: Annotated[
        list[str] | None, typer.Option(metavar="SITE", help="Of this site only; all by default. Repeatable.")
    ] = None,
    frames: Annotated[
        int, typer.Option(min=1, help="Of traffic that the TPOG never saw, at least 2 s apart.")
    ] = DEFAULT_FRAMES,
    kind: Annotated[str, typer.Option("--format", metavar="FORMAT", help="kitti, openpcdet, ply or pcd.")] = "kitti",
    set_: Set = None,
    jobs: Jobs = None,
) -> None:
    """Write labelled point clouds with traffic, for anyone's detector."""
    from pipeline.cli.progress import Screen
    from pipeline.cli.validation import tables
    from pipeline.scenario.loading import load
    from pipeline.validation.exports.exporting import export

    resolved = load(scenario, set_ or ())
    with Screen("clouds") as screen:
        done = export(resolved, out, sites=site or (), frames=frames, kind=kind, jobs=jobs, progress=screen.progress)
    tables.print_export(done)


def scores() -> None:
    """Print the scores that validation compares: formula, which way is better, source."""
    from pipeline.cli.validation import tables
    from pipeline.validation.surrogates import registry

    tables.print_scores(registry.catalogue())


def validate(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    frames: Annotated[
        int, typer.Option(min=10, help="Of traffic that the TPOG never saw, at least 2 s apart.")
    ] = DEFAULT_FRAMES,
    detector: Annotated[
        str, typer.Option(metavar="NAME,NAME", help="points, and detectors that are installed: cluster, pointpillars.")
    ] = "points,cluster",
    detections: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="KITTI results of other detectors: DIR/SITE/DETECTOR/FRAME.txt."),
    ] = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="Also write ground truth and detections as KITTI labels and results.")
    ] = False,
    plan: Annotated[
        bool, typer.Option("--plan", help="Look from this run's plan (egvs place) instead: fused clouds of 1, 2, ...")
    ] = False,
    plan_from: Annotated[
        Path | None, typer.Option("--plan-from", metavar="DIR", help="The same for the plan in another run's folder.")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """What would detectors find from each site, and which score foretells it? And in the fused clouds of a plan?"""
    from pipeline.cli.progress import Screen
    from pipeline.cli.validation import tables
    from pipeline.runs.workflow import default_folder
    from pipeline.scenario.loading import load
    from pipeline.validation import validating

    loaded = load(scenario, set_ or ())
    folder = out or default_folder(loaded)
    names = [name.strip() for name in detector.split(",") if name.strip()]
    if plan or plan_from is not None:
        if detections is not None or keep:
            option = "--keep" if keep else "--detections"
            raise InputError(option, "given with a plan", "one of them: results are those of single sites")
        _validate_plan(loaded, folder, plan_from or folder, frames, names, jobs)
        return
    with Screen("validate") as screen:
        done = validating.validate(
            loaded, folder, frames=frames, detectors=names, detections=detections, keep=keep, jobs=jobs,
            progress=screen.progress, listener=tables.LookLines(screen.say),
        )  # fmt: skip
    tables.print_validation(loaded, folder, done)


def _validate_plan(
    loaded: Scenario, folder: Path, plan_folder: Path, frames: int, detectors: list[str], jobs: int | None
) -> None:
    from pipeline.cli.progress import Screen
    from pipeline.cli.validation import tables
    from pipeline.validation.fused import validating

    with Screen("validate") as screen:
        done = validating.validate(
            loaded, folder, plan_folder, frames=frames, detectors=detectors, jobs=jobs, progress=screen.progress,
            listener=tables.FusedLines(screen.say),
        )  # fmt: skip
    tables.print_plan_validation(done)


def train(
    scenarios: _Scenarios,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The model to write, .onnx.")],
    set_: Set = None,
    steps: Annotated[int, typer.Option(min=10, help="Of learning, each from 8 crops of sweeps.")] = 3000,
    frames: Annotated[int, typer.Option(min=10, help="Of traffic of each junction to learn from.")] = 400,
    heights: Annotated[
        str, typer.Option(metavar="LOW,HIGH", help="Mounting heights to learn from, metres above the ground.")
    ] = "2,7",
    convention: Annotated[
        str, typer.Option(help="What heights of points count from: ground, or sensor as detectors for cars do.")
    ] = "ground",
    seed: Annotated[int, typer.Option(min=0, help="Of traffic, poses, samples and the network's first values.")] = 1,
    jobs: Jobs = None,
) -> None:
    """Train the PointPillars detector on simulated sweeps of junctions (needs the extra `train`)."""
    from pipeline.cli.progress import Screen
    from pipeline.cli.validation import tables
    from pipeline.core import files, plugins
    from pipeline.scenario.loading import load

    model = arguments.model_file(out)
    plugins.require("training", "train", "torch", "onnx", "onnxscript", "onnxruntime")
    try:
        from pipeline.validation.training import train as training
    except ImportError as error:
        raise MissingBackendError(f"training cannot start: {error}; pip install 'egvs[train]'") from None

    if convention not in ("ground", "sensor"):
        raise InputError("--convention", repr(convention), "ground or sensor")
    recipe = training.Recipe(
        steps=steps,
        frames=frames,
        heights_m=arguments.heights_m(heights),
        seed=seed,
        convention="sensor" if convention == "sensor" else "ground",
    )
    loaded = [load(path, set_ or ()) for path in scenarios]
    files.make_room(model)
    with Screen("train") as screen:
        about = training.train(loaded, model, recipe, jobs=jobs, progress=screen.progress)
    tables.print_training(model, about)


VERBS = (validate, clouds, scores, train)
"""In the order of the help."""
