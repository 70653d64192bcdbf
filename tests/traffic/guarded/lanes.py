"""Names of the town for additional files."""

from pathlib import Path

from pipeline.formats import safe_xml


def first_lane(net: Path) -> tuple[str, str, str]:
    """An edge, its first lane, and a signal of a network."""
    edge = next(e for e in safe_xml.children(net, "net") if e.tag == "edge" and not e.get("id", "").startswith(":"))
    signal = next(e.get("id", "") for e in safe_xml.children(net, "net") if e.tag == "tlLogic")
    return edge.get("id", ""), f"{edge.get('id', '')}_0", signal
