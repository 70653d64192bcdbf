"""Small OpenDRIVE maps, made up by hand so that lengths, turns and heights are known."""

from __future__ import annotations

from collections.abc import Sequence

UTM = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"

LINE = "<line/>"


def geometry(x: float, y: float, hdg: float, length: float, shape: str = LINE, s: float = 0.0) -> str:
    """One element of a reference line."""
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'


def lane(number: int, kind: str = "driving", width: str = "3.5 0 0 0", link: str = "") -> str:
    """A lane; ``link`` like ``predecessor -1, successor -2``, ``width`` the coefficients a b c d."""
    a, b, c, d = width.split()
    links = "".join(f'<{end} id="{at}"/>' for end, at in (part.split() for part in link.split(",") if part))
    return (
        f'<lane id="{number}" type="{kind}" level="false"><link>{links}</link>'
        f'<width sOffset="0" a="{a}" b="{b}" c="{c}" d="{d}"/></lane>'
    )


def section(right: Sequence[str], left: Sequence[str] = (), s: float = 0.0) -> str:
    """A lane section, its lanes from the left to the right."""
    sides = f"<left>{''.join(left)}</left>" if left else ""
    return (
        f'<laneSection s="{s}">{sides}<center><lane id="0" type="none" level="false"/></center>'
        f"<right>{''.join(right)}</right></laneSection>"
    )


def road(number: str, length: float, plan: str, sections: str, link: str = "", **parts: str) -> str:
    """A road; ``link`` like ``predecessor road 3 end, successor junction 9``.

    ``parts``: junction, rule, and the content of elevation, lateral and signals.
    """
    links = ""
    for part in (part.split() for part in link.split(",") if part):
        contact = f' contactPoint="{part[3]}"' if len(part) > 3 else ""
        links += f'<{part[0]} elementType="{part[1]}" elementId="{part[2]}"{contact}/>'
    rules = f' rule="{parts["rule"]}"' if "rule" in parts else ""
    return (
        f'<road name="" length="{length}" id="{number}" junction="{parts.get("junction", "-1")}"{rules}><link>{links}</link>'
        f'<type s="0" type="town"><speed max="50" unit="km/h"/></type>'
        f"<planView>{plan}</planView><elevationProfile>{parts.get('elevation', '')}</elevationProfile>"
        f"<lateralProfile>{parts.get('lateral', '')}</lateralProfile><lanes>{sections}</lanes><signals>{parts.get('signals', '')}</signals></road>"
    )


def junction(number: str, *connections: tuple[str, str, str, str]) -> str:
    """A junction of (incoming road, connecting road, contact point, ``from:to from:to``)."""
    text = ""
    for index, (incoming, connecting, contact, links) in enumerate(connections):
        pairs = "".join('<laneLink from="{}" to="{}"/>'.format(*pair.split(":")) for pair in links.split())
        text += (
            f'<connection id="{index}" incomingRoad="{incoming}" connectingRoad="{connecting}"'
            f' contactPoint="{contact}">{pairs}</connection>'
        )
    return f'<junction id="{number}" name="">{text}</junction>'


def opendrive(*parts: str, reference: str = UTM, offset: str = "") -> str:
    """A map of roads and junctions."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<OpenDRIVE><header revMajor="1" revMinor="6" name="" version="1">'
        f"<geoReference><![CDATA[{reference}]]></geoReference>{offset}</header>{''.join(parts)}</OpenDRIVE>\n"
    )


def two_lanes(length: float = 100.0) -> list[str]:
    """One lane each way along x, from (0, 0) to (100, 0), continued by the next road to (200, 0)."""
    both = section([lane(-1, link="successor -1")], [lane(1, link="successor 1")])
    back = section([lane(-1, link="predecessor -1")], [lane(1, link="predecessor 1")])
    return [
        road("1", length, geometry(0, 0, 0, length), both, "successor road 2 start"),
        road("2", length, geometry(length, 0, 0, length), back, "predecessor road 1 end"),
    ]


def merge() -> str:
    """Lanes -1 and -2 of road 1, 100 m along x, both lead to lane -1 of road 2 through the junction 9."""
    first = section([lane(-1), lane(-2)])
    through = section([lane(-1, link="predecessor -1, successor -1")])
    right = section([lane(-1, link="predecessor -2, successor -1")])
    after = section([lane(-1)])
    bend = '<poly3 a="0" b="0" c="0.02625" d="-0.000875"/>'  # 3.5 m to the left over 20 m, level at both ends
    return opendrive(
        road("1", 100, geometry(0, 0, 0, 100), first, "successor junction 9"),
        road("2", 100, geometry(120, 0, 0, 100), after, "predecessor junction 9"),
        road("5", 20, geometry(100, 0, 0, 20), through, "predecessor road 1 end, successor road 2 start", junction="9"),
        road("6", 20.3, geometry(100, 0, 0, 20.3, bend), right, "predecessor road 1 end, successor road 2 start",
             junction="9"),
        junction("9", ("1", "5", "start", "-1:-1"), ("1", "6", "start", "-2:-1")),
    )  # fmt: skip
