"""Makes a city's traffic: one simulation, cut to every junction while it is read.

Steps of :func:`make`: have junctions name the city's files; find the region of each; hash all that the files depend on;
where the seal beside them says the same and no file was altered, nothing is to be done; else record the traffic once,
or once a period, as any scenario's (:mod:`pipeline.traffic.recording`), and write all junctions' files
(:mod:`pipeline.city.cutting`). Files appear whole, the seal last: what was killed is made again. The same city gives
the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.city import cutting, linking, regions
from pipeline.city.model import FILE, JUNCTIONS, TABLE, TRAFFIC, City
from pipeline.city.regions import Region
from pipeline.core import code_digest, files
from pipeline.core.errors import InputError
from pipeline.core.findings import WARNINGS, Finding
from pipeline.core.progress import Progress, silent
from pipeline.core.reading import documents
from pipeline.effects import on_traffic, registry
from pipeline.runs import stage_keys
from pipeline.runs.locking import alone
from pipeline.scenario.loading import from_values
from pipeline.scenario.models import FILE as SCENARIO_FILE
from pipeline.scenario.models import Scenario
from pipeline.stages import traffic as stage
from pipeline.stages.base import Summary, Workspace
from pipeline.traffic import recording, sumo_folder, trajectories
from pipeline.world import world_frame

SEAL, SUMO = "traffic.json", "sumo"
"""In the folder of the traffic: what its files were made of, and the folder that opens in sumo-gui."""

_HEIGHT_M = 5.0


@dataclass(frozen=True)
class CityTraffic:
    """A city's traffic.

    Attributes
    ----------
    anew
        Whether it was made now.
    summary
        What came out of the whole, as ``run.json`` has it of a scenario's traffic.
    rows
        Rows of each junction, of all periods.
    linked
        Junctions whose scenarios were changed, to name the city's periods.
    """

    anew: bool
    summary: Mapping[str, Any]
    rows: Mapping[str, int]
    linked: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Frames of every junction, of all periods."""
        return int(self.summary["frames"])


def make(city: City, progress: Progress = silent, sets: Sequence[str] = ()) -> CityTraffic:
    """Make the traffic of a city's junctions, unless it is there.

    Parameters
    ----------
    sets
        Laid over every junction's scenario, as ``--set`` does: they may ask for more of the traffic.

    Raises
    ------
    InputError
        When the city, a junction's scenario, or a file that they name is wrong.
    RunError
        When SUMO fails, N vehicles are not held, a vehicle stands without end, or another process is at work there.
    """
    folder = city.folder / TRAFFIC
    with alone(folder):
        linked = linking.link(city)
        its_regions = regions.of(city, sets)
        scenario = scenario_of(city, its_regions)
        key = _key(scenario, folder, its_regions)
        if (known := _sealed(city, key)) is not None:
            return replace(known, linked=linked)
        summaries, rows = dict[str, Summary](), Counter[str]()
        for period, of_period in scenario.by_period().items():
            paths = {junction.id: junction.traffic_file(city, period) for junction in city.junctions}
            summaries[period], its_rows = _record(of_period, folder / SUMO / period, its_regions, paths, progress)
            rows.update(its_rows)
        summary = summaries[""] if "" in summaries else stage.together(summaries)
        summary[WARNINGS] = [*summary.get(WARNINGS, []), *_without_traffic(scenario, rows)]
        digests = {_label(city, path): files.sha256_of(path) for path in _paths(city)}
        seal = {"key": key, "files": digests, "rows": dict(rows), "summary": summary}
        files.write_text(folder / SEAL, files.json_text(seal, indent=1) + "\n")
    return CityTraffic(True, summary, dict(rows), linked)


def _paths(city: City) -> Iterator[Path]:
    """The files of all junctions and periods."""
    for period in [period.name for period in city.traffic.periods] or [""]:
        yield from (junction.traffic_file(city, period) for junction in city.junctions)


def _label(city: City, path: Path) -> str:
    return path.relative_to(city.folder / TRAFFIC).as_posix()


def scenario_of(city: City, its_regions: Mapping[str, Region]) -> Scenario:
    """The city's traffic as a scenario, whose region of interest holds all junctions' regions."""
    for name in city.effects.named:
        if not getattr(registry.effect_class(name), "ADDS_TRAFFIC", False):
            right = f"in {JUNCTIONS}/{SCENARIO_FILE}, for every junction, or in those of some"
            raise InputError(f"{city.file}: effects.{name}", "adds no traffic", right)
    low = [min(getattr(region, key) for region in its_regions.values()) for key in ("low_x_m", "low_y_m")]
    high = [max(getattr(region, key) for region in its_regions.values()) for key in ("high_x_m", "high_y_m")]
    middle, size = (
        [(a + b) / 2 for a, b in zip(low, high, strict=True)],
        [b - a for a, b in zip(low, high, strict=True)],
    )
    values = {
        "name": "city",  # a folder that is renamed has the same traffic
        "seed": city.seed,
        "roi": {"center_m": [*middle, _HEIGHT_M / 2], "size_m": [*size, _HEIGHT_M], "voxel_m": _HEIGHT_M},
        "tpog": {"blocks": 1},  # of any number of frames
        "traffic": city.traffic.model_dump(mode="json", exclude_unset=True),
        "effects": city.effects.model_dump(mode="json"),
        "sites": {"file": TABLE},
    }
    scenario = from_values(values, city.folder, str(city.file))
    scenario._file_name = FILE
    return scenario


def _key(scenario: Scenario, folder: Path, its_regions: Mapping[str, Region]) -> str:
    """A hash of all that the files depend on: the traffic, the regions, the effects that follow ways, the program."""
    read = stage.inputs(Workspace(scenario, folder))
    own = {name: registry.settings(registry.named(its.scenario, stage.NAME)) for name, its in its_regions.items()}
    about = {
        "inputs": read.to_json(),
        "regions": {name: region.to_json() for name, region in its_regions.items()},
        "effects": own,
        "program": stage_keys.program(stage.NAME, scenario, read.modules),
        "cutting": code_digest.of(cutting.__name__).digest,
    }
    return files.hash_of(about)


def _sealed(city: City, key: str) -> CityTraffic | None:
    """The traffic that is there, where it is this one and whole."""
    path = city.folder / TRAFFIC / SEAL
    if not path.is_file():
        return None
    match documents.read_json(path):
        case {"key": str(its), "files": dict(digests), "rows": dict(rows), "summary": dict(summary)} if its == key:
            pass
        case _:
            return None
    for its_file in _paths(city):
        if not its_file.is_file() or files.sha256_of(its_file) != digests.get(_label(city, its_file)):
            return None
    return CityTraffic(False, summary, rows)


def _record(
    scenario: Scenario, folder: Path, its_regions: Mapping[str, Region], paths: Mapping[str, Path], progress: Progress
) -> tuple[Summary, dict[str, int]]:
    """Record the traffic of one period and write every junction's file; what came out, and the rows of each."""
    effects, notes = on_traffic.live(scenario)
    world = world_frame.of(scenario)
    with recording.record(scenario, folder, effects, progress, None, world) as recorded:
        tally, rows = cutting.write(scenario, recorded, its_regions, paths, effects, progress)
        done = recorded.summary()
        doubts = trajectories.doubts(tally, recorded, scenario.roi.box)
    summary = tally.to_json(recorded.window.period_ms / 1000.0) | ({} if done is None else asdict(done))
    doubts = [doubt for doubt in doubts if doubt.rule != "overlaps"]  # a share of frames: each junction tells its own
    if any(not effect.ADDS_TRAFFIC for effect in effects):
        doubts += _on_a_slope(scenario, its_regions)
    told = [*summary.get(WARNINGS, []), *(finding.to_json() for finding in doubts)]
    summary[WARNINGS] = [{key: _of_city(value) for key, value in warning.items()} for warning in told]
    if notes:
        summary["notes"] = [*summary.get("notes", []), *notes]
    return summary, rows


def _on_a_slope(scenario: Scenario, its_regions: Mapping[str, Region]) -> Iterator[Finding]:
    """A warning of junctions that do not know the relief of the network."""
    flat = [name for name, region in its_regions.items() if region.scenario.traffic.roads is None]
    if flat:
        found = f"the network goes up and down, but {', '.join(flat)} name no roads: the ground is level there"
        cure = "traffic.roads in their scenarios"
        yield Finding("relief", sumo_folder.place_of(scenario), found, cure)


def _without_traffic(scenario: Scenario, rows: Mapping[str, int]) -> list[dict[str, Any]]:
    """A warning of junctions to which nobody comes."""
    if not (empty := [name for name, count in rows.items() if not count]):
        return []
    found, cure = f"no vehicle comes near {', '.join(empty)}", f"more traffic, or no row for them in {TABLE}"
    return [Finding("junctions without traffic", sumo_folder.place_of(scenario), found, cure).to_json()]


def _of_city(value: Any) -> Any:
    """A warning's words: what stands for the region of interest is the rectangle round all junctions."""
    return value.replace("the region of interest", "the city's junctions") if isinstance(value, str) else value
