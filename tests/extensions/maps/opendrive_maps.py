"""Small OpenDRIVE maps, made up by hand so that lengths, turns and heights are known."""

from __future__ import annotations

import math
from collections.abc import Sequence

UTM = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"

LINE = "<line/>"


def geometry(x: float, y: float, hdg: float, length: float, shape: str = LINE, s: float = 0.0) -> str:
    """One element of a reference line."""
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'


def lane(number: int, kind: str = "driving", width: str = "3.5 0 0 0", link: str = "", marks: str = "") -> str:
    """A lane; ``link`` like ``predecessor -1, successor -2``, ``width`` the coefficients a b c d."""
    a, b, c, d = width.split()
    links = "".join(f'<{end} id="{at}"/>' for end, at in (part.split() for part in link.split(",") if part))
    return (
        f'<lane id="{number}" type="{kind}" level="false"><link>{links}</link>'
        f'<width sOffset="0" a="{a}" b="{b}" c="{c}" d="{d}"/>{marks}</lane>'
    )


def mark(kind: str, change: str = "", s: float = 0.0) -> str:
    """A road mark, with ``laneChange`` if ``change`` is given."""
    changes = f' laneChange="{change}"' if change else ""
    return f'<roadMark sOffset="{s}" type="{kind}"{changes}/>'


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
    junction = parts.get("junction", "-1")
    elevation, lateral, signals = (parts.get(key, "") for key in ("elevation", "lateral", "signals"))
    return (
        f'<road name="" length="{length}" id="{number}" junction="{junction}"{rules}><link>{links}</link>'
        f'<type s="0" type="town"><speed max="50" unit="km/h"/></type>'
        f"<planView>{plan}</planView><elevationProfile>{elevation}</elevationProfile>"
        f"<lateralProfile>{lateral}</lateralProfile><lanes>{sections}</lanes><signals>{signals}</signals></road>"
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


def two_roads(**parts: str) -> list[str]:
    """Two roads of one lane each way, along x, from 0 to 100 m and from 100 to 200 m."""
    first = section([lane(-1, link="successor -1")], [lane(1, link="successor 1")])
    second = section([lane(-1, link="predecessor -1")], [lane(1, link="predecessor 1")])
    return [
        road("1", 100, geometry(0, 0, 0, 100), first, "successor road 2 start", **parts),
        road("2", 100, geometry(100, 0, 0, 100), second, "predecessor road 1 end", **parts),
    ]


def hill() -> str:
    """Two roads that climb from z = 2 m at 4 %, with a slope of 0.05 rad across."""
    lateral = '<superelevation s="0" a="0.05" b="0" c="0" d="0"/>'
    first, second = two_roads(lateral=lateral)
    profile = '<elevationProfile><elevation s="0" a="{}" b="0.04" c="0" d="0"/>'
    return opendrive(
        first.replace("<elevationProfile>", profile.format(2)), second.replace("<elevationProfile>", profile.format(6))
    )


def merge(signals: str = "") -> str:
    """Lanes -1 and -2 of road 1, 100 m along x, both lead to lane -1 of road 2 through the junction 9."""
    first = section([lane(-1), lane(-2)])
    through = section([lane(-1, link="predecessor -1, successor -1")])
    right = section([lane(-1, link="predecessor -2, successor -1")])
    after = section([lane(-1)])
    bend = '<poly3 a="0" b="0" c="0.02625" d="-0.000875"/>'  # 3.5 m to the left over 20 m, level at both ends
    return opendrive(
        road("1", 100, geometry(0, 0, 0, 100), first, "successor junction 9", signals=signals),
        road("2", 100, geometry(120, 0, 0, 100), after, "predecessor junction 9"),
        road("5", 20, geometry(100, 0, 0, 20), through, "predecessor road 1 end, successor road 2 start", junction="9"),
        road("6", 20.3, geometry(100, 0, 0, 20.3, bend), right, "predecessor road 1 end, successor road 2 start",
             junction="9"),
        junction("9", ("1", "5", "start", "-1:-1"), ("1", "6", "start", "-2:-1")),
    )  # fmt: skip


def lane_drop() -> str:
    """Three lanes, of which the outer one narrows from 3.5 m to 0 between 60 and 100 m, then two, to 160 m."""
    three = section([lane(number, link=f"successor {number}") for number in (-1, -2, -3)])
    through = [lane(number, link=f"predecessor {number}, successor {number}") for number in (-1, -2)]
    taper = section([*through, lane(-3, width="3.5 -0.0875 0 0", link="predecessor -3")], s=60)
    two = section([lane(number, link=f"predecessor {number}") for number in (-1, -2)], s=100)
    return opendrive(road("1", 160, geometry(0, 0, 0, 160), three + taper + two))


def roundabout() -> str:
    """A ring of radius 20 m in two halves, 3 and 4, with two arms of one lane each way; they meet in two junctions."""
    ring = '<arc curvature="0.05"/>'
    half = 20 * math.pi
    gap = 0.2  # rad, of the ring inside a junction
    piece = half - 20 * gap
    around = section([lane(-1, link="")])
    both = section([lane(-1)], [lane(1)])
    joint = section([lane(-1, link="predecessor -1, successor -1")])
    enter = section([lane(-1, link="predecessor 1, successor -1")])
    r = 20.0
    cos, sin = math.cos(gap / 2), math.sin(gap / 2)
    chord = 2 * r * sin
    return opendrive(
        road("1", 50, geometry(r + 10, 0, 0, 50), both, "predecessor junction 8"),
        road("2", 50, geometry(-r - 10, 0, math.pi, 50), both, "predecessor junction 9"),
        road("3", piece, geometry(r * cos, r * sin, math.pi / 2 + gap / 2, piece, ring), around,
             "predecessor junction 8, successor junction 9"),
        road("4", piece, geometry(-r * cos, -r * sin, -math.pi / 2 + gap / 2, piece, ring), around,
             "predecessor junction 9, successor junction 8"),
        # along the ring, out of it and into it, at both junctions
        road("30", chord, geometry(r * cos, -r * sin, math.pi / 2, chord), joint,
             "predecessor road 4 end, successor road 3 start", junction="8"),
        road("40", chord, geometry(-r * cos, r * sin, -math.pi / 2, chord), joint,
             "predecessor road 3 end, successor road 4 start", junction="9"),
        road("31", 10, geometry(r * cos, -r * sin, 0, 10), joint,
             "predecessor road 4 end, successor road 1 start", junction="8"),
        road("32", 10, geometry(r + 10, 0, math.pi, 10), enter,
             "predecessor road 1 start, successor road 3 start", junction="8"),
        road("41", 10, geometry(-r * cos, r * sin, math.pi, 10), joint,
             "predecessor road 3 end, successor road 2 start", junction="9"),
        road("42", 10, geometry(-r - 10, 0, 0, 10), enter,
             "predecessor road 2 start, successor road 4 start", junction="9"),
        junction("8", ("4", "30", "start", "-1:-1"), ("4", "31", "start", "-1:-1"), ("1", "32", "start", "1:-1")),
        junction("9", ("3", "40", "start", "-1:-1"), ("3", "41", "start", "-1:-1"), ("2", "42", "start", "1:-1")),
    )  # fmt: skip


def direct_junction(*, lefthand: bool = False, both_ways: bool = False) -> str:
    """Road 1 leads to roads 2 and 3 end to end; with ``both_ways``, another lane leads from road 2 back to road 1."""
    side = 1 if lefthand else -1
    rule = "LHT" if lefthand else "RHT"

    def lanes(*numbers: int) -> str:
        right = [lane(number) for number in sorted(numbers, reverse=True) if number < 0]
        left = [lane(number) for number in sorted(numbers, reverse=True) if number > 0]
        return section(right, left)

    back = [-side] if both_ways else []
    links = f"{side}:{side}" + (f" {-side}:{-side}" if both_ways else "")
    joined = junction("9", ("1", "2", "start", links), ("1", "3", "start", f"{2 * side}:{side}"))
    joined = joined.replace('<junction id="9"', '<junction id="9" type="direct"').replace(
        "connectingRoad", "linkedRoad"
    )
    oblique = geometry(100, 3.5 * side, side * 0.05, 100)
    return opendrive(
        road("1", 100, geometry(0, 0, 0, 100), lanes(side, 2 * side, *back), "successor junction 9", rule=rule),
        road("2", 100, geometry(100, 0, 0, 100), lanes(side, *back), "predecessor junction 9", rule=rule),
        road("3", 100, oblique, lanes(side), "predecessor junction 9", rule=rule),
        joined,
    )


def spirals(curvature: float, change: float, length: float = 60.0) -> str:
    """A road of one lane along a spiral whose curvature changes by so much, and a road that continues it."""
    shape = f'<spiral curvStart="{curvature!r}" curvEnd="{curvature + change!r}"/>'
    first = section([lane(-1, link="successor -1")])
    angle = (curvature + change / 2) * length
    x, y = (math.sin(angle) / curvature, (1 - math.cos(angle)) / curvature) if curvature else (length, 0.0)
    second = section([lane(-1, link="predecessor -1")])
    return opendrive(
        road("1", length, geometry(0, 0, 0, length, shape), first, "successor road 2 start"),
        road("2", 100, geometry(x, y, angle, 100), second, "predecessor road 1 end"),
    )


def crossing_in_pieces(light: str) -> str:
    """A crossing of four arms; each arm is two roads, and has a light at its end at the junction 9.

    Roads 1 to 4 begin at the junction; 11 to 14 begin where these end.
    """
    near = section([lane(-1, link="successor -1")], [lane(1, link="successor 1")])
    far = section([lane(-1, link="predecessor -1")], [lane(1, link="predecessor 1")])
    parts, connections = [], []
    for arm in range(4):
        heading = arm * math.pi / 2
        cos, sin = math.cos(heading), math.sin(heading)
        link = f"predecessor junction 9, successor road {11 + arm} start"
        start = geometry(10 * cos, 10 * sin, heading, 50)
        parts.append(road(f"{1 + arm}", 50, start, near, link, signals=light.format(arm)))
        further = geometry(60 * cos, 60 * sin, heading, 50)
        parts.append(road(f"{11 + arm}", 50, further, far, f"predecessor road {1 + arm} end"))
    through = section([lane(-1, link="predecessor 1, successor -1")])
    for arm in range(4):
        heading = arm * math.pi / 2 + math.pi
        opposite = (arm + 2) % 4
        x, y = -10 * math.cos(heading), -10 * math.sin(heading)
        link = f"predecessor road {1 + arm} start, successor road {1 + opposite} start"
        parts.append(road(f"{21 + arm}", 20, geometry(x, y, heading, 20), through, link, junction="9"))
        connections.append((f"{1 + arm}", f"{21 + arm}", "start", "1:-1"))
    return opendrive(*parts, junction("9", *connections))
