"""What the check says of traffic that a user gives: a demand without vehicles, weights that no mix can have."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.test_checking import found

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
        ("<routes/>", '<additional><include href="more.xml"/></additional>', False),
        ("<routes", "", False),  # what SUMO tells better
    ],
)
def test_a_configuration_without_vehicles_is_told_before_it_is_simulated(
    street: Path, routes: str, additional: str, is_found: bool
) -> None:
    (street / "more.add.xml").write_text(additional)
    configured(street, routes, additional="more.add.xml" if additional else "")
    simulated(street, 'sumocfg = "own.sumocfg"\n')
    files = "own.rou.xml, more.add.xml" if additional else "own.rou.xml"
    right = f"scenario.toml: traffic.sumocfg = 'own.sumocfg': no vehicle, trip or flow in its files ({files})"
    assert found(street).get("traffic", []) == ([right] if is_found else [])


def test_routes_of_a_period_without_vehicles_are_told_with_its_name(street: Path, egvs) -> None:
    configured(street, DEMAND, name="day")
    configured(street, "<routes/>", name="night")
    simulated(street, 'network = "net.net.xml"\n')
    periods = 'traffic.periods=[{name="day",routes=["day.rou.xml"]},{name="night",routes=["night.rou.xml"]}]'
    assert found(street, periods)["traffic"] == [
        "scenario.toml: traffic.periods (night).routes = ['night.rou.xml']: "
        "no vehicle, trip or flow in its files (night.rou.xml)"
    ]
    code, _, said = egvs("run", street, "--set", periods, "--out", street / "out")
    assert (code, "traffic.periods (night).routes" in said) == (2, True)
    assert not list((street / "out").glob("*.p*"))


def test_an_effect_may_bring_the_traffic(street: Path) -> None:
    configured(street, "<routes/>")
    simulated(street, 'sumocfg = "own.sumocfg"\n')
    assert "traffic" not in found(street, "effects.pedestrians_bicycles={bicycles_per_h=100}")


@pytest.mark.parametrize("lasts", ["length_s=10", ""])
def test_weights_that_no_mix_can_have_are_told_before_the_first_stage(mini: Path, lasts: str) -> None:
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
    assert told.endswith(" frames make a mix of more than 4,294,967,295 frames")
    assert len(told) < 150
    assert (
        found(mini, f"traffic.periods=[{','.join(of).replace('1e-300', '3').replace('1e+300', '1')}]", "tpog.blocks=2")
        == {}
    )
