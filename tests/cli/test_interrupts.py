"""An interrupt is answered, whatever the program is at.

Evidence: a module that interrupts the process while it is imported, and swallows that, as trimesh's imports do.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SWALLOWS = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    [None for _ in range(1000)]
except BaseException:
    pass
"""

VERB = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background ignores it
from egvs.cli import app

@app.app.command()
def odd():
    import swallows
    while True:  # until the interrupt ends it
        pass

sys.argv = ["egvs", "odd"]
app.main()
"""


@pytest.mark.slow
@pytest.mark.system
def test_an_interrupt_during_an_import_is_not_lost(tmp_path: Path) -> None:
    (tmp_path / "swallows.py").write_text(SWALLOWS)
    (tmp_path / "verb.py").write_text(VERB)
    done = subprocess.run([sys.executable, tmp_path / "verb.py"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 130, done.stderr
    assert "egvs: interrupted; run the same command again" in done.stderr
    assert "Traceback" not in done.stderr
