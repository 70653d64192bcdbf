"""Time of the first scan: the shortest times, and the table in a page."""

import pytest
from benchmarks import first_scan
from benchmarks.first_scan import NUMBA, PROCESSES, Times


def test_the_shortest_time_of_each_part_counts():
    assert first_scan._shortest([[1.0, 3.0, 3.5], [2.0, 2.5, 3.5]]) == Times(1.0, 0.5, 0.5)
    assert first_scan._shortest([[1.0, 1.25]]) == Times(1.0, 0.25)


def test_table_replaces_what_is_between_the_marks():
    times = {process.name: Times(0.5, 0.25, 0.0625) for process in (*PROCESSES, NUMBA)}
    table = first_scan.to_markdown(times, times)
    assert "| `egvs place` | 0.50 | 0.25 | 0.06 | 0.50 | 0.25 |" in table
    assert table.endswith("Importing numba takes 0.25 s of each first scan.")
    page = f"before\n{first_scan.MARKS[0]}\nold\n{first_scan.MARKS[1]}\nafter\n"
    changed = first_scan.with_table(page, first_scan.to_markdown(times))
    assert changed.startswith("before\n<!-- first scan -->\n| process | start s |") and "old" not in changed
    assert changed.endswith(f"\n{first_scan.MARKS[1]}\nafter\n")
    with pytest.raises(ValueError, match="first scan"):
        first_scan.with_table("no marks", table)


@pytest.mark.nightly  # a measurement of times, of which only the order is checked
@pytest.mark.slow
@pytest.mark.system
def test_first_scan_of_each_process_takes_longer_than_its_second():
    (times,) = first_scan.measure([first_scan.ROOT], starts=1)
    for process in PROCESSES:
        assert times[process.name].start_s > 0 and times[process.name].first_s > times[process.name].second_s > 0
