"""Memory of processes."""

import os
import subprocess
import sys

import pytest

from egvs.core import resource_usage

MEMORY_MB = 60.0


def test_peak_of_process_survives_measured_blocks() -> None:
    """Each measured block resets the peak that Linux keeps."""
    with resource_usage.measure_usage():
        array = bytearray(int(MEMORY_MB * 2**20))
        high_mb = resource_usage.process_peak_mb()
    del array
    resource_usage.release_memory()
    with resource_usage.measure_usage() as small:
        pass
    assert resource_usage.process_peak_mb() > high_mb - 1.0
    assert small.peak_mb < high_mb - MEMORY_MB / 2


def test_peak_of_a_block_is_not_lost_when_another_block_begins() -> None:
    with resource_usage.measure_usage() as outer:
        array = bytearray(int(MEMORY_MB * 2**20))
        high_mb = resource_usage.process_peak_mb()
        del array
        resource_usage.release_memory()
        with resource_usage.measure_usage():
            pass
    assert outer.peak_mb > outer.held_mb + MEMORY_MB / 2
    assert outer.peak_mb <= high_mb + 1.0


@pytest.mark.system
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the memory of other processes is known on Linux only")
def test_peak_of_another_process() -> None:
    code = f"a = bytearray(int({MEMORY_MB} * 2**20)); print(len(a), flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdout.readline()
        peak_mb = resource_usage.peak_memory_of(child.pid)
        child.stdin.write(b"\n")
        child.stdin.close()
    assert peak_mb is not None
    assert MEMORY_MB < peak_mb < 3 * MEMORY_MB
    assert resource_usage.peak_memory_of(os.getpid()) is not None
    assert resource_usage.peak_memory_of(child.pid) is None
