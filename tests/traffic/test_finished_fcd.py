"""Scenarios with a finished FCD file: frames, sizes of vehicles, roads."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from pathlib import Path

import pyarrow as pa
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.cli import stage_summary
from egvs.core.errors import InputError, MissingBackendError
from egvs.runs import stage_keys
from egvs.runs.run_context import open_folder
from egvs.scenario.traffic_config import TrafficConfig
from egvs.stages import traffic
from egvs.studies.study_settings import counted_frames
from egvs.traffic import finished_fcd
from egvs.traffic.vehicle_boxes import VehicleSize
from tests.conftest import fcd
from tests.stage_runner import inputs_of
from tests.stages.conftest import net_xml

LORRY = '<vType id="lorry" vClass="truck"/>'


CAR = '<vType id="car" length="4" width="1.7" height="1.4"/>'


def without_frames(mini: Path, *also: tuple[str, str]) -> Path:
    """The scenario without frames and warm-up; its file lasts 19.5 s in steps of 0.5 s."""
    text = (mini / "scenario.toml").read_text()
    for old, new in (("frames = 40\n", ""), ("warmup_s = 0\n", ""), *also):
        assert old in text
        text = text.replace(old, new)
    (mini / "scenario.toml").write_text(text)
    return mini


def set_types(mini: Path, *types: str) -> None:
    """Name the file's vehicles, which are cars, as these types, in turn."""
    head, *rows = (mini / "fcd.csv").read_text().splitlines()
    rows = [row.replace(";car;", f";{types[i % len(types)]};") for i, row in enumerate(rows)]
    (mini / "fcd.csv").write_text("\n".join([head, *rows]) + "\n")


def vtypes(mini: Path, *files: str) -> list[str]:
    """Write files of vTypes; the override that names them."""
    for number, text in enumerate(files):
        (mini / f"types{number}.xml").write_text(text)
    return [f"traffic.vtypes={[f'types{number}.xml' for number in range(len(files))]}"]


@pytest.mark.slow
def test_without_frames_the_complete_file_is_used(mini: Path, tmp_path: Path, run_egvs) -> None:
    assert run_egvs("run", mini, "--out", tmp_path / "said")[0] == 0
    code, printed, output = run_egvs("run", without_frames(mini), "--out", tmp_path / "without_frames")
    assert code == 0, output
    assert "left over" not in output + printed
    for name, read in (("trajectories", egvs.read_trajectories), ("scores", egvs.read_scores)):
        ours, theirs = (read(tmp_path / way / f"{name}.parquet") for way in ("said", "without_frames"))
        assert ours.equals(theirs)
    assert run_egvs("verify", tmp_path / "without_frames")[0] == 0


@pytest.mark.slow
def test_frames_after_the_last_full_block_are_skipped_with_a_note(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, printed, output = run_egvs(
        "run", without_frames(mini, ("blocks = 4", "blocks = 3")), "--out", tmp_path / "three", "--verbose"
    )
    assert code == 0, output
    assert "left over the last 1 of 40 frames, so that 3 blocks are alike" in output + printed
    metadata = parquet.read_metadata(tmp_path / "three" / "tpog.parquet", "tpog")
    assert (metadata["frames"], metadata["block_frames"]) == (39, 13)
    assert run_egvs("run", mini, "--set", "traffic.frames=39", "--out", tmp_path / "given")[0] == 0
    ours, theirs = (egvs.read_tpog(tmp_path / way / "tpog.parquet") for way in ("three", "given"))
    assert (ours.counts == theirs.counts).all()


@pytest.mark.slow
def test_frames_after_the_last_full_block_of_a_period_are_skipped(mini: Path, tmp_path: Path) -> None:
    """``[traffic]`` simulates, and one of its periods is a finished file."""
    (mini / "net.net.xml").write_text(net_xml())
    period = '[[traffic.periods]]\nname = "day"\nfcd = "fcd.csv"\n\n[[traffic.kinds]]'
    network = ('fcd = "fcd.csv"', 'network = "net.net.xml"')
    without_frames(mini, network, ("[[traffic.kinds]]", period), ("blocks = 4", "blocks = 3"))
    record = egvs.run(egvs.load(mini), tmp_path)
    assert record.stages["tpog"].summary["left_over"] == "the last 1 of 40 frames, so that 3 blocks are alike"


def test_sumo_version_is_an_input_if_any_period_is_simulated(mini: Path, tmp_path: Path) -> None:
    """Another SUMO is other traffic, whatever the first period comes from."""
    (mini / "net.net.xml").write_text(net_xml())
    (mini / "c.sumocfg").write_text('<configuration><net-file value="net.net.xml"/></configuration>')
    day, night = 'name = "day"\nfcd = "fcd.csv"\n', 'name = "night"\nsumocfg = "c.sumocfg"\nlength_s = 20\n'
    periods = f"[[traffic.periods]]\n{day}\n[[traffic.periods]]\n{night}\n"

    def version(text: str) -> object:
        (mini / "scenario.toml").write_text(text)
        return inputs_of(traffic, egvs.load(mini), tmp_path).to_json()["sumo"]

    text = (mini / "scenario.toml").read_text()
    assert version(text) is None
    assert version(text.replace('fcd = "fcd.csv"\n', "").replace("[[traffic.kinds]]", f"{periods}[[traffic.kinds]]"))


def test_warm_up_and_frame_period_apply_to_finished_file(mini: Path, tmp_path: Path) -> None:
    scenario = egvs.load(without_frames(mini), ["traffic.warmup_s=4", "traffic.frame_period_s=1", "tpog.blocks=2"])
    assert counted_frames(scenario) == 16  # 4, 5, ... 19 s
    assert counted_frames(egvs.load(mini, ["tpog.blocks=7"])) == 35
    record = egvs.run(scenario, tmp_path)
    assert record.stages["traffic"].summary["frames"] == 16


def test_rejects_fewer_frames_than_blocks(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, output = run_egvs("run", without_frames(mini, ("blocks = 4", "blocks = 50")), "--out", tmp_path)
    assert code == 2
    assert "tpog.blocks: 50 does not divide the 40 recorded frames. Use a divisor of 40." in output


def test_rejects_warm_up_longer_than_the_file(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, output = run_egvs("run", without_frames(mini), "--set", "traffic.warmup_s=20", "--out", tmp_path)
    assert code == 2
    assert "traffic.warmup_s = 20: the duration of fcd.csv is 19.5 s" in output


def test_default_length_of_a_simulation() -> None:
    traffic = TrafficConfig.from_dict({"network": "n.net.xml"})
    assert (traffic.frames, traffic.warmup_s) == (5000, 300.0)


@pytest.mark.slow
def test_sizes_from_vtypes_and_sumo_defaults(mini: Path, tmp_path: Path) -> None:
    set_types(mini, "lorry", "DEFAULT_VEHTYPE", "car", "coach")
    expected = vtypes(mini, f"<additional>{LORRY}</additional>",
                    f"<routes><vTypeDistribution id='d'>{CAR}</vTypeDistribution>"
                    "<route id='r' edges='no'/><vType id='coach' vClass='bus' length='12.5'/></routes>")  # fmt: skip
    egvs.run(egvs.load(mini, expected), tmp_path / "out")
    rows = egvs.read_trajectories(tmp_path / "out" / "trajectories.parquet").to_pylist()
    result = {(row["kind"], row["length_m"], row["width_m"], row["height_m"]) for row in rows}
    truck, passenger = ("truck", 7.1, 2.4, 2.4), ("passenger", 5.0, 1.8, 1.5)  # SUMO's defaults, its documentation
    car = ("passenger", 4.5, 1.8, 1.5)  # the scenario's kind comes before the file's
    assert result == {truck, passenger, car, ("bus", 12.5, 2.5, 3.4)}


def test_sumo_version_is_in_the_cache_key(mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trajectories' key holds SUMO's version though no SUMO drove; without a SUMO there is a key all the same."""

    def missing() -> str:
        raise MissingBackendError("no sumo")

    keys = set()
    for version in (lambda: "1.20.0", lambda: "1.28.0", missing):
        monkeypatch.setattr("egvs.traffic.sumo.sumo_version", version)
        keys.add(stage_keys.stage_key("traffic", open_folder(egvs.load(mini), tmp_path)).key)
    assert len(keys) == 3


@pytest.mark.slow
def test_vtypes_override_the_default_fleet(mini: Path, tmp_path: Path) -> None:
    text = (mini / "scenario.toml").read_text()
    kind = text[text.index("[[traffic.kinds]]") : text.index("[statics]")]
    (mini / "scenario.toml").write_text(text.replace(kind, ""))
    egvs.run(egvs.load(mini, vtypes(mini, f"<additional>{CAR}</additional>")), tmp_path / "out")
    rows = egvs.read_trajectories(tmp_path / "out" / "trajectories.parquet").to_pylist()
    assert {row["length_m"] for row in rows} == {4.0}


@pytest.mark.slow
def test_names_all_types_without_size(mini: Path, tmp_path: Path, run_egvs) -> None:
    set_types(mini, "tram", "car", "lorry", "car")
    code, _, output = run_egvs("run", mini, "--out", tmp_path)
    assert code == 2
    assert (
        "traffic.kinds: the sizes of these vehicle types in fcd.csv are unknown: 'lorry', 'tram'. For each, add a kind"
        in output
    )
    assert "Types with known sizes: car." in output
    head, _, _ = fcd().rpartition(";car;")
    (mini / "fcd.csv").write_text(f"{head};tram;1.7\n")  # at 19.5 s, beyond the frames that are asked for below
    assert run_egvs("run", mini, "--out", tmp_path)[0] == 2
    assert run_egvs("run", mini, "--set", "traffic.frames=36", "--out", tmp_path)[0] == 0


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (["<additional/>"], r"types0\.xml: the file has no <vType>"),
        (["<additional><vType/></additional>"], "a <vType> has no id"),
        ([f"<a>{LORRY}{LORRY}</a>"], "a second <vType> 'lorry'"),
        ([f"<a>{LORRY}</a>"] * 2, r"types1\.xml: a second <vType> 'lorry'"),
        (["<a><vType id='x' vClass='lorry'/></a>"], "vType x: vClass: unknown vClass 'lorry'"),
        *(([f"<a><vType id='x' height='{height}'/></a>"], f"vType x: height: expected a length, got '{height}'")
          for height in ("tall", "0", "-1", "nan", "inf", "1e-300", "2001", "1_0", "٣")),
        (["<a><vType id='x'></a>"], "is not well-formed XML"),
        (["<a><vType id='x y&gt;'/></a>"], r"types0\.xml: SUMO rejects the vehicle types: sumo ended with"),
    ],
)  # fmt: skip
def test_rejects_invalid_vtypes_file(mini: Path, tmp_path: Path, files: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        egvs.run(egvs.load(mini, vtypes(mini, *files)), tmp_path / "out")


def test_rejects_vtypes_without_finished_file(mini: Path) -> None:
    with pytest.raises(InputError, match=r"vtypes has no effect with network"):
        egvs.load(mini, ["traffic.network=n.net.xml", 'traffic.vtypes=["x.xml"]'])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("traffic.frames=400", r"frames = 400: fcd\.csv has 40 frames 0\.5 s apart"),
        ("traffic.frame_period_s=0.75", r"frame_period_s = 0\.75: the time steps of fcd\.csv are 0\.5 s apart"),
        ("traffic.warmup_s=20", r"warmup_s = 20: the duration of fcd\.csv is 19\.5 s"),
    ],
)
def test_check_reports_missing_frames(mini: Path, run_egvs, override: str, message: str) -> None:
    code, output, _ = run_egvs("check", without_frames(mini), "--set", override)
    assert code == 2
    assert re.search(message, output)


def test_check_reports_missing_sizes(mini: Path, run_egvs) -> None:
    set_types(mini, "tram", "car", "lorry", "DEFAULT_VEHTYPE")
    code, output, _ = run_egvs("check", mini)
    assert code == 2
    assert "the sizes of these vehicle types in fcd.csv are unknown: 'lorry', 'tram'" in output


@pytest.mark.slow
def test_roads_with_a_finished_file(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "net.net.xml").write_text(net_xml())
    roads = ["--set", "traffic.roads='net.net.xml'"]
    assert run_egvs("run", mini, "--out", tmp_path / "plain")[0] == 0
    code, _, output = run_egvs("run", mini, "--out", tmp_path / "roads", *roads)
    assert code == 0, output
    ours, theirs = (egvs.read_trajectories(tmp_path / way / "trajectories.parquet") for way in ("roads", "plain"))
    assert ours.equals(theirs)
    assert (tmp_path / "roads" / "sumo" / "network.net.xml").read_text() == net_xml()
    named = {way: set(parquet.read_artefact(tmp_path / way / "blindspots.parquet", "blindspots")[0]["by"].to_pylist())
             for way in ("roads", "plain")}  # fmt: skip
    assert "lane" in named["roads"] - named["plain"]
    assert run_egvs("verify", tmp_path / "roads")[0] == 0
    (mini / "net.net.xml").write_text(net_xml().replace("</net>", "<!-- another --></net>"))
    assert run_egvs("run", mini, "--out", tmp_path / "roads", *roads)[0] == 0
    assert "another" in (tmp_path / "roads" / "sumo" / "network.net.xml").read_text()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["traffic.roads='no.net.xml'"], "traffic.roads = 'no.net.xml': no such file"),
        (["traffic.roads='fcd.csv'"], "fcd.csv: is not well-formed XML"),
        (["traffic.network='net.net.xml'", "traffic.roads='net.net.xml'"], "roads has no effect with network"),
    ],
)
def test_rejects_wrong_roads(mini: Path, tmp_path: Path, run_egvs, settings: list[str], message: str) -> None:
    (mini / "net.net.xml").write_text(net_xml())
    code, _, output = run_egvs(
        "run", mini, "--out", tmp_path / "run", *(word for s in settings for word in ("--set", s))
    )
    assert code == 2 and message in output, output


def test_rejects_roads_in_the_folder_for_sumo(mini: Path, run_egvs) -> None:
    (mini / "sumo").mkdir()
    (mini / "sumo" / "mine.net.xml").write_text(net_xml())
    code, _, output = run_egvs("run", mini, "--out", mini, "--set", "traffic.roads='sumo/mine.net.xml'")
    assert code == 2 and "overwrite sumo/mine.net.xml, which the scenario uses (traffic.roads)" in output, output
    assert (mini / "sumo" / "mine.net.xml").is_file()


# --- missing time steps --------------------------------------------------------------------------------------------
def test_rejects_xml_with_missing_time_steps(mini: Path, run_egvs) -> None:
    write_xml(mini, skip=range(10, 14))
    code, printed, output = run_egvs("check", mini, "--set", "traffic.fcd='fcd.xml'")
    assert code == 2
    problem = "fcd.xml: time 7.00: expected equal time steps, got 0.5 s and 2.5 s: steps are missing"
    assert problem in " ".join(printed.split()), printed + output


def test_rejects_xml_whose_first_step_is_missing(mini: Path, run_egvs) -> None:
    write_xml(mini, skip=[1])
    code, printed, output = run_egvs("check", mini, "--set", "traffic.fcd='fcd.xml'")
    assert code == 2 and "time 1.50: expected equal time steps" in " ".join(printed.split()), printed + output


def test_xml_with_steps_without_vehicles_is_accepted(mini: Path, run_egvs) -> None:
    write_xml(mini, empty=range(10, 14))
    code, printed, output = run_egvs("check", mini, "--set", "traffic.fcd='fcd.xml'")
    assert code == 0, printed + output


def test_xml_with_times_rounded_to_milliseconds_is_accepted(tmp_path: Path) -> None:
    steps = "".join(
        f'<timestep time="{round(k / 30, 3)}"><vehicle id="a" x="{k}" y="0" angle="90" type="car"/></timestep>'
        for k in range(60)
    )
    path = tmp_path / "camera.xml"
    path.write_text(f"<fcd-export>{steps}</fcd-export>")
    assert finished_fcd.survey_fcd(path).time_steps == 60


def test_warns_of_vehicles_that_disappear_and_return(mini: Path, run_egvs) -> None:
    head, *rows = (mini / "fcd.csv").read_text().splitlines()
    rest = [row for row in rows if not 5.0 <= float(row.split(";")[0]) < 7.0]
    (mini / "fcd.csv").write_text("\n".join([head, *rest]) + "\n")
    code, printed, output = run_egvs("check", mini)
    text = " ".join((printed + output).split())
    assert code == 0, text
    assert re.search(r"fcd = 'fcd.csv': vehicles disappear and return (once|\d+ times), e.g. '\w+'", text), text
    assert "between 4.5 s and 7 s" in text


def test_vehicle_that_returns_in_a_later_part_of_a_long_file_is_found() -> None:
    presence = finished_fcd._VehiclePresence()
    for times_ms in ([0, 500, 1000], [1500, 4000, 4500]):
        presence.add(pa.table({"id": ["a"] * 3, "time_ms": pa.array(times_ms, pa.int64())}))
        presence.add(pa.table({"id": pa.array([], pa.string()), "time_ms": pa.array([], pa.int64())}))
    assert presence.find_returns() == (1, "'a' between 1.5 s and 4 s")


def test_file_with_complete_trips_gets_no_warning(mini: Path, run_egvs) -> None:
    code, printed, output = run_egvs("check", mini)
    assert code == 0 and "disappear" not in printed + output


def write_xml(mini: Path, skip: Collection[int] = (), empty: Collection[int] = ()) -> None:
    """Write the finished file as XML, without some time steps, or without the vehicles of some."""
    head, *lines = (mini / "fcd.csv").read_text().splitlines()
    names = [name.partition("_")[2] for name in head.split(";")]
    steps: dict[str, list[str]] = {}
    for line in lines:
        row = dict(zip(names, line.split(";"), strict=True))
        time = f"{float(row.pop('time')):.2f}"
        vehicle = " ".join(f'{key}="{value}"' for key, value in row.items())
        steps.setdefault(time, []).append(f"<vehicle {vehicle}/>")
    texts = []
    for number, (time, vehicles) in enumerate(steps.items()):
        if number not in skip:
            content = "" if number in empty else "".join(vehicles)
            texts.append(f'<timestep time="{time}">{content}</timestep>')
    (mini / "fcd.xml").write_text(f"<fcd-export>{''.join(texts)}</fcd-export>")


# --- sizes and their sources ---------------------------------------------------------------------------------------
def test_prints_sizes_and_where_they_come_from(mini: Path, tmp_path: Path, run_egvs) -> None:
    set_types(mini, "car", "lorry", "bus", "DEFAULT_VEHTYPE")
    text = (mini / "scenario.toml").read_text()
    kind = text[text.index("[[traffic.kinds]]") : text.index("[statics]")]
    (mini / "scenario.toml").write_text(text.replace(kind, ""))
    (overrides,) = vtypes(mini, f"<additional>{LORRY}</additional>")
    code, _, output = run_egvs("traffic", mini, "--out", tmp_path / "out", "--set", overrides)
    assert code == 0, output
    text = " ".join(output.split())
    expected = (
        "sizes: DEFAULT_VEHTYPE 5 x 1.8 x 1.5 m (from SUMO's default type),"
        " bus 10.9 x 2.5 x 3.1 m (from a default kind),"
        " car 4.5 x 1.75 x 1.5 m (from a default kind), lorry 7.1 x 2.4 x 2.4 m (from traffic.vtypes)"
    )
    assert expected in text, text


def test_size_of_a_kind_of_the_scenario_is_named_as_such(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, output = run_egvs("traffic", mini, "--out", tmp_path / "out")
    assert code == 0, output
    assert "sizes from traffic.kinds: car 4.5 x 1.8 x 1.5 m" in " ".join(output.split())
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    size = {"length_m": 4.5, "width_m": 1.8, "height_m": 1.5, "vclass": "passenger", "source": "traffic.kinds"}
    assert record["stages"]["traffic"]["summary"]["sizes"] == {"car": size}


def test_size_in_the_metadata_of_the_file_is_named_as_such(mini: Path) -> None:
    declared = {"car": VehicleSize(5.0, 2.0, 1.5, "passenger"), "bus": VehicleSize(11.0, 2.5, 3.2, "bus")}
    sized = finished_fcd.sizes_of_types(egvs.load(mini), declared, declared)
    assert {name: sized[name].source for name in declared} == {"car": "traffic.kinds", "bus": "the FCD file"}


def test_many_sizes_are_shortened() -> None:
    size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5, "vclass": "passenger", "source": "traffic.vtypes"}
    text = stage_summary.describe_sizes({f"t{number}": size for number in range(10)})
    assert text.startswith("sizes from traffic.vtypes: t0 4 x 2 x 1.5 m, t1 ")
    assert text.endswith("t5 4 x 2 x 1.5 m, 4 more in run.json")
