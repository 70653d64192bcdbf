"""A finished file of FCD taken whole, and the sizes of its vehicles from SUMO's own files."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import egvs
from egvs.artefacts import parquet
from egvs.core.errors import InputError, MissingBackendError
from egvs.runs import stages
from egvs.scenario.traffic_config import TrafficConfig
from egvs.stages import traffic
from egvs.stages.inputs import open_folder
from egvs.studies.study_settings import counted_frames
from tests.checks.conftest import net_xml
from tests.conftest import fcd
from tests.stages import inputs_of

LORRY = '<vType id="lorry" vClass="truck"/>'
CAR = '<vType id="car" length="4" width="1.7" height="1.4"/>'


def unsaid(mini: Path, *also: tuple[str, str]) -> Path:
    """The scenario without frames and warm-up; its file lasts 19.5 s in steps of 0.5 s."""
    text = (mini / "scenario.toml").read_text()
    for old, new in (("frames = 40\n", ""), ("warmup_s = 0\n", ""), *also):
        assert old in text
        text = text.replace(old, new)
    (mini / "scenario.toml").write_text(text)
    return mini


def retyped(mini: Path, *types: str) -> None:
    """Name the file's vehicles, which are cars, as these types, in turn."""
    head, *rows = (mini / "fcd.csv").read_text().splitlines()
    rows = [row.replace(";car;", f";{types[i % len(types)]};") for i, row in enumerate(rows)]
    (mini / "fcd.csv").write_text("\n".join([head, *rows]) + "\n")


def vtypes(mini: Path, *files: str) -> list[str]:
    """Write files of vTypes; the override that names them."""
    for number, text in enumerate(files):
        (mini / f"types{number}.xml").write_text(text)
    return [f"traffic.vtypes={[f'types{number}.xml' for number in range(len(files))]}"]


# ---- how long


@pytest.mark.slow
def test_without_frames_all_of_a_file_is_taken(mini: Path, tmp_path: Path, run_egvs) -> None:
    assert run_egvs("run", mini, "--out", tmp_path / "said")[0] == 0
    code, printed, said = run_egvs("run", unsaid(mini), "--out", tmp_path / "unsaid")
    assert code == 0, said
    assert "left over" not in said + printed
    for name, read in (("trajectories", egvs.read_trajectories), ("scores", egvs.read_scores)):
        ours, its = (read(tmp_path / way / f"{name}.parquet") for way in ("said", "unsaid"))
        assert ours.equals(its)
    assert run_egvs("verify", tmp_path / "unsaid")[0] == 0


@pytest.mark.slow
def test_what_fills_no_block_is_left_over_and_told(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, printed, said = run_egvs("run", unsaid(mini, ("blocks = 4", "blocks = 3")), "--out", tmp_path / "three")
    assert code == 0, said
    assert "left over the last 1 of 40 frames, so that 3 blocks are alike" in said + printed
    about = parquet.read_metadata(tmp_path / "three" / "tpog.parquet", "tpog")
    assert (about["frames"], about["block_frames"]) == (39, 13)
    assert run_egvs("run", mini, "--set", "traffic.frames=39", "--out", tmp_path / "given")[0] == 0
    ours, its = (egvs.read_tpog(tmp_path / way / "tpog.parquet") for way in ("three", "given"))
    assert (ours.counts == its.counts).all()


def test_what_fills_no_block_of_a_periods_file_is_left_over(mini: Path, tmp_path: Path) -> None:
    """``[traffic]`` simulates, and one of its periods is a finished file."""
    (mini / "net.net.xml").write_text(net_xml())
    period = '[[traffic.periods]]\nname = "day"\nfcd = "fcd.csv"\n\n[[traffic.kinds]]'
    network = ('fcd = "fcd.csv"', 'network = "net.net.xml"')
    unsaid(mini, network, ("[[traffic.kinds]]", period), ("blocks = 4", "blocks = 3"))
    record = egvs.run(egvs.load(mini), tmp_path)
    assert record.stages["tpog"].summary["left_over"] == "the last 1 of 40 frames, so that 3 blocks are alike"


def test_sumo_counts_where_any_period_is_simulated(mini: Path, tmp_path: Path) -> None:
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


def test_warm_up_and_period_still_act(mini: Path, tmp_path: Path) -> None:
    scenario = egvs.load(unsaid(mini), ["traffic.warmup_s=4", "traffic.frame_period_s=1", "tpog.blocks=2"])
    assert counted_frames(scenario) == 16  # 4, 5, ... 19 s
    assert counted_frames(egvs.load(mini, ["tpog.blocks=7"])) == 35
    record = egvs.run(scenario, tmp_path)
    assert record.stages["traffic"].summary["frames"] == 16


def test_too_few_frames_for_the_blocks_are_told(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, said = run_egvs("run", unsaid(mini, ("blocks = 4", "blocks = 50")), "--out", tmp_path)
    assert code == 2
    assert "tpog.blocks: 50 does not divide the 40 frames recorded; a divisor, or at most 40" in said


def test_a_warm_up_longer_than_the_file_is_told(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, said = run_egvs("run", unsaid(mini), "--set", "traffic.warmup_s=20", "--out", tmp_path)
    assert code == 2
    assert "traffic.warmup_s = 20: fcd.csv lasts 19.5 s; a shorter warm-up" in said


def test_a_simulation_still_has_its_default_length() -> None:
    traffic = TrafficConfig.from_dict({"network": "n.net.xml"})
    assert (traffic.frames, traffic.warmup_s) == (5000, 300.0)


# ---- how large


def test_sizes_come_from_sumos_own_files_and_its_defaults(mini: Path, tmp_path: Path) -> None:
    retyped(mini, "lorry", "DEFAULT_VEHTYPE", "car", "coach")
    wanted = vtypes(mini, f"<additional>{LORRY}</additional>",
                    f"<routes><vTypeDistribution id='d'>{CAR}</vTypeDistribution>"
                    "<route id='r' edges='no'/><vType id='coach' vClass='bus' length='12.5'/></routes>")  # fmt: skip
    egvs.run(egvs.load(mini, wanted), tmp_path / "out")
    rows = egvs.read_trajectories(tmp_path / "out" / "trajectories.parquet").to_pylist()
    found = {(row["kind"], row["length_m"], row["width_m"], row["height_m"]) for row in rows}
    truck, passenger = ("truck", 7.1, 2.4, 2.4), ("passenger", 5.0, 1.8, 1.5)  # SUMO's defaults, its documentation
    car = ("passenger", 4.5, 1.8, 1.5)  # the scenario's kind comes before the file's
    assert found == {truck, passenger, car, ("bus", 12.5, 2.5, 3.4)}


def test_another_sumo_may_have_other_sizes_for_its_own_types(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trajectories' key holds SUMO's version though no SUMO drove; without a SUMO there is a key all the same."""

    def missing() -> str:
        raise MissingBackendError("no sumo")

    keys = set()
    for version in (lambda: "1.20.0", lambda: "1.28.0", missing):
        monkeypatch.setattr("egvs.traffic.sumo.sumo_version", version)
        keys.add(stages.stage_key("traffic", open_folder(egvs.load(mini), tmp_path)).key)
    assert len(keys) == 3


def test_a_file_of_vtypes_comes_before_the_default_fleet(mini: Path, tmp_path: Path) -> None:
    text = (mini / "scenario.toml").read_text()
    kind = text[text.index("[[traffic.kinds]]") : text.index("[statics]")]
    (mini / "scenario.toml").write_text(text.replace(kind, ""))
    egvs.run(egvs.load(mini, vtypes(mini, f"<additional>{CAR}</additional>")), tmp_path / "out")
    rows = egvs.read_trajectories(tmp_path / "out" / "trajectories.parquet").to_pylist()
    assert {row["length_m"] for row in rows} == {4.0}


def test_all_missing_kinds_are_asked_for_at_once(mini: Path, tmp_path: Path, run_egvs) -> None:
    retyped(mini, "tram", "car", "lorry", "car")
    code, _, said = run_egvs("run", mini, "--out", tmp_path)
    assert code == 2
    assert "traffic.kinds: vehicle types 'lorry', 'tram' of fcd.csv have no known size; a kind of each name" in said
    assert "vtypes (known: car)" in said
    head, _, _ = fcd().rpartition(";car;")
    (mini / "fcd.csv").write_text(f"{head};tram;1.7\n")  # at 19.5 s, beyond the frames that are asked for below
    assert run_egvs("run", mini, "--out", tmp_path)[0] == 2
    assert run_egvs("run", mini, "--set", "traffic.frames=36", "--out", tmp_path)[0] == 0


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (["<additional/>"], r"types0\.xml: has no <vType>; a SUMO file"),
        (["<additional><vType/></additional>"], "a <vType> without id; each <vType> once, with an id"),
        ([f"<a>{LORRY}{LORRY}</a>"], "a second <vType> 'lorry'"),
        ([f"<a>{LORRY}</a>"] * 2, r"types1\.xml: a second <vType> 'lorry'"),
        (["<a><vType id='x' vClass='lorry'/></a>"], "vType x: vClass: 'lorry'; a vClass of SUMO"),
        *(([f"<a><vType id='x' height='{height}'/></a>"], f"vType x: height: '{height}'; a length of at least 0.001 m")
          for height in ("tall", "0", "-1", "nan", "inf", "1e-300", "2001", "1_0", "٣")),
        (["<a><vType id='x'></a>"], "is not well-formed XML"),
        (["<a><vType id='x y&gt;'/></a>"], r"types0\.xml: SUMO does not take its types: sumo ended with exit code 1:"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file_of_vtypes_is_said(
    mini: Path, tmp_path: Path, files: list[str], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        egvs.run(egvs.load(mini, vtypes(mini, *files)), tmp_path / "out")


def test_vtypes_act_on_a_finished_file_alone(mini: Path) -> None:
    with pytest.raises(InputError, match=r"vtypes.* have no effect with network"):
        egvs.load(mini, ["traffic.network=n.net.xml", 'traffic.vtypes=["x.xml"]'])


# ---- before anything is made


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("traffic.frames=400", r"frames = 400: fcd\.csv has 40 frames 0\.5 s apart"),
        ("traffic.frame_period_s=0.75", r"frame_period_s = 0\.75: fcd\.csv's time steps are 0\.5 s apart"),
        ("traffic.warmup_s=20", r"warmup_s = 20: fcd\.csv lasts 19\.5 s"),
    ],
)
def test_what_a_file_does_not_hold_is_told_by_the_check(mini: Path, run_egvs, override: str, message: str) -> None:
    code, said, _ = run_egvs("check", unsaid(mini), "--set", override)
    assert code == 2
    assert re.search(message, said)


def test_sizes_are_missed_by_the_check(mini: Path, run_egvs) -> None:
    retyped(mini, "tram", "car", "lorry", "DEFAULT_VEHTYPE")
    code, said, _ = run_egvs("check", mini)
    assert code == 2
    assert "vehicle types 'lorry', 'tram' of fcd.csv have no known size" in said


# ---- on which roads


@pytest.mark.slow
def test_roads_beside_a_file_are_the_networks(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "net.net.xml").write_text(net_xml())
    roads = ["--set", "traffic.roads='net.net.xml'"]
    assert run_egvs("run", mini, "--out", tmp_path / "plain")[0] == 0
    code, _, said = run_egvs("run", mini, "--out", tmp_path / "roads", *roads)
    assert code == 0, said
    ours, its = (egvs.read_trajectories(tmp_path / way / "trajectories.parquet") for way in ("roads", "plain"))
    assert ours.equals(its)
    assert (tmp_path / "roads" / "sumo" / "network.net.xml").read_text() == net_xml()
    named = {way: set(parquet.read_artefact(tmp_path / way / "blindspots.parquet", "blindspots")[0]["by"].to_pylist())
             for way in ("roads", "plain")}  # fmt: skip
    assert "lane" in named["roads"] - named["plain"]
    assert run_egvs("verify", tmp_path / "roads")[0] == 0
    (mini / "net.net.xml").write_text(net_xml().replace("</net>", "<!-- another --></net>"))
    assert "traffic" in run_egvs("run", mini, "--out", tmp_path / "roads", *roads)[1]
    assert "another" in (tmp_path / "roads" / "sumo" / "network.net.xml").read_text()


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (["traffic.roads='no.net.xml'"], "traffic.roads = 'no.net.xml': no such file"),
        (["traffic.roads='fcd.csv'"], "fcd.csv: is not well-formed XML"),
        (["traffic.network='net.net.xml'", "traffic.roads='net.net.xml'"], "roads has no effect with network"),
    ],
)
def test_wrong_roads_are_told(mini: Path, tmp_path: Path, run_egvs, settings: list[str], told: str) -> None:
    (mini / "net.net.xml").write_text(net_xml())
    code, _, said = run_egvs("run", mini, "--out", tmp_path / "run", *(word for s in settings for word in ("--set", s)))
    assert code == 2 and told in said, said


def test_roads_that_lie_where_they_would_be_copied_to_are_refused(mini: Path, run_egvs) -> None:
    (mini / "sumo").mkdir()
    (mini / "sumo" / "mine.net.xml").write_text(net_xml())
    code, _, said = run_egvs("run", mini, "--out", mini, "--set", "traffic.roads='sumo/mine.net.xml'")
    assert code == 2 and "write over sumo/mine.net.xml, which the scenario names (traffic.roads)" in said, said
    assert (mini / "sumo" / "mine.net.xml").is_file()
