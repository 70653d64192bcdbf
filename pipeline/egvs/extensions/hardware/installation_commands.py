"""``egvs sheets`` and ``egvs accept``: install a sensor, and check it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from egvs.cli.options import Run
from egvs.core.errors import EgvsError, InputError
from egvs.core.wording import format_percent
from egvs.extensions.hardware.installation.acceptance_limits import MAX_VEHICLE_HEIGHT_M, Limits

if TYPE_CHECKING:
    from egvs.extensions.hardware.installation.acceptance import Acceptance, Check

_LIMITS = Limits()
_IN_USE_HINT = "Repeat egvs accept when it has ended."


def sheets(
    run: Run,
    site: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SITE",
            help="A site, or a pole (its site in the plan, else its best one); repeatable. By default the sensors of"
            " the plan in the folder, or the best site without one.",
        ),
    ] = None,
    kind: Annotated[str, typer.Option("--format", metavar="FORMAT", help="pdf or svg.")] = "pdf",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write; RUN/sheets by default.")
    ] = None,
) -> None:
    """Write an installation sheet for each sensor of the plan: position, bearing, tilt, view, map, tolerances."""
    from egvs.cli.console import ProgressDisplay, print_sentences

    with ProgressDisplay("sheets") as screen:
        from egvs.extensions.hardware.installation import sheet, tolerances

        notes: list[str] = []
        written = sheet.write_sheets(
            run, site or (), kind=kind, out=out, progress=screen.progress, on_note=notes.append
        )  # fmt: skip
    sentences = []
    for data, _ in written:
        angles = f"bearing {sheet.format_angle(data.grid_bearing_deg)} from grid north"
        height = f"{data.mounting_height_m:.2f} m above the ground"
        costs = tolerances.describe_tolerances(data.tolerances)
        sentences.append(f"{data.site.name}: {height}, {angles}; {costs} ({data.tolerances.frames:,} frames).")
    print_sentences([*sentences, *notes])
    for _, path in written:
        print(path)


def accept(
    run: Run,
    scan: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Required: a measured scan in the sensor's frame (x forward, y left, z up, metres): .pcd, .ply, .las,"
            " .laz, .csv (x_m, y_m, z_m), .e57, .bin or .npz. Several, minutes apart: --scan A --scan B --scan C.",
        ),
    ] = None,
    site: Annotated[str, typer.Option(metavar="SITE", help="Required: the site, or the pole, of the sensor.")] = "",
    position: Annotated[
        float, typer.Option(metavar="M", min=0, help="Largest error of the position.")
    ] = _LIMITS.position_m,
    tilt: Annotated[
        float, typer.Option(metavar="DEG", min=0, help="Largest turn that is left without the error of the yaw.")
    ] = _LIMITS.tilt_deg,
    yaw: Annotated[float, typer.Option(metavar="DEG", min=0, help="Largest error of the yaw.")] = _LIMITS.yaw_deg,
    blocked: Annotated[
        float, typer.Option(metavar="DEG", min=0, help="Largest width of all blocked sectors together.")
    ] = _LIMITS.blocked_deg,
    missing_channels: Annotated[
        int, typer.Option("--missing-channels", metavar="N", min=0, help="Largest number of channels without returns.")
    ] = int(_LIMITS.missing_channels),
    returns: Annotated[
        float, typer.Option(metavar="SHARE", min=0, max=1, help="Smallest share of the expected returns.")
    ] = _LIMITS.returns,
    off_beams: Annotated[
        float,
        typer.Option(
            "--off-beams", metavar="SHARE", min=0, max=1, help="Largest share of returns on no beam of the sensor."
        ),
    ] = _LIMITS.off_beams,
    loss: Annotated[
        float, typer.Option(metavar="SHARE", min=0, help="Largest loss of the score, as a share of the planned score.")
    ] = _LIMITS.loss,
    vehicle_height: Annotated[
        float,
        typer.Option(
            "--vehicle-height", metavar="M", min=0,
            help="A return in front of the static world that is higher above the ground is of an obstacle.",
        ),
    ] = MAX_VEHICLE_HEIGHT_M,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR",
            help="Folder to write; RUN/acceptance by default. The verdict is always added to the report of the run.",
        ),
    ] = None,
) -> None:  # fmt: skip
    """Compare a measured scan of an installed sensor with the planned one: pass (exit code 0) or fail (1)."""
    from egvs.cli.console import ProgressDisplay

    with ProgressDisplay("accept") as screen:
        from egvs.core import files
        from egvs.extensions.hardware.installation import acceptance, acceptance_page
        from egvs.runs.run import FolderInUseError

        if not scan:
            raise InputError("--scan", "no scan is given", "Use --scan measured.pcd.")
        if not site:
            raise InputError("--site", "no site is given", "Use the name of a site, such as --site c03.")
        for option, value in (
            ("--position", position), ("--tilt", tilt), ("--yaw", yaw), ("--blocked", blocked), ("--returns", returns),
            ("--off-beams", off_beams), ("--loss", loss), ("--vehicle-height", vehicle_height),
        ):  # fmt: skip
            if math.isnan(value):
                raise InputError(option, "expected a number, got nan", "Give a number, or inf to switch a limit off.")
        limits = Limits(position, tilt, yaw, blocked, missing_channels, returns, off_beams, loss)
        folder = out or run / "acceptance"
        files.check_writable(acceptance_page.AcceptanceFiles.of(folder, site).json)
        _check_not_in_use(run)
        result = acceptance.accept(
            run, site, scan, limits, max_vehicle_height_m=vehicle_height, progress=screen.progress
        )  # fmt: skip
        written: Sequence[Path] = ()
        with contextlib.suppress(FolderInUseError):  # by a command that began meanwhile
            written = acceptance_page.write_acceptance(run, result, folder)
    _print_acceptance(result)
    for path in written:
        print(path)
    if not written:
        problem = "another command is using this folder, so its report lacks this verdict"
        raise InputError(run, problem, _IN_USE_HINT)
    if not result.passed:
        raise typer.Exit(EgvsError.exit_code)


def _check_not_in_use(run: Path) -> None:
    """Raise an InputError if another command is at work in a run folder, to which the verdict is added."""
    from egvs.artefacts.run_folder import RunFolder
    from egvs.runs.run import FolderInUseError, lock_run_folder

    if not RunFolder(run).has_record:
        return
    try:
        with lock_run_folder(run):
            pass
    except FolderInUseError:
        raise InputError(run, "another command is using this folder", _IN_USE_HINT) from None


def _print_acceptance(result: Acceptance) -> None:
    """Print the verdict, the checks and the pose error."""
    from egvs.cli.console import Column, print_sentences, print_table
    from egvs.extensions.hardware.installation.acceptance import describe_error, describe_sector
    from egvs.extensions.hardware.registration import parameter_name_and_unit
    from egvs.results.labels import SCORE_LABELS

    verdict = "passed" if result.passed else f"failed: {'; '.join(result.reasons)}"
    print_sentences([f"{result.site.name} ({result.sensor.name}): {verdict}."])
    print()
    columns: list[Column[Check]] = [
        Column("check", lambda check: check.name, "left"),
        Column("measured", lambda check: check.measured, "left"),
        Column("limit", lambda check: check.limit, "left"),
        Column("", lambda check: ("pass" if check.passed else "FAIL") + (", close" if check.is_close else ""), "left"),
    ]
    print_table(columns, result.checks)
    print()
    errors = result.pose.standard_errors
    parts = []
    for parameter, value in result.pose.values.items():
        name, unit = parameter_name_and_unit(parameter)
        parts.append(f"{name} {describe_error(value, errors[parameter], unit)}")
    pose = ", ".join(parts)
    sentences = [
        f"Pose error, measured minus planned: {pose}.",
        f"{format_percent(result.on_surface_share, 0)} of {result.comparison.returns:,} returns lie on the "
        "static world; "
        f"{format_percent(result.comparison.nearer_share, 0)} are nearer than expected.",
    ]
    sentences += [f"Blocked: {describe_sector(sector)}." for sector in result.comparison.sectors]
    if result.score is not None:
        score, label = result.score, SCORE_LABELS[result.score.name]
        sentences.append(
            f"{label.noun[:1].upper()}{label.noun[1:]}: planned {label.value(score.planned)}, at the measured pose"
            f" {label.value(score.at_measured_pose)}, with obstacles and missing channels"
            f" {label.value(score.as_installed)} {label.unit}".rstrip()
            + "."
        )
    sentences += [f"Note: {note}." for note in result.notes]
    print_sentences(sentences)
