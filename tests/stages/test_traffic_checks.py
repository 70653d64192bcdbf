"""What the check says of traffic that a user gives: a demand without vehicles, weights that no mix can have."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from egvs.scenario.loading import load
from egvs.scoring import occupancy
from egvs.stages import check
from tests.stages.conftest import net_xml
from tests.stages.test_check import found

DEMAND = '<routes><vType id="a"/><vehicle id="v" depart="0"><route edges="east"/></vehicle></routes>'


def configured(street: Path, routes: str, *others: str, name: str = "own", additional: str = "") -> None:
    """A configuration of SUMO with these route files, the first of them written."""
    (street / f"{name}.rou.xml").write_text(routes)
    named = ",".join([f"{name}.rou.xml", *others])
    more = f'<additional-files value="{additional}"/>' if additional else ""
    text = f'<input><net-file value="net.net.xml"/><route-files value="{named}"/>{more}</input>'
    (street / f"{name}.sumocfg").write_text(f"<configuration>{text}</configuration>")


def simulated(street: Path, source: str) -> None:
    """The street with another source of traffic."""
    text = (street / "scenario.toml").read_text()
    kinds = text.index("[[traffic.kinds]]")
    rest = text.find("\n[", kinds + 3)
    text = text[:kinds] + text[rest + 1 :]
    assert 'network = "net.net.xml"\n' in text
    (street / "scenario.toml").write_text(text.replace('network = "net.net.xml"\n', source))


@pytest.mark.parametrize(
    ("routes", "additional", "is_found"),
    [
        ('<routes><vType id="a"/><route id="r" edges="east"/></routes>', "", True),
        ('<routes><person id="p" depart="0"/></routes>', "<additional><poly/></additional>", True),
        (DEMAND, "", False),
        ('<routes><flow id="f" begin="0"/></routes>', "", False),
        ("<routes/>", '<additional><calibrator><flow begin="0"/></calibrator></additional>', False),
    ],
)
def test_rejects_configuration_without_vehicles(street: Path, routes: str, additional: str, is_found: bool) -> None:
    (street / "more.add.xml").write_text(additional)
    configured(street, routes, additional="more.add.xml" if additional else "")
    simulated(street, 'sumocfg = "own.sumocfg"\n')
    files = "own.rou.xml, more.add.xml" if additional else "own.rou.xml"
    right = f"scenario.toml: traffic.sumocfg = 'own.sumocfg': no vehicle, trip or flow in its files ({files})"
    assert found(street).get("traffic", []) == ([right] if is_found else [])


@pytest.mark.parametrize(
    ("routes", "additional", "told"),
    [
        (
            "<routes/>",
            '<additional><include href="more.xml"/></additional>',
            "more.add.xml: <include href='more.xml'> makes SUMO read another file",
        ),
        ("<routes", "", "own.rou.xml: is not well-formed XML: unclosed token: line 1, column 0"),
        (
            '<!DOCTYPE routes [<!ENTITY a "b">]><routes><vehicle id="&a;" depart="0"/></routes>',
            "",
            "own.rou.xml: declares XML entities or a document type, which are not allowed",
        ),
    ],
)
def test_rejects_files_that_sumo_may_not_read(street: Path, routes: str, additional: str, told: str) -> None:
    (street / "more.add.xml").write_text(additional)
    configured(street, routes, additional="more.add.xml" if additional else "")
    simulated(street, 'sumocfg = "own.sumocfg"\n')
    assert found(street).get("traffic", []) == [told]


OTHER = '<location netOffset="30.00,0.00" projParameter="!"/>'
"""Of a file that was made for another network than the street, whose offset is 0,0."""

OTHER_PROBLEM = "its <location> states netOffset 30,0, but that of the network net.net.xml netOffset 0,0"


def test_rejects_additional_file_of_other_network(street: Path) -> None:
    (street / "more.add.xml").write_text(f"<additional>{OTHER}</additional>")
    configured(street, DEMAND, additional="more.add.xml")
    simulated(street, 'sumocfg = "own.sumocfg"\n')
    assert found(street)["traffic"] == [f"more.add.xml: {OTHER_PROBLEM}"]
    (street / "more.add.xml").write_text(f"<additional>{OTHER.replace('30', '0')}</additional>")
    assert "traffic" not in found(street)


def test_rejects_polygons_of_other_network(street: Path) -> None:
    shape = '<poly id="a" type="building" fill="1" shape="30,20 34,20 34,24 30,24"/>'
    (street / "a.poly.xml").write_text(f"<additional>{OTHER}{shape}</additional>")
    told = found(street, 'statics.polygons=["a.poly.xml"]')
    assert told["statics"] == [f"a.poly.xml: {OTHER_PROBLEM}"]


def test_rejects_polygons_of_two_networks(mini: Path) -> None:
    """Without a network, the files are compared with each other."""
    shape = '<poly id="a" type="building" fill="1" shape="30,20 34,20 34,24 30,24"/>'
    for name, offset in (("a", "0"), ("b", "30")):
        (mini / f"{name}.poly.xml").write_text(f"<additional>{OTHER.replace('30', offset)}{shape}</additional>")
    told = found(mini, 'statics.polygons=["a.poly.xml", "b.poly.xml"]')
    assert told["statics"] == ["b.poly.xml: its <location> states netOffset 30,0, but that of a.poly.xml netOffset 0,0"]


def test_rejects_fcd_of_other_network(street: Path) -> None:
    rows = "".join(
        f'<timestep time="{second / 2}"><vehicle id="a" x="{second}" y="-1.6" angle="90" type="car"/></timestep>'
        for second in range(200)
    )
    text = (street / "scenario.toml").read_text()
    text = text.replace('network = "net.net.xml"\n', 'roads = "net.net.xml"\nfcd = "own.xml"\n')
    (street / "scenario.toml").write_text(text)
    (street / "own.xml").write_text(f"<fcd-export>{OTHER}{rows}</fcd-export>")
    assert found(street)["traffic"] == [f"own.xml: {OTHER_PROBLEM}"]
    (street / "own.xml").write_text(f"<fcd-export>{rows}</fcd-export>")
    assert "traffic" not in found(street)


def test_rejects_period_routes_without_vehicles(street: Path, run_egvs) -> None:
    configured(street, DEMAND, name="day")
    configured(street, "<routes/>", name="night")
    simulated(street, 'network = "net.net.xml"\n')
    periods = 'traffic.periods=[{name="day",routes=["day.rou.xml"]},{name="night",routes=["night.rou.xml"]}]'
    assert found(street, periods)["traffic"] == [
        "scenario.toml: traffic.periods (night).routes = ['night.rou.xml']: "
        "no vehicle, trip or flow in its files (night.rou.xml)"
    ]
    code, _, said = run_egvs("run", street, "--set", periods, "--out", street / "out")
    assert (code, "traffic.periods (night).routes" in said) == (2, True)
    assert not list((street / "out").glob("*.p*"))


def test_effect_may_add_all_traffic(street: Path) -> None:
    configured(street, "<routes/>")
    simulated(street, 'sumocfg = "own.sumocfg"\n')
    assert "traffic" not in found(street, "effects.pedestrians_bicycles={bicycles_per_h=100}")


@pytest.mark.parametrize("lasts", ["length_s=10", ""])
def test_rejects_weights_of_too_large_mix(mini: Path, lasts: str) -> None:
    """Also where a finished file alone says how many frames there are; the message stays short."""
    of = [
        f'{{name="{name}",weight={weight}{f",{lasts}" * bool(lasts)}}}'
        for name, weight in (("a", 1e-300), ("b", 1e300))
    ]
    scenario = mini / "scenario.toml"
    if not lasts:
        scenario.write_text(scenario.read_text().replace("frames = 40\n", ""))
    (told,) = found(mini, f"traffic.periods=[{','.join(of)}]", "tpog.blocks=2")["traffic"]
    assert told.startswith("scenario.toml: traffic.periods: weights 1e-300, 1e+300 of ")
    assert told.endswith(" frames need a mix of more than 4,294,967,295 frames")
    assert len(told) < 150
    assert (
        found(mini, f"traffic.periods=[{','.join(of).replace('1e-300', '3').replace('1e+300', '1')}]", "tpog.blocks=2")
        == {}
    )


def moved(net: str, east_m: float) -> str:
    """A network with all its lanes moved to the east."""

    def there(shape: re.Match[str]) -> str:
        pairs = (point.split(",") for point in shape[1].split())
        return 'shape="' + " ".join(f"{float(x) + east_m:.2f},{y}" for x, y in pairs) + '"'

    return re.sub(r'shape="([^"]*)"', there, net)


UTM = "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"
MAPPED = net_xml().replace('projParameter="!"', f'projParameter="{UTM}"').replace("0.00,0.00", "-500000.00,-5600000.00")


@pytest.mark.parametrize(
    ("first", "other", "told"),
    [
        # the region ends at x = 40, the lanes begin at -40
        (
            net_xml(),
            moved(net_xml(), 3000),
            "no lane of its network passes through the region: the nearest is 2,920.0 m away",
        ),
        (
            MAPPED,
            MAPPED.replace("-500000", "-500009"),
            "its network has another origin or projection than that of the first period"
            " (netOffset -500009,-5600000 instead of netOffset -500000,-5600000)",
        ),
        (net_xml(), net_xml().replace("80,", "90,"), None),
        (
            net_xml(),
            net_xml().replace("0.00,0.00", "9.00,0.00"),
            "its network has another origin or projection than that of the first period"
            " (netOffset 9,0 instead of netOffset 0,0)",
        ),
    ],
)
def test_rejects_period_network_elsewhere(street: Path, first: str, other: str, told: str | None) -> None:
    (street / "net.net.xml").write_text(first)
    (street / "other.net.xml").write_text(other)
    for name in ("day", "night"):
        configured(street, DEMAND, name=name)
    night = (street / "night.sumocfg").read_text().replace("net.net.xml", "other.net.xml")
    (street / "night.sumocfg").write_text(night)
    periods = "\n".join(f'[[traffic.periods]]\nname = "{n}"\nsumocfg = "{n}.sumocfg"\n' for n in ("day", "night"))
    simulated(street, "")
    text = (street / "scenario.toml").read_text()
    (street / "scenario.toml").write_text(f"{text}\n{periods}")
    place = "scenario.toml: traffic.periods (night): "
    assert found(street).get("region", []) == ([] if told is None else [place + told])


def test_warns_of_period_without_traffic() -> None:
    (told,) = occupancy.warn_empty_periods({"day": 3.0, "night": 0.0})
    assert told.where == "scenario.toml: traffic.periods (night)"
    assert "no vehicle ever enters the region" in told.problem
    assert list(occupancy.warn_empty_periods({"day": 0.0, "night": 0.0})) == []  # told of all of them at once
    assert list(occupancy.warn_empty_periods({"": 0.0})) == []


def recorded(street: Path, change: Callable[[float, float, float], tuple[float, float, float]]) -> Path:
    """The street with a finished file of two cars, one each way; ``change`` is applied to x, y and angle."""
    rows = ["time;id;x;y;angle;type"]
    for step in range(40):
        for name, x, y, angle in (("east", 2.0 * step - 20.0, -1.6, 90.0), ("west", 60.0 - 2.0 * step, 1.6, 270.0)):
            rows.append(";".join([f"{0.5 * step}", name, *(f"{value:.6f}" for value in change(x, y, angle)), "car"]))
    (street / "recorded.csv").write_text("\n".join(rows))
    text = (street / "scenario.toml").read_text()
    network = 'network = "net.net.xml"\n'
    assert network in text
    (street / "scenario.toml").write_text(text.replace(network, 'fcd = "recorded.csv"\nroads = "net.net.xml"\n'))
    return street


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (lambda x, y, angle: (x, y, angle), None),
        (lambda x, y, angle: (x, y - 7.0, angle), "vehicles off their lanes"),
        (lambda x, y, angle: (x, -y, angle), "vehicles against lanes"),
        (lambda x, y, angle: (x, y, math.radians(angle)), "headings"),
        (lambda x, y, angle: (x, y, 90.0 - angle), "headings"),
    ],
)
def test_rejects_vehicles_that_fit_no_road(
    street: Path, run_egvs, change: Callable[[float, float, float], tuple[float, float, float]], rule: str | None
) -> None:
    """The run stops before anything is written."""
    checked = check.check_scenario(load(recorded(street, change)))
    assert [error.rule for error in checked.errors] == ([] if rule is None else [rule])
    if rule is not None:
        code, _, err = run_egvs("run", street, "--out", street / "out")
        assert (code, checked.errors[0].problem in " ".join(err.split())) == (2, True)
        assert not list((street / "out").glob("*.p*"))
