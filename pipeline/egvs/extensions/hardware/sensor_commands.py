"""``egvs sensor``: derive a sensor from its own sweeps, or design one for a pole."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from egvs.cli.options import Detector, Jobs, Set, SettingsPath
from egvs.core.errors import InputError
from egvs.core.wording import format_percent
from egvs.extensions.hardware.design_request import ALL_SENSORS, ELEVATION_BOUNDS_DEG, DesignRequest
from egvs.formats.recording_options import RecordingOptions

if TYPE_CHECKING:
    from egvs.extensions.hardware.design import Design, DesignResult
    from egvs.extensions.hardware.fit.fit import SensorFit
    from egvs.extensions.hardware.fit.map_pose import MapPose
    from egvs.extensions.hardware.fit.output import FitFolder
    from egvs.scenario.model import Scenario
    from egvs.sensors.sites import Pose
    from egvs.statistics.intervals import Estimate

_DESIGN_WIDTH = 190
_REQUEST = DesignRequest("")
_RECORDING = RecordingOptions()
_LOW_DEG, _HIGH_DEG = ELEVATION_BOUNDS_DEG


class Mount(StrEnum):
    """How the sensor that recorded the sweeps is mounted."""

    UPRIGHT = "upright"
    INVERTED = "inverted"


app = typer.Typer(no_args_is_help=True, help="Derive a sensor from its sweeps, or design one.")


@app.callback()
def sensor() -> None:
    """Derive a sensor from its sweeps, or design one."""


@app.command()
def fit(
    sweeps: Annotated[
        list[Path],
        typer.Argument(
            metavar="SWEEPS...",
            help="Sweeps of an installed LiDAR in its own frame: one per file (.pcd, .ply, .las, .laz, .csv, .e57; also"
            " with .gz), an array per sweep (.npz), or a recording (.bag, .mcap, .db3, .pcap).",
        ),
    ],
    name: Annotated[
        str, typer.Option(metavar="NAME", help="Required: name of the sensor, as in \\[sensors.NAME].")
    ] = "",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write; sensors/NAME by default.")
    ] = None,
    ground: Annotated[
        int,
        typer.Option(metavar="N", min=1, help="Which of the ground planes that are listed the sensor stands over."),
    ] = 1,
    road: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST,LAST",
            help="Azimuths in degrees, counter-clockwise from the sensor's x axis, between which the road is in sight;"
            " by default found from the ground plane.",
        ),
    ] = None,
    topic: Annotated[
        str | None,
        typer.Option(metavar="TOPIC", help="Topic of the point clouds, where a recording of ROS has several."),
    ] = None,
    max_sweeps: Annotated[
        int, typer.Option(metavar="N", min=1, help="Most sweeps that are read of a recording, spread evenly over it.")
    ] = _RECORDING.max_sweeps,
    max_range: Annotated[
        float,
        typer.Option(metavar="M", min=1.0, max=10_000.0, help="Range beyond which the decoder of .pcap drops returns."),
    ] = _RECORDING.range_m,
    scenario: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENARIO", help="Fit yaw and position as well, to the static world of this scenario; with --site."
        ),
    ] = None,
    site: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y[,Z]", help="With --scenario: where the sensor is in its world, to 2 m; Z if it has no ground."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="State the pose by a calibration of this unit (JSON with a 4 x 4 matrix from its frame into a map),"
            " and where the ground plane is in that map.",
        ),
    ] = None,
    mount: Annotated[
        Mount, typer.Option(help="Whether the sensor stands or hangs upside down, with z of its frame downwards.")
    ] = Mount.UPRIGHT,
    without_empty_sector: Annotated[
        bool,
        typer.Option(
            "--without-empty-sector",
            help="Leave the widest sector without returns (mast, wall) out of the simulated beams.",
        ),
    ] = False,
) -> None:
    """Fit elevations, azimuths, range noise, return rates and the pose of a LiDAR to sweeps that it recorded."""
    from egvs.cli.console import ProgressDisplay
    from egvs.core import files, plugins

    plugins.require_libraries("egvs sensor fit", "figure", "matplotlib")
    with ProgressDisplay("sensor fit") as screen:
        from egvs.extensions.hardware.fit import fit as fitting
        from egvs.extensions.hardware.fit import output
        from egvs.extensions.hardware.fit.calibration import read_calibrated_pose
        from egvs.formats import sweep_files

        if not name:
            raise InputError("--name", "no name is given", "Use --name north-mast.")
        output.check_name(name)
        map_options = _map_options(scenario, site)
        options = fitting.FitOptions(ground, None if road is None else _sector(road), mount is Mount.INVERTED)
        folder = out or Path("sensors") / name
        files.check_writable(folder / output.SENSOR_FILE)
        steps = iter(range(1, 100))
        screen.progress("reading", 0, 7)
        recorded = sweep_files.read_sweeps(sweeps, RecordingOptions(topic, max_sweeps, max_range))
        result = fitting.fit_sensor(recorded, options, lambda step: screen.progress(step, next(steps), 7))
        if map_options is not None:
            screen.progress("map", 6, 7)
            result = fitting.with_map_pose(result, *map_options)
        if calibration is not None:
            result = replace(result, calibrated_pose=read_calibrated_pose(calibration, result.plane))
        screen.progress("writing", 6, 7)
        written = output.write_fit(result, name, folder, without_empty_sector=without_empty_sector)
    print_fit(result, written)


def _map_options(path: Path | None, site: str | None) -> tuple[Scenario, tuple[float, ...]] | None:
    """Return the scenario and the position of the sensor; None if neither is given."""
    from egvs.scenario.fields import MAX_COORDINATE_M
    from egvs.scenario.loading import load

    if path is None and site is None:
        return None
    if path is None or site is None:
        given, other = ("--site", "--scenario") if path is None else ("--scenario", "--site")
        raise InputError(given, f"expected {other} as well", "Use both: --scenario FOLDER --site X,Y.")
    try:
        site_m = tuple(float(word) for word in site.split(","))
    except ValueError:
        site_m = ()
    if len(site_m) not in (2, 3) or not all(abs(value) <= MAX_COORDINATE_M for value in site_m):
        problem = f"expected two or three coordinates in metres, got {site!r}"
        raise InputError("--site", problem, "Use the world frame of the scenario, as in --site=12.5,-3.")
    return load(path), site_m


def _sector(text: str) -> tuple[float, float]:
    words = text.split(",")
    try:
        first_deg, last_deg = (float(word) for word in words)
    except ValueError:
        first_deg = last_deg = float("nan")
    if not (-360 <= first_deg < last_deg <= 360 and last_deg - first_deg <= 360):
        problem = f"expected two azimuths from -360 to 360, ascending, got {text!r}"
        raise InputError("--road", problem, "Use two numbers such as --road=-25,25.")
    return first_deg, last_deg


def print_fit(result: SensorFit, written: FitFolder) -> None:
    """Print the fitted values, the ground planes, and the files."""
    from egvs.cli.console import WIDE, Column, console, make_table
    from egvs.extensions.hardware.fit.output import calibration_lines
    from egvs.sensors.sites import Pose

    out = console(WIDE)
    angles = result.angles
    missing = sum(len(sweep.points_m) - sweep.returns for sweep in result.sweeps)
    returns = sum(sweep.returns for sweep in result.sweeps)
    stray = sum(grid.off_grid for grid in result.grids)
    repeated = sum(grid.repeated for grid in result.grids)
    coarse = sum(sweep.is_coarse for sweep in result.sweeps)
    lines = [
        f"sweeps: {len(result.sweeps)}; {returns:,} returns, {missing:,} missing returns; not used: {stray:,} on no "
        f"ring, {repeated:,} further returns of a pulse",
        f"order of points in the first sweep: {result.layout}; rings from the {_ring_source(result)}",
        f"elevations: {angles.channels} channels from {angles.elevation_deg.min():.3f} to "
        f"{angles.elevation_deg.max():.3f} degrees, largest standard error {angles.elevation_se_deg.max():.0e}",
        f"vertical offsets: {1000 * angles.offset_m.min():.1f} to {1000 * angles.offset_m.max():.1f} mm, as of optics "
        f"{1000 * angles.axis_distance_m:.1f} mm from the axis",
        f"azimuths: {angles.azimuths} every {angles.azimuth_step_deg:.4f} degrees, {_direction(result)}",
        f"ranges: up to {result.max_range_m:.1f} m, {_range_step(result)}",
        f"range noise: {_millimetres(result.sigma_m)}",
        f"returns from smooth surfaces: {_percent(result.return_rate)}",
    ]
    if result.silent_channels:
        lines.append(f"channels with fewer than 20 returns, left out: {result.silent_channels}")
    recordings = {id(sweep.recording): sweep.recording for sweep in result.sweeps if sweep.recording is not None}
    for recording in recordings.values():
        used = sum(sweep.recording is recording for sweep in result.sweeps)
        notes = "".join(f"; {note}" for note in recording.notes)
        lines.insert(0, f"{recording.name}: {used} of {recording.sweeps} sweeps read; {recording.source}{notes}")
    lines.append(f"rotation: {_rotation(result)}")
    if coarse:
        lines.insert(1, f"sweeps with float16 coordinates, used only for the empty scan: {coarse}")
    if result.empty_sectors_deg:
        sectors = ", ".join(f"{first:.0f} to {last:.0f}" for first, last in result.empty_sectors_deg)
        lines.append(f"sectors without returns: azimuth {sectors} degrees (a mast, a wall, or open sky)")
    if result.empty_scan is not None:
        background, traffic, unknown = result.empty_scan.counts
        known = int((result.empty_scan.range_m > 0).sum())
        lines.append(
            f"empty scan: {known:,} of {result.empty_scan.range_m.size:,} pulses; {traffic:,} returns in front of it "
            f"(traffic), {background:,} on it, {unknown:,} without a known background"
        )
    for line in lines:
        out.print(line)
    planes = result.planes
    columns: list[Column[int]] = [
        Column("ground plane", lambda i: f"{i + 1}{' (chosen)' if planes[i] is result.plane else ''}", "left"),
        Column("below the sensor", lambda i: f"{planes[i].height_m:.2f} +- {planes[i].height_se_m:.2f} m"),
        Column("roll", lambda i: f"{Pose(0.0, 0.0, 0.0, roll_deg=planes[i].roll_deg).side_tilt_deg:z.2f} deg"),
        Column("pitch", lambda i: f"{planes[i].pitch_deg:.2f} deg"),
        Column("returns", lambda i: f"{planes[i].returns:,}"),
        Column("roughness", lambda i: f"{planes[i].roughness_m:.2f} m"),
        Column("x", lambda i: f"{planes[i].x_m[0]:.0f} to {planes[i].x_m[1]:.0f} m"),
        Column("y", lambda i: f"{planes[i].y_m[0]:.0f} to {planes[i].y_m[1]:.0f} m"),
    ]
    out.print(make_table(columns, range(len(planes))))
    if result.plane.is_inverted:
        out.print('The sensor is upside down (mount = "inverted" in sensor.toml); its roll counts from there.')
    out.print(f"Check in {written.folder / 'ground.png'} that the chosen plane is the road; if not, use --ground N.")
    if result.calibrated_pose is not None:
        for line in calibration_lines(result.calibrated_pose):
            out.print(line)
    if result.map_pose is not None:
        for line in _map_lines(result.map_pose):
            out.print(line)
        out.print(f"Check in {written.folder / 'map.png'} that the returns lie on the walls.")
    for file in written.names:
        print(written.folder / file)


def _ring_source(result: SensorFit) -> str:
    if result.has_file_rings:
        return "file"
    return f"points. {result.ring_note}" if result.ring_note else "points"


def _direction(result: SensorFit) -> str:
    return {1: "counter-clockwise from above", -1: "clockwise from above", 0: "direction of rotation unknown"}[
        result.angles.direction
    ]


def _map_lines(pose: MapPose) -> list[str]:
    from egvs.extensions.hardware.registration import PARAMETERS

    best = pose.best
    errors = best.standard_errors
    values = {name: f"{getattr(best.pose, name):.3f} +- {errors[name]:.2g}" for name in PARAMETERS}
    lines = [
        f"pose in the world of {pose.scenario}: yaw {values['yaw_deg']}, pitch {values['pitch_deg']}, "
        f"roll {values['roll_deg']} degrees; x {values['x_m']}, y {values['y_m']}, z {values['z_m']} m",
        f"fit to the map: {format_percent(pose.share_on_surface, 0)} of {len(pose.points_m):,} returns on "
        "the static world, mean "
        f"distance {1000 * pose.residual_m:.1f} +- {1000 * pose.residual_se_m:.1f} mm, standard deviation "
        f"{1000 * best.sigma_m:.1f} mm; {pose.shift_m:.2f} m from --site",
    ]
    return lines + list(pose.warnings)


def _rotation(result: SensorFit) -> str:
    rotation = result.rotation
    if rotation is None:
        return "rate unknown (the sweeps have no times)"
    text = (
        f"{abs(rotation.rate_hz):.4f} +- {rotation.rate_se_hz:.1g} turns per second, from {rotation.source} of "
        f"{rotation.sweeps} sweeps"
    )
    if rotation.step_deg is None or rotation.firing_interval_s is None:
        return text
    return (
        f"{text}; a firing every {1e6 * rotation.firing_interval_s:.3f} us makes an azimuth step of "
        f"{rotation.step_deg:.4f} degrees"
    )


def _range_step(result: SensorFit) -> str:
    return "no step" if result.range_step_m is None else f"in steps of {1000 * result.range_step_m:.3g} mm"


def _millimetres(estimate: Estimate | None) -> str:
    if estimate is None:
        return "unknown (too few neighbouring returns)"
    low, high = 1000 * estimate.low, 1000 * estimate.high
    return f"{1000 * estimate.value:.1f} mm (95 % interval {low:.1f} to {high:.1f})"


def _percent(estimate: Estimate | None) -> str:
    if estimate is None:
        return "unknown (too few neighbouring returns)"
    return (
        f"{format_percent(estimate.value, 2)} of pulses (95 % interval {format_percent(estimate.low, 2)} "
        f"to {format_percent(estimate.high, 2)})"
    )


@app.command()
def design(
    scenario: SettingsPath,
    pole: Annotated[str, typer.Option(metavar="NAME", help="Required: the pole, or a site on it.")] = "",
    sensors: Annotated[
        str,
        typer.Option(
            metavar="A,B,...|all", help="Sensors to choose from; by default all that egvs sensors lists (minutes)."
        ),
    ] = ALL_SENSORS,
    heights: Annotated[
        str | None,
        typer.Option(metavar="LOW,HIGH", help="Heights above the ground; by default those of the sites on the pole."),
    ] = None,
    channels: Annotated[
        int | None, typer.Option(metavar="N", help="Design a sensor with N channels whose elevations are free.")
    ] = None,
    elevations: Annotated[
        str,
        typer.Option(
            metavar="free|LOW,HIGH",
            help=f"Bounds of the elevations of free channels; free: from {_LOW_DEG:g} to {_HIGH_DEG:g} degrees. A"
            " negative number needs an equals sign: --elevations=-30,10.",
        ),
    ] = "free",
    name: Annotated[str, typer.Option(metavar="NAME", help="Name of the designed sensor.")] = _REQUEST.name,
    evaluations: Annotated[
        int, typer.Option(metavar="N", help="Mounts that are tried for each sensor.")
    ] = _REQUEST.evaluations,
    elevation_evaluations: Annotated[
        int, typer.Option(metavar="N", help="Sets of elevations that are tried for free channels.")
    ] = _REQUEST.elevation_evaluations,
    detector: Detector = None,
    set_: Set = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="File for the designed sensor; sensors/NAME.toml by default."),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Choose sensor, height, yaw and pitch for a pole; with --channels, also the elevations of the channels."""
    from egvs.cli import options, sources
    from egvs.cli.console import ProgressDisplay
    from egvs.core import files

    if not pole:
        raise InputError("--pole", "no pole is given", "Use the name of a pole, or of a site on it.")
    heights_m = None if heights is None else options.heights_m(heights)
    loaded, folder = sources.open_source(scenario, options.with_detector(set_, detector, scenario), None)
    with ProgressDisplay("sensor design") as screen:
        from egvs.cli import answer
        from egvs.extensions.hardware import design as sensor_design
        from egvs.extensions.hardware.fit import output
        from egvs.sensors.sensor_table import format_sensor_table

        screen.flow_source = answer.flow_source(loaded)

        output.check_name(name)
        if channels is None:
            for option, is_given in (
                ("--name", name != _REQUEST.name),
                ("--out", out is not None),
                ("--elevation-evaluations", elevation_evaluations != _REQUEST.elevation_evaluations),
            ):
                if is_given:
                    raise InputError(option, "has no effect without --channels", "Add --channels 32.")
        bounds_deg = ELEVATION_BOUNDS_DEG
        if elevations != "free":
            if channels is None:
                raise InputError("--elevations", "needs --channels, the number of channels", "Use --channels 32.")
            bounds_deg = _bounds(elevations)
        file = out or Path("sensors") / f"{name}.toml"
        if channels is not None:
            files.check_writable(file)
        names = tuple(word.strip() for word in sensors.split(",") if word.strip())
        request = DesignRequest(pole, names, heights_m, evaluations, channels, bounds_deg, elevation_evaluations, name)
        result = sensor_design.design_sensor(
            loaded, request, folder, jobs=jobs, progress=screen.progress, listener=screen.stage_event
        )
        if result.designed is not None:
            files.ensure_writable_folder(file)
            table = format_sensor_table(name, sensor_design.sensor_table(result.designed.sensor))
            comment = f"# {result.designed.sensor.source}, for pole {result.pole} of {loaded.name}.\n"
            files.write_text(file, comment + table)
    print_design(result, file if result.designed is not None else None)


def _bounds(text: str) -> tuple[float, float]:
    try:
        low_deg, high_deg = (float(word) for word in text.split(","))
    except ValueError:
        problem = f"expected free, or two elevations in degrees, got {text!r}"
        raise InputError("--elevations", problem, "Use, for example, --elevations=-30,10.") from None
    return low_deg, high_deg


def print_design(result: DesignResult, file: Path | None) -> None:
    """Print the best mounts of all sensors, the designed sensor, and how to use the chosen one."""
    from egvs.cli.console import Column, console, make_table, print_sentences
    from egvs.results.labels import SCORE_LABELS
    from egvs.scenario.score_config import DEFAULT_SCORE

    label = SCORE_LABELS[DEFAULT_SCORE]
    designs = [*result.catalogue]
    if result.start is not None and result.designed is not None:
        designs += [result.start, result.designed]
    columns: list[Column[Design]] = [
        Column("sensor", _sensor_words, align="left"),
        Column("height m", lambda design: f"{design.pose.z_m - result.ground_m:.2f}"),
        Column("yaw deg", lambda design: f"{design.pose.yaw_deg:.1f}"),
        Column("pitch deg", lambda design: f"{design.pose.pitch_deg:.1f}"),
        Column("found, frames of the search", lambda design: format_percent(design.search_score)),
        Column("found, other frames", lambda design: f"{100 * design.score:.1f} ± {100 * design.se:.1f} %"),
        Column(f"minus {designs[0].sensor.name}, % points", _format_gain),
    ]
    out = console(_DESIGN_WIDTH, soft_wrap=False)
    out.print(make_table(columns, designs, width=out.width, title=f"pole {result.pole}: {label.label}"))
    out.print()
    chosen = result.chosen
    searched, others = result.frames
    lines = [
        f"The search saw {searched:,} frames; scores with ± come from {others:,} other frames, so the search"
        " does not bias them.",
        f"Best by the search: {chosen.sensor.name}. Row of sites.csv (site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg,"
        f"mount,sensor): {result.pole},{chosen.pose.x_m:.3f},{chosen.pose.y_m:.3f},{chosen.pose.z_m:.3f},"
        f"{chosen.pose.yaw_deg:z.3f},{chosen.pose.pitch_deg:z.3f},{chosen.pose.side_tilt_deg:z.3f},"
        f"{mount_key(chosen.pose)},{chosen.sensor.name}",
        "Mount and roll are not searched: " + "; ".join(_fixed_mounts(designs)) + ".",
    ]
    if result.designed is not None:
        elevations = ", ".join(f"{value:g}" for value in result.designed.sensor.elevations_deg)
        lines.append(f"Elevations of {result.designed.sensor.name}: {elevations} degrees.")
    print_sentences(lines)
    print_sentences(f"note: {note}" for note in result.notes)
    if file is not None:
        print(f"table for scenario.toml: {file}")


def _sensor_words(design: Design) -> str:
    from egvs.results.ranking import describe_roll

    return ", ".join(filter(None, (design.sensor.name, describe_roll(design.pose.roll_deg))))


def mount_key(pose: Pose) -> str:
    """Return how a sites file states whether a sensor is upside down."""
    return (Mount.INVERTED if pose.is_inverted else Mount.UPRIGHT).value


def _fixed_mounts(designs: Sequence[Design]) -> Iterator[str]:
    """Yield how the sensors hang, and with which roll."""
    names: dict[tuple[str, float], list[str]] = {}
    for design in designs:
        names.setdefault((mount_key(design.pose), design.pose.side_tilt_deg), []).append(design.sensor.name)
    for (mount, roll_deg), sensors in names.items():
        which = f" ({', '.join(sensors)})" if len(names) > 1 else ""
        yield f"the sensors are {mount}, the roll is kept at {roll_deg:g}°{which}"


def _format_gain(design: Design) -> str:
    difference = design.difference
    text = f"{100 * difference.value:+.1f}"
    if difference.se is not None:
        text += f" ± {100 * difference.se:.1f}"
    return text if difference.is_clear or not difference.value else f"~ {text}"
