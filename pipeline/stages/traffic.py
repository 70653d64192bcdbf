"""Where is each vehicle in each frame?

Steps: get rows of floating car data (FCD) - from SUMO as a subprocess, from a SUMO that is already running, or from a
finished file; cut them into groups of whole frames; turn front bumpers into boxes; write a group as a row group of
``trajectories.parquet``; check what the scenario promises: N vehicles in each frame, and nobody standing for good.
Effects that the scenario names, and a network with relief, bring people on foot and on bicycles, rear parts, and boxes
that stand on slopes.

World frame (x east, y north, z up), metres, radians, seconds. The folder ``sumo`` beside the artefact opens in
sumo-gui.

SUMO (https://eclipse.dev/sumo) stands in for the paper's game-engine simulator.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pyarrow as pa

from pipeline.artefacts import tables
from pipeline.core import files
from pipeline.core.errors import InputError, RunError
from pipeline.core.progress import Progress, silent
from pipeline.core.sumo_home import sumo_home
from pipeline.scenario.models import Scenario
from pipeline.scenario.traffic import TrafficModel
from pipeline.stages.base import metadata
from pipeline.traffic import boxes as motion
from pipeline.traffic import fcd, network, simulation, sumo
from pipeline.traffic.boxes import Boxes, Size, Tally

if TYPE_CHECKING:
    from pipeline.effects.registry import Effect
    from pipeline.effects.traffic.articulated import Articulated, Follower
    from pipeline.effects.traffic.pedestrians_bicycles import PedestriansBicycles
    from pipeline.effects.traffic.slope import Surface

NAME = "traffic"
ARTEFACTS = ("trajectories.parquet",)
COMPANIONS = ("sumo",)

GROUP_FRAMES = 500
"""Frames in a row group; fixed, so that the bytes do not depend on how the rows arrive."""

_LEAST_PATIENCE_S = 180.0


@dataclass
class Recording:
    """Rows of FCD as they arrive, and what is known about them. Of a running SUMO, ``on_purpose`` is filled as they
    come."""

    rows: Iterable[pa.Table]
    window: fcd.Window
    sizes: Mapping[str, Size]
    place: str
    result: dict[str, Any] = field(default_factory=dict)
    patience_s: float | None = None
    on_purpose: set[str] = field(default_factory=set)
    persons: Iterable[pa.Table] | None = None


@dataclass
class Acting:
    """What goes beyond plain vehicles on flat ground; each None where it does not act."""

    crowd: PedestriansBicycles | None = None
    articulated: Articulated | None = None
    surface: Surface | None = None
    notes: list[str] = field(default_factory=list)
    follower: Follower | None = None

    @property
    def named(self) -> tuple[Effect, ...]:
        """Those whose parameters count."""
        return tuple(effect for effect in (self.articulated, self.crowd) if effect is not None)

    def apart(self, sizes: Mapping[str, Size]) -> frozenset[str]:
        """SUMO's types of those who do not count as vehicles: what the effect brings, and a user's own persons."""
        if self.crowd is None:
            return frozenset()
        from pipeline.effects.traffic.pedestrians_bicycles import TYPES

        return TYPES | {name for name, size in sizes.items() if size.vclass == "pedestrian"}

    def prepare(self, scenario: Scenario, sizes: Mapping[str, Size]) -> None:
        """Once sizes are known; further calls do nothing."""
        if self.articulated is not None and self.follower is None:
            from pipeline.effects.traffic import articulated

            own = {name: size for name, size in sizes.items() if name not in self.apart(sizes)}
            self.follower = articulated.Follower(self.articulated.geometries(own, articulated.place_of(scenario)))

    def result(self, recorded: dict[str, Any]) -> dict[str, Any]:
        """What the stage reports, with what the effects have to say; unchanged where they have nothing."""
        about = dict(recorded)
        if self.notes:
            about["notes"] = [*recorded.get("notes", []), *self.notes]
        return about if self.follower is None else about | {"articulated": self.follower.result()}

    def change(self, found: Boxes) -> Boxes:
        """Boxes with rear parts, and on the ground."""
        if self.follower is not None:
            found = self.follower.parts(found)
        return found if self.surface is None else self.surface.seat(found)


def acting(scenario: Scenario) -> Acting:
    """The named effects that change the trajectories; none is imported where none is named."""
    found = Acting()
    if not scenario.effects:
        return found
    from pipeline.effects import registry as effects

    for effect in effects.of(scenario, NAME):
        if effect.NAME == effects.SELF_ACTING:
            continue  # see _stand
        reason = cast("Articulated | PedestriansBicycles", effect).changes_nothing(scenario)
        if reason is not None:
            found.notes.append(f"{effect.NAME}: named, but {reason}: skipped, the result is the same")
        elif effect.NAME == "articulated":
            found.articulated = cast("Articulated", effect)
        else:
            found.crowd = cast("PedestriansBicycles", effect)
    return found


def _stand(scenario: Scenario, found: Acting) -> None:
    """Lay the ground where the network has relief; a flat one imports no effect for that."""
    path = network.path_of(scenario)
    hilly = path is not None and network.may_have_heights(path)
    if not hilly and "slope" not in scenario.effects:
        return
    from pipeline.effects.traffic import slope

    on, reason = slope.decide(scenario)
    if on and path is not None:
        found.surface = slope.ground(path)
        found.notes.append(f"slope: on, {reason}")
    else:
        named = "named, but " if "slope" in scenario.effects else "off, "
        found.notes.append(
            f"slope: {named}{reason}" + (": skipped, the result is the same" if named.startswith("named") else "")
        )


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """Everything that the trajectories depend on."""
    del out
    traffic = scenario.traffic
    if traffic.fcd is not None:
        sources = [scenario.find(traffic.fcd, "traffic.fcd")]
    else:
        sources = simulation.sources(scenario).all()
        if traffic.sumocfg is not None:
            sources.insert(0, scenario.find(traffic.sumocfg, "traffic.sumocfg"))
    return {
        "settings": {
            "seed": scenario.seed,
            "name": scenario.name,
            "traffic": traffic.model_dump(mode="json"),
            **_effect_settings(scenario),
        },
        "files": {_label(path, scenario): files.sha256_of(path) for path in sources},
        "sumo": None if traffic.fcd is not None else sumo.version(),
    }


def _effect_settings(scenario: Scenario) -> dict[str, Any]:
    """The effects that act. One that cannot change the result is left out, as if it were not named."""
    if not scenario.effects or not (named := acting(scenario).named):
        return {}
    from pipeline.effects import registry as effects

    return {"effects": effects.settings(named)}


def _label(path: Path, scenario: Scenario) -> str:
    """A file's name seen from the scenario's folder, so that it does not depend on where that is."""
    if path.is_relative_to(sumo_home()):
        return f"$SUMO_HOME/{path.relative_to(sumo_home()).as_posix()}"
    return Path(os.path.relpath(path, scenario.folder)).as_posix()


def run(
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    traci: tuple[str, int] | None = None,
) -> dict[str, Any]:
    """Make the trajectories.

    Parameters
    ----------
    traci
        Host and port of a SUMO that is already running; nothing is started then.

    Returns
    -------
    dict
        What came out, as JSON: frames, vehicles, speeds, standing, collisions, overlaps, SUMO's flags and seconds.

    Raises
    ------
    InputError
        When the scenario or a file that it names is wrong.
    RunError
        When SUMO fails, N vehicles are not held, or a vehicle stands without end.
    """
    del jobs  # SUMO runs on one thread, so that its bytes do not depend on how many there are
    about = inputs(scenario, out)
    frames = scenario.traffic.frames
    tally, effects = Tally(frames), acting(scenario)
    _stand(scenario, effects)
    source = _recording(scenario, out, progress, traci, effects.crowd)
    with source as recording, tables.writer(out / ARTEFACTS[0], "trajectories") as file:
        period_s = recording.window.period_ms / 1000.0
        for group in _groups(recording):
            effects.prepare(scenario, recording.sizes)
            boxes = effects.change(
                motion.boxes(group, recording.sizes, period_s, recording.place, effects.apart(recording.sizes))
            )
            if boxes.frame.size:
                file.write(boxes.columns())
            tally.add(boxes)
            progress("frames written", group.first_frame + group.frames, frames)
        _check(scenario.traffic, tally, recording)
        file.describe(metadata(scenario, about, frames=frames, frame_period_s=period_s, sumo=about["sumo"]))
    return tally.result(period_s) | effects.result(recording.result)


def _groups(recording: Recording) -> Iterator[fcd.Group]:
    """Groups of whole frames, persons among the vehicles where they are recorded beside."""
    groups = fcd.groups(recording.rows, recording.window, GROUP_FRAMES, recording.place)
    if recording.persons is None:
        return groups
    persons = fcd.groups(recording.persons, recording.window, GROUP_FRAMES, recording.place)
    return (fcd.together(some, others) for some, others in zip(groups, persons, strict=True))


def _recording(
    scenario: Scenario, out: Path, progress: Progress, traci: tuple[str, int] | None, crowd: PedestriansBicycles | None
) -> AbstractContextManager[Recording]:
    if scenario.traffic.fcd is not None and traci is not None:
        raise InputError("--traci", "the scenario names a finished FCD file", "network or sumocfg in [traffic]")
    if crowd is not None and (refusal := crowd.refusal(scenario)) is not None:
        raise refusal
    if scenario.traffic.fcd is not None:
        return _finished(scenario)
    if traci is not None:
        return _running(scenario, *traci, crowd)
    return _simulated(scenario, out / "sumo", progress, crowd)


@contextmanager
def _finished(scenario: Scenario) -> Iterator[Recording]:
    """From a file; nothing is simulated, so nothing is promised about it."""
    traffic, place = scenario.traffic, simulation.place(scenario)
    assert traffic.fcd is not None
    path = scenario.find(traffic.fcd, "traffic.fcd")
    window = fcd.Window(
        traffic.frames,
        max(1, simulation.milliseconds(traffic.frame_period_s, f"{place}.frame_period_s")),
        skip_ms=simulation.milliseconds(traffic.warmup_s, f"{place}.warmup_s"),
    )
    yield Recording(fcd.read(path), window, _kind_sizes(scenario), place)


@contextmanager
def _simulated(
    scenario: Scenario, folder: Path, progress: Progress, crowd: PedestriansBicycles | None
) -> Iterator[Recording]:
    """From SUMO as a subprocess; its FCD file is removed once it is read."""
    prepared = simulation.prepare(scenario, folder, crowd)
    sizes = _kind_sizes(scenario) if prepared.drawn else simulation.type_sizes(prepared)
    if crowd is not None:
        sizes |= crowd.sizes()
    path, persons = folder / simulation.FCD, folder / simulation.PERSONS
    try:
        seconds = simulation.simulate(prepared, progress)
        yield Recording(
            fcd.read(path) if _has_rows(path) else (),
            prepared.timing.window(),
            sizes,
            simulation.place(scenario),
            {
                "sumo": sumo.version(),
                "sumo_seconds": round(seconds, 3),
                "flags": simulation.flags(prepared),
                "collisions": simulation.collisions(prepared),
                "notes": list(prepared.notes),
            },
            patience_s(prepared.cycle_s),
            simulation.stopped_on_purpose(prepared),
            None if crowd is None else (fcd.read(persons, "person") if _has_rows(persons) else ()),
        )
    finally:
        path.unlink(missing_ok=True)
        persons.unlink(missing_ok=True)


def _has_rows(path: Path) -> bool:
    """Where nobody moved, SUMO writes no header, only a line's end."""
    return path.stat().st_size > 1


@contextmanager
def _running(scenario: Scenario, host: str, port: int, crowd: PedestriansBicycles | None) -> Iterator[Recording]:
    """From a SUMO that somebody else started."""
    given = simulation.sources(scenario)
    when = simulation.timing(scenario.traffic, given.begin_s, simulation.place(scenario))
    roads = given.files["net-file"][0]
    cycle_s = 0.0 if network.is_osm(roads) else network.read(roads).cycle_s
    seen = simulation.Seen(persons=crowd is not None)
    with sumo.connected(host, port) as connection:
        recording = Recording(
            simulation.poll(connection, when, seen, f"{host}:{port}"),
            when.window(),
            seen.sizes,
            simulation.place(scenario),
            patience_s=patience_s(cycle_s),
            on_purpose=seen.on_purpose,
        )
        version = sumo.version_in(connection.getVersion()[1])
        yield recording
        recording.result |= {
            "sumo": version,
            "sumo_seconds": None,
            "flags": None,
            "collisions": len(seen.collided),
            "notes": [],
        }


def _kind_sizes(scenario: Scenario) -> dict[str, Size]:
    return {k.name: Size(k.length_m, k.width_m, k.height_m, k.vclass) for k in scenario.traffic.kinds}


def patience_s(cycle_s: float) -> float:
    """How long a vehicle may stand through to the last frame: two signal cycles, and not less than three minutes."""
    return max(_LEAST_PATIENCE_S, 2.0 * cycle_s)


def _check(traffic: TrafficModel, tally: Tally, recording: Recording) -> None:
    """Whether a simulated recording keeps the scenario's promises."""
    if not tally.rows:
        raise RunError(
            f"{recording.place}: no vehicle is in any of {tally.frames} frames; check the demand and warmup_s"
        )
    if traffic.fcd is None and traffic.hold == "exactly":
        _check_held(traffic, tally, recording.place)
    if recording.patience_s is not None:
        _check_moving(tally, recording, recording.patience_s)


def _check_held(traffic: TrafficModel, tally: Tally, place: str) -> None:
    wrong = tally.vehicles != traffic.vehicles
    if wrong.any():
        first = int(wrong.argmax())
        raise RunError(
            f"{place}: {traffic.vehicles} vehicles are in {tally.frames - int(wrong.sum())} of {tally.frames} frames only;"
            f" the fewest are {tally.vehicles.min()}, the most {tally.vehicles.max()}, frame {first} has"
            f" {tally.vehicles[first]}. Lower traffic.vehicles, lengthen warmup_s, raise trips_per_s or the demand,"
            ' or set hold = "at_most"'
        )


def _check_moving(tally: Tally, recording: Recording, patience_s: float) -> None:
    period_s = recording.window.period_ms / 1000.0
    stands_s = {
        name: (tally.frames - 1 - frame) * period_s
        for name, frame in tally.stands_since.items()
        if name not in recording.on_purpose
    }
    stuck = [name for name, seconds in stands_s.items() if seconds > patience_s]
    if stuck:
        longest = max(stuck, key=lambda name: stands_s[name])
        raise RunError(
            f"{recording.place}: {len(stuck)} vehicles stand for more than {patience_s:g} s and through to the last frame,"
            f" {longest!r} for {stands_s[longest]:g} s: the traffic is jammed for good. Lower traffic.vehicles, or mend"
            " the network's signals and connections"
        )
