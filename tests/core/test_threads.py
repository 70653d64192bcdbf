"""Work on threads: results in order, and work beside other work."""

import threading
from contextvars import ContextVar

import pytest

from egvs.core.threads import compute_beside, map_ordered

COLOUR = ContextVar("COLOUR", default="none")


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_the_order_of_the_work(threads):
    assert list(map_ordered(lambda n: n * n, range(20), threads)) == [n * n for n in range(20)]


def test_work_beside_a_block_runs_on_another_thread_in_the_same_context():
    other_runs = threading.Event()

    def work():
        other_runs.set()
        return threading.get_ident(), COLOUR.get()

    token = COLOUR.set("red")
    with compute_beside(work, 2) as result:
        assert other_runs.wait(60)  # before the result is asked for
        thread, colour = result()
    COLOUR.reset(token)
    assert thread != threading.get_ident() and colour == "red"


def test_with_one_thread_work_runs_when_its_result_is_needed():
    called = []
    with compute_beside(lambda: called.append(threading.get_ident()), 1) as result:
        assert not called
        result()
    assert called == [threading.get_ident()]


@pytest.mark.parametrize("threads", [1, 2])
def test_error_of_work_beside_a_block_is_raised_with_its_result(threads):
    with compute_beside(lambda: 1 // 0, threads) as result, pytest.raises(ZeroDivisionError):
        result()


def test_error_of_the_block_comes_first():
    with pytest.raises(KeyError), compute_beside(lambda: 1 // 0, 2):
        raise KeyError
