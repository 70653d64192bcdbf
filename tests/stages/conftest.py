"""A street of two lanes and two sidewalks along the x axis, under the scenario that all tests share."""

from __future__ import annotations

from pathlib import Path

import pytest

LANES = """\
  <edge id="east" from="a" to="b">
    <lane id="east_0" index="0" allow="pedestrian" length="120" width="2.00" shape="-40,-4.20 80,-4.20"/>
    <lane id="east_1" index="1" disallow="pedestrian" length="120" shape="-40,-1.60 80,-1.60"/>
  </edge>
  <edge id="west" from="b" to="a">
    <lane id="west_0" index="0" allow="bicycle" length="120" width="2.00" shape="80,4.20 -40,4.20"/>
    <lane id="west_1" index="1" disallow="pedestrian" length="120" shape="80,1.60 -40,1.60"/>
  </edge>
"""


def net_xml(lanes: str = LANES) -> str:
    """A network as netconvert writes it; lanes are 3.2 m wide where they name no width."""
    return f'<net version="1.20">\n  <location netOffset="0.00,0.00" projParameter="!"/>\n{lanes}</net>\n'


@pytest.fixture
def street(mini: Path) -> Path:
    """The folder of :func:`mini`, with the street instead of its finished FCD file."""
    (mini / "net.net.xml").write_text(net_xml())
    text = (mini / "scenario.toml").read_text()
    assert 'fcd = "fcd.csv"\n' in text
    (mini / "scenario.toml").write_text(text.replace('fcd = "fcd.csv"\n', 'network = "net.net.xml"\n'))
    return mini
