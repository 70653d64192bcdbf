"""Does a scenario that tries to make SUMO write or read foreign files fail to?"""

import pytest

from egvs.core.errors import InputError
from egvs.stages import traffic
from tests.stages import run_stage
from tests.traffic.guarded.lanes import KEPT, SHORT, configured, first_lane
from tests.traffic.helpers import car, scenario

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


def test_no_option_of_a_configuration_makes_sumo_write(place, tmp_path):
    foreign = tmp_path / "foreign.txt"
    options = "".join(f'<{key} value="{foreign}"/>' for key in OPTIONS)
    run_stage(traffic, configured(place, options), tmp_path / "out")
    assert foreign.read_text() == KEPT


@pytest.mark.parametrize("written", ["abroad", "artefact", "own folder"])
def test_no_output_of_an_additional_file_is_written(place, town, tmp_path, written):
    foreign = tmp_path / "foreign.txt"
    out = tmp_path / "out"
    out.mkdir()
    statics = out / "statics.ply"
    statics.write_text(KEPT)
    file = {"abroad": foreign, "artefact": "../statics.ply", "own folder": "output/det.xml"}[written]
    edge, lane, signal = first_lane(town / "net.xml")
    all_of_them = "".join(xml.format(lane=lane, edge=edge, signal=signal, file=file) for xml in ADDITIONAL.values())
    for number in range(len(ADDITIONAL)):
        all_of_them = all_of_them.replace('id="d"', f'id="d{number}"', 1)
    result = run_stage(traffic, configured(place, additional=f"<additional>{all_of_them}</additional>"), out)
    assert (foreign.read_text(), statics.read_text()) == (KEPT, KEPT)
    assert not (out / "sumo" / "output").exists()
    (note,) = result["notes"]
    assert note == (
        "own.add.xml: SUMO's outputs that it asks for are not written: 1 of <calibrator>, 1 of <e1Detector>, "
        "1 of <e2Detector>, 1 of <e3Detector>, 1 of <edgeData>, 1 of <inductionLoop>, 1 of <instantInductionLoop>, "
        "1 of <laneData>, 1 of <param>, 1 of <routeProbe>, 1 of <timedEvent>, 1 of <vTypeProbe>"
    )


def test_a_route_files_outputs_are_not_written(place, tmp_path):
    foreign = tmp_path / "foreign.txt"
    param = f'<param key="has.ssm.device" value="true"/><param key="device.ssm.file" value="{foreign}"/>'
    text = (place / "own.rou.xml").read_text()
    (place / "own.rou.xml").write_text(text.replace("</vehicle>", f"{param}</vehicle>"))
    run_stage(traffic, scenario(place, network="net.xml", routes=["own.rou.xml"], **SHORT), tmp_path / "out")
    assert foreign.read_text() == KEPT


def test_a_networks_outputs_are_not_written(place, tmp_path):
    foreign = tmp_path / "foreign.txt"
    text = (place / "net.xml").read_text()
    signal = text.index("<tlLogic")
    after = text.index(">", signal) + 1
    head = text[signal:after].replace('type="static"', 'type="actuated"')
    param = f'<param key="file" value="{foreign}"/><param key="freq" value="1"/>'
    (place / "net.xml").write_text(text[:signal] + head + param + text[after:])
    run_stage(traffic, configured(place), tmp_path / "out")
    assert foreign.read_text() == KEPT


def test_the_name_of_a_kinds_attribute_writes_no_element(place, tmp_path):
    foreign = tmp_path / "foreign.txt"
    attributes = {f'x="1"/><edgeData id="d" file="{foreign}" y': 1}
    with pytest.raises(InputError, match=r"attributes.*expected a name of letters and digits"):
        scenario(place, network="net.xml", kinds=[{**car().model_dump(), "attributes": attributes}], **SHORT)
    assert foreign.read_text() == KEPT


@pytest.mark.parametrize("which", ["own.rou.xml", "own.add.xml", "net.xml"])
def test_entities_never_reach_sumo(place, tmp_path, which):
    scene = configured(place)
    (place / which).write_text(BOMB)
    message = rf"{which}: declares XML entities or a document type, which are refused"
    with pytest.raises(InputError, match=message):
        run_stage(traffic, scene, tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()


def test_entities_of_a_map_never_reach_netconvert(place, tmp_path):
    (place / "map.osm").write_text(BOMB.replace("routes", "osm"))
    with pytest.raises(InputError, match=r"map\.osm: declares XML entities"):
        run_stage(traffic, scenario(place, network="map.osm", **SHORT), tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<!DOCTYPE additional SYSTEM "more.dtd"><additional/>', "declares XML entities or a document type"),
        (
            '<additional><include href="/etc/passwd"/></additional>',
            "<include href='/etc/passwd'> has SUMO read",
        ),
        (
            '<additional><rerouter edges="e" file="x.xml"/></additional>',
            r"<rerouter file='x\.xml'> has SUMO read",
        ),
        (
            '<additional><edgeData id="d" edgesFile="x"/></additional>',
            "<edgeData edgesFile='x'> has SUMO read",
        ),
        ('<edgeData id="d" file="/x"/>', r"its root <edgeData file=\.\.\.> asks for an output"),
        ('<a:additional xmlns:a="b"><a:edgeData file="/x"/></a:additional>', "<{b}additional> is in a namespace"),
        ("<additional><edgeData", "is not well-formed XML"),
    ],
)
def test_what_has_sumo_read_further_files_is_refused(place, tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        run_stage(traffic, configured(place, additional=text), tmp_path / "out")
