"""Work on threads: results come in order."""

import pytest

from egvs.core.threads import map_ordered


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_the_order_of_the_work(threads):
    assert list(map_ordered(lambda n: n * n, range(20), threads)) == [n * n for n in range(20)]


@pytest.mark.parametrize("threads", [1, 3])
def test_first_error_ends_the_work(threads):
    with pytest.raises(ZeroDivisionError):
        list(map_ordered(lambda n: 1 // (5 - n), range(20), threads))
