"""Work on threads: results come in order, and what is not needed any more ends."""

import threading
import time
from concurrent.futures import CancelledError

import pytest

from egvs.core.threads import at_checkpoints, checkpoint, map_ordered, run_in_thread


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_the_order_of_the_work(threads):
    assert list(map_ordered(lambda n: n * n, range(20), threads)) == [n * n for n in range(20)]


@pytest.mark.parametrize("threads", [1, 3])
def test_first_error_ends_the_work(threads):
    with pytest.raises(ZeroDivisionError):
        list(map_ordered(lambda n: 1 // (5 - n), range(20), threads))


def test_function_in_a_thread_returns_its_result():
    with run_in_thread(lambda: 6 * 7) as future:
        assert future.result(timeout=60) == 42


def test_function_in_a_thread_ends_with_the_block():
    began = threading.Event()

    def work():
        while True:
            began.set()
            checkpoint()
            time.sleep(0.001)

    with pytest.raises(ZeroDivisionError), run_in_thread(work) as future:
        assert began.wait(timeout=60)
        raise ZeroDivisionError
    assert isinstance(future.exception(timeout=0), CancelledError)


def test_checkpoints_of_blocks_around_the_work_are_called_first():
    called = []
    with at_checkpoints(lambda: called.append("outer")):
        with run_in_thread(checkpoint) as future:
            future.result(timeout=60)
        with at_checkpoints(lambda: called.append("inner")):
            checkpoint()
        checkpoint()
    checkpoint()
    assert called == ["outer", "outer", "inner", "outer"]
