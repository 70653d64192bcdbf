"""SUMO reads and writes no file that a user's configuration or demand names, except the checked inputs."""

import gzip
from xml.etree.ElementTree import parse

import pytest

from egvs.core.errors import InputError
from egvs.formats import xml
from egvs.stages import traffic
from egvs.traffic import sumo, user_files
from tests.stage_runner import run_stage
from tests.traffic.helpers import FOREIGN_TEXT, THREE_FRAMES, car, first_lane, scenario, scenario_with_options

SCHEMA = "{http://www.w3.org/2001/XMLSchema}"


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Every option of SUMO and its type, from SUMO's schema."""
    folder = tmp_path_factory.mktemp("schema")
    sumo.run_program("sumo", ["--save-schema", "sumo.xsd"], folder)
    result = {e.get("name"): e.get("type", "") for e in parse(folder / "sumo.xsd").iter(f"{SCHEMA}element")}
    return {name: kind for name, kind in result.items() if kind.endswith("OptionType")}


def test_accepted_options_name_no_file(options):
    named = {name for name, kind in options.items() if kind == "fileOptionType"}
    assert len(named) > 40 and named >= set(user_files.FILE_OPTIONS)
    assert not named & user_files.ACCEPTED_OPTIONS
    assert not [
        name for name in user_files.ACCEPTED_OPTIONS if name.endswith(("file", "files", "output", "path", "prefix"))
    ]


def test_accepted_options_exist_in_sumo(options):
    assert user_files.ACCEPTED_OPTIONS - options.keys() == set()


def read_config(folder, text):
    (folder / "net.xml").touch()
    (folder / "c.sumocfg").write_text(f'<configuration><net-file value="net.xml"/>{text}</configuration>')
    return user_files.read_sumocfg(folder / "c.sumocfg")


def test_each_option_is_accepted_ignored_or_an_error(options, tmp_path):
    refused = set()
    for name in sorted(options.keys() - set(user_files.FILE_OPTIONS)):
        try:
            read_config(tmp_path, f'<{name} value="0"/>')
        except InputError as error:
            assert error.hint.startswith("Remove it")
            refused.add(name)
    assert refused == {
        "load-state", "load-state.offset", "load-state.remove-vehicles", "astar.all-distances",
        "astar.landmark-distances", "device.fcd-replay.probability", "device.fcd-replay.explicit",
        "device.fcd-replay.deterministic", "device.fcd-replay.files", "device.fcd-replay.consistency",
        "pedestrian.jupedsim.step-length", "pedestrian.jupedsim.exit-tolerance", "pedestrian.jupedsim.model",
        "pedestrian.jupedsim.strength-neighbor-repulsion", "pedestrian.jupedsim.range-neighbor-repulsion",
        "pedestrian.jupedsim.strength-geometry-repulsion", "pedestrian.jupedsim.range-geometry-repulsion", "help",
        "version",
    }  # fmt: skip


def test_rejects_unknown_option(tmp_path):
    with pytest.raises(InputError, match=r"c\.sumocfg: colour = 'red': this SUMO option is not supported"):
        read_config(tmp_path, '<colour value="red"/>')


def test_reads_options_that_change_the_traffic(tmp_path):
    taken = read_config(
        tmp_path, '<scale value="2"/><processing><ignore-route-errors v="true"/></processing><b value="7"/>'
    )
    assert (taken.options, taken.begin_s) == ({"scale": "2", "ignore-route-errors": "true"}, 7.0)


@pytest.mark.parametrize("value", ["nan", "-inf", "1e308", "-1", "seven"])
def test_rejects_invalid_begin(value, tmp_path):
    with pytest.raises(InputError, match=f"begin = '{value}': expected 0 to 1e\\+09 seconds"):
        read_config(tmp_path, f'<begin value="{value}"/>')


TEXT = '<?xml version="1.0" encoding="{}"?>\n<!-- note --><routes a="1"><route id="通り" edges="a  b"/></routes>\n'


def read_elements(path):
    return [(e.tag, e.attrib, [c.attrib for c in e]) for e in xml.iter_elements(path, "")]


def test_harmless_file_is_copied_unchanged_and_unzipped(tmp_path):
    data = TEXT.format("UTF-8").encode()
    (tmp_path / "a.xml").write_bytes(data)
    (tmp_path / "b.xml.gz").write_bytes(gzip.compress(data))
    for name in ("a.xml", "b.xml.gz"):
        assert user_files.copy_checked(tmp_path / name, tmp_path / "copy.xml") == []
        assert (tmp_path / "copy.xml").read_bytes() == data


@pytest.mark.parametrize("encoding", ["UTF-16", "iso-8859-1", "windows-1252"])
def test_other_encodings_are_converted_to_utf8(tmp_path, encoding):
    data = TEXT.format(encoding).replace("通り", "é").encode(encoding)
    (tmp_path / "a.xml").write_bytes(data)
    user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml")
    assert (tmp_path / "copy.xml").read_bytes().decode() == '<routes a="1">\n<route id="é" edges="a  b" /></routes>\n'


def test_rewritten_file_differs_only_in_outputs(tmp_path):
    text = (
        '<additional v="&lt;&quot;"><a x="1&amp;&#10;2"><b file="f"/><b/></a><c>t</c>'
        '<param key="x.file" value="f"/></additional>'
    )
    (tmp_path / "a.xml").write_text(text)
    assert user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml") == [
        "a.xml: outputs of SUMO are disabled: 1 of <b>, 1 of <param>"
    ]
    assert read_elements(tmp_path / "copy.xml") == [
        ("a", {"x": "1&\n2"}, [{"file": "NUL"}, {}]),
        ("c", {}, []),
        ("param", {"key": "x.file", "value": "NUL"}, []),
    ]
    assert parse(tmp_path / "copy.xml").getroot().attrib == {"v": '<"'}


def test_safe_name_replaces_separators_and_variables():
    assert user_files.safe_name("a,b;${HOME}.rou.xml") == "a_b__{HOME}.rou.xml"


FURTHER = {
    "signs": '<variableSpeedSign id="v" lanes="a_0" file="speeds.xml"/>',
    "rerouters": '<rerouter id="r" edges="a" file="r.xml"/>',
    "inclusions": '<include href="more.xml"/>',
    "zones": '<taz id="t"/><tazRelation edgesFile="e.txt"/>',
    "signs within": '<parkingArea id="p"><variableSpeedSign id="v" file="speeds.xml"/></parkingArea>',
}


@pytest.mark.parametrize("text", FURTHER.values(), ids=FURTHER.keys())
def test_rejects_elements_that_read_further_files(tmp_path, text):
    (tmp_path / "a.xml").write_text(f"<additional>{text}</additional>")
    with pytest.raises(InputError, match=r"makes SUMO read another file"):
        user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml")
    assert not (tmp_path / "copy.xml").exists()
    (tmp_path / "a.xml").write_text(
        '<additional><variableSpeedSign id="v"><step time="0" speed="9"/></variableSpeedSign></additional>'
    )
    assert user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml") == []


def test_checked_file_is_parsed_again_only_if_it_changed(tmp_path, monkeypatch):
    path = tmp_path / "a.xml"
    path.write_text('<routes><a x="1"/></routes>')
    user_files.check_copyable(path)
    with monkeypatch.context() as patch:
        patch.setattr(user_files, "_checked_elements", None)
        assert user_files.copy_checked(path, tmp_path / "copy.xml") == []
    path.write_text('<routes><include href="f"/></routes>')
    with pytest.raises(InputError, match="makes SUMO read another file"):
        user_files.check_copyable(path)


OPTIONS = (
    "netstate-dump", "netstate", "ndump", "tripinfo", "tripinfo-output", "vehroutes", "vehroute-output", "l", "log",
    "C", "save-configuration", "device.ssm.file", "device.toc.file", "save-template", "fcd-output", "summary",
    "pedestrian.jupedsim.wkt", "pedestrian.jupedsim.py", "device.rerouting.output",
)  # fmt: skip


ADDITIONAL = {
    "e1": '<e1Detector id="d" lane="{lane}" pos="1" period="1" file="{file}"/>',
    "inductionLoop": '<inductionLoop id="d" lane="{lane}" pos="1" freq="1" file="{file}"/>',
    "instant": '<instantInductionLoop id="d" lane="{lane}" pos="1" file="{file}"/>',
    "e2": '<e2Detector id="d" lane="{lane}" pos="1" length="2" period="1" file="{file}"/>',
    "e3": '<e3Detector id="d" period="1" file="{file}"><detEntry lane="{lane}" pos="1"/>'
    '<detExit lane="{lane}" pos="9"/></e3Detector>',
    "edgeData": '<edgeData id="d" file="{file}"/>',
    "laneData": '<laneData id="d" file="{file}"/>',
    "vTypeProbe": '<vTypeProbe id="d" freq="1" file="{file}"/>',
    "routeProbe": '<routeProbe id="d" edge="{edge}" freq="1" file="{file}"/>',
    "calibrator": '<calibrator id="d" edge="{edge}" pos="0" output="{file}"/>',
    "signals": '<timedEvent type="SaveTLSStates" source="{signal}" dest="{file}"/>',
    "ssm of a type": '<vType id="t"><param key="has.ssm.device" value="true"/>'
    '<param key="device.ssm.file" value="{file}"/></vType>',
}


_ENTITIES = "".join(f'<!ENTITY {c} "{f"&{b};" * 10}">' for b, c in zip("abcdefghi", "bcdefghij", strict=True))


BOMB = f'<!DOCTYPE routes [<!ENTITY a "{"0123456789" * 5}">{_ENTITIES}]><routes><vType id="&j;"/></routes>'


@pytest.mark.slow
def test_options_of_a_configuration_write_no_file(demand_folder, tmp_path):
    foreign = tmp_path / "foreign.txt"
    options = "".join(f'<{key} value="{foreign}"/>' for key in OPTIONS)
    run_stage(traffic, scenario_with_options(demand_folder, options), tmp_path / "out")
    assert foreign.read_text() == FOREIGN_TEXT


@pytest.mark.slow
@pytest.mark.parametrize("written", ["abroad", "artefact", "own folder"])
def test_outputs_of_an_additional_file_are_not_written(demand_folder, town, tmp_path, written):
    foreign = tmp_path / "foreign.txt"
    out = tmp_path / "out"
    out.mkdir()
    statics = out / "statics.ply"
    statics.write_text(FOREIGN_TEXT)
    file = {"abroad": foreign, "artefact": "../statics.ply", "own folder": "output/det.xml"}[written]
    edge, lane, signal = first_lane(town / "net.xml")
    all_of_them = "".join(xml.format(lane=lane, edge=edge, signal=signal, file=file) for xml in ADDITIONAL.values())
    for number in range(len(ADDITIONAL)):
        all_of_them = all_of_them.replace('id="d"', f'id="d{number}"', 1)
    result = run_stage(
        traffic, scenario_with_options(demand_folder, additional=f"<additional>{all_of_them}</additional>"), out
    )
    assert (foreign.read_text(), statics.read_text()) == (FOREIGN_TEXT, FOREIGN_TEXT)
    assert not (out / "sumo" / "output").exists()
    (note,) = result["notes"]
    assert note == (
        "own.add.xml: outputs of SUMO are disabled: 1 of <calibrator>, 1 of <e1Detector>, "
        "1 of <e2Detector>, 1 of <e3Detector>, 1 of <edgeData>, 1 of <inductionLoop>, 1 of <instantInductionLoop>, "
        "1 of <laneData>, 1 of <param>, 1 of <routeProbe>, 1 of <timedEvent>, 1 of <vTypeProbe>"
    )


@pytest.mark.slow
def test_outputs_of_a_route_file_are_not_written(demand_folder, tmp_path):
    foreign = tmp_path / "foreign.txt"
    param = f'<param key="has.ssm.device" value="true"/><param key="device.ssm.file" value="{foreign}"/>'
    text = (demand_folder / "own.rou.xml").read_text()
    (demand_folder / "own.rou.xml").write_text(text.replace("</vehicle>", f"{param}</vehicle>"))
    run_stage(
        traffic, scenario(demand_folder, network="net.xml", routes=["own.rou.xml"], **THREE_FRAMES), tmp_path / "out"
    )
    assert foreign.read_text() == FOREIGN_TEXT


@pytest.mark.slow
def test_outputs_of_a_network_are_not_written(demand_folder, tmp_path):
    foreign = tmp_path / "foreign.txt"
    text = (demand_folder / "net.xml").read_text()
    signal = text.index("<tlLogic")
    after = text.index(">", signal) + 1
    head = text[signal:after].replace('type="static"', 'type="actuated"')
    param = f'<param key="file" value="{foreign}"/><param key="freq" value="1"/>'
    (demand_folder / "net.xml").write_text(text[:signal] + head + param + text[after:])
    run_stage(traffic, scenario_with_options(demand_folder), tmp_path / "out")
    assert foreign.read_text() == FOREIGN_TEXT


def test_rejects_markup_in_attribute_name_of_a_kind(demand_folder, tmp_path):
    foreign = tmp_path / "foreign.txt"
    attributes = {f'x="1"/><edgeData id="d" file="{foreign}" y': 1}
    with pytest.raises(InputError, match=r"attributes.*expected a name of letters and digits"):
        scenario(
            demand_folder, network="net.xml", kinds=[{**car().model_dump(), "attributes": attributes}], **THREE_FRAMES
        )
    assert foreign.read_text() == FOREIGN_TEXT


@pytest.mark.parametrize("which", ["own.rou.xml", "own.add.xml", "net.xml"])
def test_rejects_entities_in_demand_files(demand_folder, tmp_path, which):
    scene = scenario_with_options(demand_folder)
    (demand_folder / which).write_text(BOMB)
    message = rf"{which}: declares XML entities or a document type, which are not allowed"
    with pytest.raises(InputError, match=message):
        run_stage(traffic, scene, tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()


def test_rejects_map_that_a_configuration_names(demand_folder, tmp_path):
    scene = scenario_with_options(demand_folder)
    (demand_folder / "net.xml").write_text("<osm/>")
    with pytest.raises(InputError, match=r"net\.xml: expected a SUMO network, got a map"):
        run_stage(traffic, scene, tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<!DOCTYPE additional SYSTEM "more.dtd"><additional/>', "declares XML entities or a document type"),
        (
            '<additional><include href="/etc/passwd"/></additional>',
            "<include href='/etc/passwd'> makes SUMO read",
        ),
        (
            '<additional><rerouter edges="e" file="x.xml"/></additional>',
            r"<rerouter file='x\.xml'> makes SUMO read",
        ),
        (
            '<additional><edgeData id="d" edgesFile="x"/></additional>',
            "<edgeData edgesFile='x'> makes SUMO read",
        ),
        ('<edgeData id="d" file="/x"/>', r"its root <edgeData file=\.\.\.> has an output attribute"),
        ('<a:additional xmlns:a="b"><a:edgeData file="/x"/></a:additional>', "<{b}additional> is in a namespace"),
        ("<additional><edgeData", "is not well-formed XML"),
    ],
)
def test_rejects_additional_file_that_reads_further_files(demand_folder, tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        run_stage(traffic, scenario_with_options(demand_folder, additional=text), tmp_path / "out")
