"""Time of a run beside SUMO's own, with an empty cache of results: after installing, and with compiled kernels.

``python -m benchmarks.first_run`` runs the shipped junction twice, each time with an empty store: first with an empty
cache of compiled kernels, then with the kernels that the first run compiled. What a run takes beyond SUMO's seconds is
printed; both are of the same run, so the time of day matters less. The kernels are counted, because each takes time.
Bytecode is cached, as after installing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"

FIRST, WARM = "first run after installing", "run with compiled kernels"
LIMITS_S = {FIRST: 15.0, WARM: 2.5}
"""How many seconds longer than SUMO each may take; docs/scaling.md has what was measured."""

MAX_KERNELS = 90
"""Files in the cache of compiled kernels after a run: one for each kernel and each combination of argument types."""


def rows() -> list[tuple[str, str, str, bool]]:
    """Return what each run takes, its limit, and whether it is reached; and the number of compiled kernels."""
    result = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        kernels = folder / "kernels"
        for what, limit_s in LIMITS_S.items():
            total_s, sumo_s = time_run(folder / what, kernels)
            more_s = total_s - sumo_s
            measured = f"SUMO's {sumo_s:.1f} s + {more_s:.1f} s"
            result.append((f"{what}, empty store", measured, f"SUMO + {limit_s:g} s", more_s <= limit_s))
        count = sum(1 for _ in kernels.rglob("*.kernel"))
        result.append(("  kernels compiled", str(count), str(MAX_KERNELS), count <= MAX_KERNELS))
    return result


def time_run(folder: Path, kernels: Path) -> tuple[float, float]:
    """Run the scenario in another process with a store of its own; return its wall seconds, and SUMO's."""
    command = [sys.executable, "-m", "egvs", "run", str(SCENARIO), "--out", str(folder / "run")]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"EGVS_STORE": str(folder / "store"), "NUMBA_CACHE_DIR": str(kernels)}
    begin = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=environment)
    total_s = time.perf_counter() - begin
    record = json.loads((folder / "run" / "run.json").read_text(encoding="utf-8"))
    return total_s, record["stages"]["traffic"]["summary"]["sumo_seconds"]


if __name__ == "__main__":
    for row in rows():
        print(*row, sep="   ")
