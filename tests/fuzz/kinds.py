"""The kinds of files that the program reads: where each lies, which verb reads it, and what it says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tests.extensions.tracks import writers, writers_json
from tests.fuzz import bases, meaning, read_signals, read_tracks
from tests.fuzz.meaning import Meaning

Maker = Callable[[str], Callable[[Path], None]]
"""Returns what writes the base of a kind, by the name of its file."""

_RUN = ("run", "scenario", "--out", "out", "--jobs", "1")
_STUDY = ("accuracy", "scenario", "--out", "out", "--budget", "1s", "--jobs", "1")
_SCORES = ("out/scores.parquet",)


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    Attributes
    ----------
    file
        What is mutated, in the case's folder; of several files that match, any.
    make
        Writes the scenario.
    meaning
        Of the file's bytes, read by other code.
    before
        Verbs that make what is mutated.
    verb
        What reads it.
    results
        What the verb writes that must stay the same, or change with the meaning; with a star, all that match.
    store
        Whether there is a store, in the case's folder.
    names_others
        Whether a message may name another file: what the mutant names, or what was made of it.
    may_differ
        Whether exit code 1 is an answer: files differ.
    simulated
        Whether traffic is, of which a scenario promises something.
    checked
        Whether ``egvs check`` reads it, too.
    """

    name: str
    file: str
    make: Callable[[Path], None]
    meaning: Meaning
    before: tuple[tuple[str, ...], ...] = ()
    verb: tuple[str, ...] = _RUN
    results: tuple[str, ...] = _SCORES
    store: bool = False
    names_others: bool = False
    may_differ: bool = False
    simulated: bool = False
    checked: bool = False


def _input(name: str, file: str, make: Callable[[Path], None], reads: Meaning, names_others: bool = False) -> Kind:
    """A file in the scenario's folder, and a whole run."""
    checked = not name.startswith("scan.")  # measured scans are compared with the world by a run only
    return Kind(name, f"scenario/{file}", make, reads, names_others=names_others, checked=checked)


def _simulated(name: str, file: str, make: Callable[[Path], None], names_others: bool = False) -> Kind:
    """What SUMO reads a copy of."""
    reads = meaning.rows if file.endswith(".csv") else meaning.gzipped(meaning.xml)
    return Kind(name, f"scenario/{file}", make, reads, names_others=names_others, simulated=True, checked=True)


def _artefact(name: str, verb: str) -> Kind:
    """What a run has written, read by one verb."""
    make = bases.visible if name.startswith("visibility") else bases.plain
    verbs = _RUN if verb == "run" else (verb, "scenario", "--out", "out")
    return Kind(f"{name} {verb}", f"out/{name}", make, meaning.nothing_else, (_RUN,), verbs)


def _new(name: str, reads: Meaning) -> Kind:
    """A map that becomes a scenario."""
    made = tuple(f"made/{file}" for file in ("network.net.xml", "sites.csv", "statics.geojson"))
    return Kind(f"new {name}", name, bases.extract(name), reads, verb=("new", "made", "--osm", name), results=made)


def _lanelets(name: str) -> Kind:
    """A Lanelet2 map that becomes a scenario."""
    made = tuple(f"made/{file}" for file in ("network.net.xml", "sites.csv"))
    verb = ("new", "made", "--from", name, "--vehicles-per-hour", "200")
    reads = meaning.gzipped(meaning.xml)
    # Without the streets of one arm, the message may name --vehicles-per-hour.
    return Kind(f"new {name}", name, bases.lanelets(name), reads, verb=verb, results=made, names_others=True)


def _road_map(name: str, reads: Meaning) -> Kind:
    """A SUMO network, or an OpenDRIVE map, that becomes a scenario."""
    made = tuple(f"made/{file}" for file in ("network.net.xml", "sites.csv"))
    verb = ("new", "made", "--from", name, "--vehicles-per-hour", "200")
    return Kind(f"new {name}", name, bases.road_map(name), reads, verb=verb, results=made, names_others=True)


def _beside(name: str, reads: Meaning, make: Maker = bases.with_roads_map, mutated: str = "") -> Kind:
    """A map of what stands beside roads, or of their ground, which becomes part of a scenario."""
    made = ("made/network.net.xml", "made/sites.csv", "made/statics.geojson", "made/*.ply")
    verb = ("new", "made", "--from", "roads.net.xml", name, "--vehicles-per-hour", "200")
    if make in (bases.surveyed, bases.modelled):
        verb += ("--align", "0,0=52.0,10.0", "--align", "0,100=52.000899,10.0")
    mutated = mutated or name
    return Kind(f"new {mutated}", mutated, make(name), reads, verb=verb, results=made, names_others=mutated != name)


def _sweep(name: str, reads: Meaning) -> Kind:
    """A sweep to which a sensor is fitted."""
    verb = ("sensor", "fit", name, "--name", "mast", "--out", "made")
    return Kind(f"sweep {name}", name, bases.sweep(name), reads, verb=verb, results=("made/sensor.toml",))


def _recording(name: str) -> Kind:
    """A recording of sweeps to which a sensor is fitted."""
    verb = ("sensor", "fit", name, "--name", "mast", "--out", "made")
    make = bases.recording(name)
    return Kind(f"sweep {name}", name, make, meaning.bytes_themselves, verb=verb, results=("made/sensor.toml",))


def _city(name: str, file: str, reads: Meaning) -> Kind:
    """What the cut of a city's traffic reads."""
    verb = ("city", "traffic", "town")
    return Kind(
        name, f"town/{file}", bases.city, reads, verb=verb, results=("town/traffic/*.parquet",), names_others=True
    )


def _tracks(file: str, make: Callable[[Path], None], reads: Meaning, main: str = "", *words: str) -> Kind:
    """A file of recorded tracks, or one beside it, and the reader alone."""
    verb = (read_tracks.VERB, f"tracks/{main or file}", *words)
    reads = meaning.gzipped(reads)
    return Kind(f"tracks {file}", f"tracks/{file}", make, reads, verb=verb, results=(read_tracks.RESULT,))


def _signals(file: str, reads: Meaning, *others: str) -> Kind:
    """A file of recorded signals, or of what they govern, and the program that they become."""
    verb = (read_signals.VERB, f"signals/{file}", *(f"signals/{other}" for other in others))
    reads = meaning.gzipped(reads)
    return Kind(f"signals {file}", f"signals/{file}", bases.signals, reads, verb=verb, results=(read_signals.RESULT,))


def _labels(form: str, reads: Meaning) -> Kind:
    """Labels of measured sweeps."""
    verb = ("validate", "scenario", "--against", "sweeps", "--labels", "labels", "--sensor", "small", "--detector",
            "points", "--out", "made", "--yaw", "x-ccw",
            *(("--columns", "type=class,x_m=cx") if form == "csv" else ()))  # fmt: skip
    made = ("made/against.json",)
    return Kind(f"labels {form}", "labels/*", bases.labelled(form), reads, verb=verb, results=made)


_IND = bases.tracks(writers.write_levelx, "car", "pedestrian")
_HIGHD = bases.tracks(writers.write_highd, "car", "truck", straight=True)
_TAF_BW = bases.tracks(writers.write_taf_bw, "car", "pedestrian")

_SCENARIO_COLUMNS = ("track_id", "object_type", "timestep", "position_x", "position_y", "heading")

_ALL = (
    _input("scenario.toml", "scenario.toml", bases.plain, meaning.toml, True),
    Kind("extended scenario.toml", "scenario/scenario.toml", bases.heir, meaning.toml,
         verb=("run", "heir", "--out", "out", "--jobs", "1"), names_others=True),
    _simulated("net.xml", "net.net.xml", bases.drawn), _simulated("net.xml.gz", "net.net.xml.gz", bases.drawn_gz),
    _simulated("rou.xml", "own.rou.xml", bases.routed), _simulated("sumocfg", "own.sumocfg", bases.configured, True),
    _simulated("add.xml", "own.add.xml", bases.configured),
    *(_input(f"fcd.{form}", f"fcd.{form}", bases.finished(form), reads) for form, reads in (
        ("csv", meaning.gzipped(meaning.semicolons)), ("csv.gz", meaning.gzipped(meaning.semicolons)),
        ("xml", meaning.gzipped(meaning.xml)), ("xml.gz", meaning.gzipped(meaning.xml)),
        ("parquet", meaning.gzipped(meaning.parquet)), ("parquet.gz", meaning.gzipped(meaning.parquet)))),
    _input("vtypes.xml", "own.add.xml", bases.typed, meaning.gzipped(meaning.xml)),
    _input("statics.geojson", "statics.geojson", bases.plain, meaning.text_json),
    _input("poly.xml", "own.poly.xml", bases.polygons, meaning.gzipped(meaning.xml)),
    _input("mesh.obj", "house.obj", bases.mesh("house.obj"), meaning.obj),
    _input("mesh.mtl", "house.mtl", bases.mesh("house.obj"), meaning.bytes_themselves),
    _input("mesh.gltf", "house.gltf", bases.mesh("house.gltf"), meaning.text_json, True),
    _input("mesh.bin", "house.bin", bases.mesh("house.gltf"), meaning.bytes_themselves, True),
    _input("mesh.glb", "house.glb", bases.mesh("house.glb"), meaning.glb),
    _input("mesh.stl", "house.stl", bases.mesh("house.stl"), meaning.stl),
    _input("mesh.ply", "house.ply", bases.mesh("house.ply"), meaning.ply),
    Kind("terrain.ply", "scenario/terrain.ply", bases.terrain, meaning.ply, results=("out/statics.ply",)),
    _input("sites.csv", "sites.csv", bases.plain, meaning.rows),
    _input("sites.xlsx", "sites.xlsx", bases.in_workbook, meaning.bytes_themselves),
    _input("sites.geojson", "sites.geojson", bases.sites, meaning.text_json),
    _input("beams.csv", "beams.csv", bases.beams, meaning.rows),
    _input("metadata.json", "metadata.json", bases.metadata, meaning.text_json),
    _input("angles.csv", "angles.csv", bases.angles, meaning.rows),
    _input("rings.csv", "beams.csv", bases.ring_table, meaning.rows),
    _input("robosense.csv", "beams.csv", bases.robosense, meaning.rows),
    _input("directions.csv", "beams.csv", bases.directions, meaning.rows),
    *(_input(f"sites.{form}", f"sites.{form}", bases.located(f"sites.{form}"), meaning.bytes_themselves)
      for form in ("gpkg", "shp", "parquet")),
    Kind("sites.csv place", "scenario/sites.csv", bases.priced, meaning.rows, (_RUN,),
         ("place", "scenario", "--out", "out"), ("out/placement.parquet",)),
    _simulated("signals.csv", "signals.csv", bases.signalled("signals.csv")),
    _simulated("signals.xml", "signals.xml", bases.signalled("signals.xml")),
    _simulated("observed.csv", "observed.csv", bases.observed),
    _input("scan.csv", "points.csv", bases.measured("points.csv"), meaning.rows),
    _input("scan.las", "points.las", bases.measured("points.las"), meaning.bytes_themselves),
    _input("scan.laz", "points.laz", bases.measured("points.laz"), meaning.bytes_themselves),
    _input("scan.e57", "points.e57", bases.measured("points.e57"), meaning.bytes_themselves),
    _input("scan.ply", "points.ply", bases.measured("points.ply"), meaning.ply),
    _input("scan.ply binary", "binary.ply", bases.measured("binary.ply"), meaning.ply),
    _input("scan.pcd", "points.pcd", bases.measured("points.pcd"), meaning.pcd),
    _input("scan.pcd binary", "binary.pcd", bases.measured("binary.pcd"), meaning.pcd),
    Kind("new counts.csv", "counts.csv", bases.counted, meaning.rows, results=("made/scenario.toml", "made/sites.csv"),
         verb=("new", "made", "--osm", "map.osm", "--counts", "counts.csv")),
    Kind("new map_projector_info.yaml", "map_projector_info.yaml", bases.projected, meaning.bytes_themselves,
         verb=("new", "made", "--from", "lanelets.osm", "--vehicles-per-hour", "200"),
         results=("made/network.net.xml", "made/sites.csv"), names_others=True),
    Kind("new surface.asc", "surface.asc", bases.surfaced, meaning.bytes_themselves,
         verb=("new", "made", "--from", "roads.net.xml", "terrain.asc", "houses.geojson", "--surface", "surface.asc",
               "--vehicles-per-hour", "200"), results=("made/statics.geojson",)),
    _new("map.osm", meaning.gzipped(meaning.xml)), _new("map.osm.gz", meaning.gzipped(meaning.xml)),
    _new("map.osm.pbf", meaning.bytes_themselves), _lanelets("lanelets.osm"), _lanelets("lanelets.osm.gz"),
    _beside("city.gml", meaning.bytes_themselves), _beside("dem.gml", meaning.bytes_themselves),
    _beside("city.json", meaning.text_json), _beside("houses.geojson", meaning.text_json),
    _road_map("roads.net.xml", meaning.bytes_themselves), _road_map("roads.xodr", meaning.bytes_themselves),
    *(_beside(f"houses.{form}", meaning.bytes_themselves, bases.vectors) for form in ("gpkg", "shp", "kml", "parquet")),
    *(_beside("houses.shp", meaning.bytes_themselves, bases.vectors, f"houses.{form}")
      for form in ("dbf", "shx", "prj", "cpg")),
    *(_beside(f"terrain.{form}", meaning.bytes_themselves, bases.on_terrain) for form in ("asc", "tif", "xml")),
    _beside("terrain.asc", meaning.bytes_themselves, bases.on_terrain, "terrain.prj"),
    *(_beside(f"survey.{form}", reads, bases.surveyed) for form, reads in (
        ("csv", meaning.rows), ("pcd", meaning.pcd), ("pcd.gz", meaning.bytes_themselves), ("ply", meaning.ply),
        ("las", meaning.bytes_themselves), ("laz", meaning.bytes_themselves), ("e57", meaning.bytes_themselves))),
    *(_beside(f"house.{form}", reads, bases.modelled) for form, reads in (
        ("obj", meaning.obj), ("ply", meaning.ply), ("stl", meaning.stl), ("off", meaning.bytes_themselves),
        ("gltf", meaning.text_json), ("glb", meaning.glb))),
    _beside("house.gltf", meaning.bytes_themselves, bases.modelled, "house.bin"),
    _tracks("vehicle_tracks_000.csv", _TAF_BW, meaning.table),
    _tracks("meta_data.csv", _TAF_BW, meaning.table, "vehicle_tracks_000.csv"),
    _tracks("Veh_smoothed_tracks.csv", bases.tracks(writers.write_sind, "car", "pedestrian"), meaning.table),
    _tracks("Veh_smoothed_tracks.csv.gz", bases.zipped_tracks, meaning.table),
    *(_tracks(f"07_{file}.csv", _IND, meaning.table, "07_tracks.csv")
      for file in ("tracks", "tracksMeta", "recordingMeta")),
    *(_tracks(f"03_{file}.csv", _HIGHD, meaning.table, "03_tracks.csv")
      for file in ("tracks", "tracksMeta", "recordingMeta")),
    _tracks("trajectories.csv", bases.tracks(writers.write_ngsim, "car", "truck"), meaning.table),
    _tracks("20181024_d1_0830_0900.csv", bases.tracks(writers.write_pneuma, "car", "bus"), meaning.semicolons),
    _tracks("Label.csv", bases.tracks(writers.write_lumpi, "car", "pedestrian"), meaning.commas),
    _tracks("labels.json", bases.tracks(writers_json.write_openlabel, "car", "pedestrian"), meaning.lenient_json),
    _tracks(f"*_{writers_json.SENSOR}.json", bases.tracks(writers_json.write_tumtraf, "car", "bus"),
            meaning.lenient_json, writers_json.sweep_name(0.0)),
    *(_tracks(file, bases.tracks(writers_json.write_dair_v2x, "car", "pedestrian"), meaning.lenient_json,
              "label/virtuallidar/000000.json")
      for file in ("label/virtuallidar/*.json", "data_info.json", "calib/virtuallidar_to_world/*.json")),
    _tracks("10001.csv", bases.tracks(writers_json.write_v2x_seq_tfd, "car", "bicycle"), meaning.table),
    _tracks("scenario_hand-made.parquet", bases.tracks(writers_json.write_argoverse2_scenario, "car", "bus"),
            partial(meaning.parquet, columns=_SCENARIO_COLUMNS, optional=("start_timestamp", "city"))),
    *(_tracks(file, bases.tracks(writers_json.write_argoverse2, "car", "bus"), meaning.feather, "annotations.feather")
      for file in ("annotations.feather", "city_SE3_egovehicle.feather")),
    _tracks("trace_gt_hand-made.osi", bases.tracks(writers_json.write_osi, "car", "tram"), meaning.bytes_themselves),
    _tracks("trace.mcap", bases.tracks(writers_json.write_osi_mcap, "car", "tram"), meaning.bytes_themselves),
    _tracks("tracks.csv", bases.mapped_tracks(False), meaning.table, "", "mapping"),
    _tracks("tracks.jsonl", bases.mapped_tracks(True), meaning.json_lines, "", "mapping"),
    Kind("track columns.toml", "columns.toml", bases.named_columns, meaning.toml,
         verb=(read_tracks.VERB, "tracks.csv", "columns.toml"), results=(read_tracks.RESULT,), names_others=True),
    _labels("openlabel", meaning.lenient_json), _labels("dair", meaning.lenient_json),
    _labels("kitti", meaning.words), _labels("csv", meaning.rows),
    _signals("states.csv", meaning.table, "groups.csv"), _signals("lights.csv", meaning.table, "light_groups.csv"),
    _signals("groups.csv", meaning.table, "states.csv"), _signals("map.kml", meaning.kml, "states.csv"),
    Kind("sweep sweep.bin", "sweep.bin", bases.binary_sweep, meaning.bytes_themselves, results=("made/sensor.toml",),
         verb=("sensor", "fit", "sweep.bin", "--name", "mast", "--out", "made")),
    Kind("calibration.json", "calibration.json", bases.calibrated, meaning.text_json, results=("made/sensor.toml",),
         verb=("sensor", "fit", "sweep.pcd", "--name", "mast", "--out", "made", "--calibration", "calibration.json")),
    _sweep("sweep.csv", meaning.rows), _sweep("sweep.pcd", meaning.pcd),
    _recording("sweep.bag"), _recording("sweep.mcap"), _recording("sweep.db3"), _recording("sweep.pcap"),
    _sweep("sweep.ply.gz", meaning.gzipped(meaning.ply)), _sweep("sweep.npz", meaning.bytes_themselves),
    Kind("wanted junctions.csv", "wanted.csv", bases.wanted, meaning.rows, results=("made/junctions/*/*.csv",),
         verb=("city", "new", "made", "--osm", "map.osm", "--junctions", "wanted.csv")),
    _city("city.toml", "city.toml", meaning.toml), _city("junctions.csv", "junctions.csv", meaning.rows),
    _city("junction scenario.toml", "junctions/west/scenario.toml", meaning.toml),
    _city("city fcd.csv", "fcd.csv", meaning.gzipped(meaning.semicolons)),
    *(_artefact(name, verb) for name, verb in (
        ("trajectories.parquet", "tpog"), ("statics.ply", "scan"), ("tpog.parquet", "score"),
        ("scans.parquet", "score"), ("scores.parquet", "report"), ("blindspots.parquet", "report"),
        ("visibility.parquet", "run"), ("statics.ply", "run"), ("trajectories.parquet", "run"))),
    Kind("run.json run", "out/run.json", bases.plain, meaning.text_json, (_RUN,)),
    Kind("run.json verify", "out/run.json", bases.plain, meaning.text_json, (_RUN,), ("verify", "out"), (".out",),
         names_others=True, may_differ=True),
    Kind("run.json compare", "out/run.json", bases.plain, meaning.text_json,
         (_RUN, ("run", "scenario", "--out", "other", "--jobs", "1")), ("compare", "out", "other"), (".out",),
         names_others=True),
    Kind("store note", "store/*/entry.json", bases.plain, meaning.nothing_else,
         (("run", "scenario", "--out", "first", "--jobs", "1"),), store=True),
    Kind("study cache", "out/accuracy/**/*.json", bases.plain, meaning.nothing_else, (_STUDY,), _STUDY, (), store=True),
    Kind("store artefact", "store/*/*.p*", bases.plain, meaning.nothing_else,
         (("run", "scenario", "--out", "first", "--jobs", "1"),), store=True),
)  # fmt: skip

KINDS = {kind.name: kind for kind in _ALL}
"""By name."""

FORMATS = {
    "`scenario.toml`": ("scenario.toml", "extended scenario.toml", "city.toml", "track columns.toml"),
    "JSON, GeoJSON": ("statics.geojson", "sites.geojson", "new city.json", "metadata.json", "labels openlabel"),
    "polygons of any format": ("poly.xml", "new houses.geojson", "new city.gml"),
    "tables in CSV": ("sites.csv", "junctions.csv", "new counts.csv", "signals.csv", "observed.csv", "labels csv"),
    "XML of any kind": ("net.xml", "vtypes.xml", "new city.gml", "new terrain.xml", "new roads.xodr"),
    "workbooks (xlsx, xls, ods)": ("sites.xlsx",),
    "gzip of any file": ("net.xml.gz", "fcd.csv.gz", "new map.osm.gz", "sweep sweep.ply.gz"),
    "FCD in Parquet": ("fcd.parquet", "fcd.parquet.gz"),
    "tracks in CSV": ("tracks 07_tracks.csv", "tracks tracks.csv", "tracks 10001.csv"),
    "tracks in Parquet, Feather": ("tracks scenario_hand-made.parquet", "tracks annotations.feather"),
    "OpenStreetMap (XML)": ("new map.osm", "new map.osm.gz"),
    "OpenStreetMap (PBF)": ("new map.osm.pbf",),
    "points in CSV, PLY, PCD": ("scan.csv", "scan.ply binary", "scan.pcd binary", "new survey.pcd"),
    "LAS": ("scan.las", "new survey.las"),
    "LAZ": ("scan.laz", "new survey.laz"),
    "E57": ("scan.e57", "new survey.e57"),
    "meshes": ("mesh.obj", "mesh.stl", "mesh.ply", "mesh.glb", "mesh.gltf", "new house.off"),
    "GeoPackage, Shapefile, KML": ("new houses.gpkg", "new houses.shp", "new houses.kml", "sites.gpkg", "sites.shp"),
    "GeoParquet": ("new houses.parquet", "sites.parquet"),
    "GeoTIFF; pictures (PNG, JPEG)": ("new terrain.tif",),
    "ASCII grids": ("new terrain.asc", "new surface.asc"),
    "sweeps in `.npz`": ("sweep sweep.npz",),
    "networks, maps and demand for SUMO": ("net.xml", "sumocfg", "add.xml", "new roads.net.xml", "new lanelets.osm"),
    "route files": ("rou.xml",),
}
"""Kinds of each row of the table "Limits by format" in docs/security.md."""
