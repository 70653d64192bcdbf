"""The town under a user's own configuration."""

from pathlib import Path

from egvs.formats import xml
from tests.traffic.helpers import scenario

SHORT = {"frames": 3, "warmup_s": 1.0, "step_s": 1.0, "frame_period_s": 1.0}
KEPT = "not SUMO's"


def first_lane(net: Path) -> tuple[str, str, str]:
    """An edge, its first lane, and a signal of a network."""
    edge = next(e for e in xml.iter_elements(net, "net") if e.tag == "edge" and not e.get("id", "").startswith(":"))
    signal = next(e.get("id", "") for e in xml.iter_elements(net, "net") if e.tag == "tlLogic")
    return edge.get("id", ""), f"{edge.get('id', '')}_0", signal


def configured(folder: Path, options: str = "", additional: str = "<additional/>"):
    (folder / "own.add.xml").write_text(additional)
    files = '<net-file value="net.xml"/><route-files value="own.rou.xml"/><additional-files value="own.add.xml"/>'
    (folder / "own.sumocfg").write_text(f"<configuration>{files}{options}</configuration>")
    return scenario(folder, sumocfg="own.sumocfg", **SHORT)
