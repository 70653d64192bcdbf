"""A small fixed slice of the fuzzer, and what it is that it can tell.

The fuzzer runs in a process of its own, since it forks: ``make fuzz`` is the same with more cases.
"""

from __future__ import annotations

import gzip
import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fuzz import bases, meaning, mutating, structure
from tests.fuzz.kinds import FORMATS, KINDS
from tests.fuzz.mutating import mutant
from tests.processes import python

SLICE = "fcd.csv.gz,statics.geojson,sites.csv,scan.pcd binary,labels csv,tpog.parquet score"
SECURITY = Path(__file__).parents[2] / "docs" / "security.md"
FUZZ = "import sys; from tests.fuzz.__main__ import main; sys.exit(main())"


def test_kinds_are_distinct_and_complete() -> None:
    assert len(KINDS) >= 29
    assert len({(kind.make, kind.file, kind.verb) for kind in KINDS.values()}) == len(KINDS)


def test_each_format_with_limits_has_kinds() -> None:
    _, _, table = SECURITY.read_text(encoding="utf-8").partition("| format | read by |")
    rows = [line.split("|")[1].strip() for line in table.partition("\n\n")[0].splitlines()[2:]]
    assert len(rows) > 20
    assert set(rows) == set(FORMATS)
    assert {kind for kinds in FORMATS.values() for kind in kinds} <= set(KINDS)


@pytest.mark.slow
@pytest.mark.system
def test_mutants_of_some_kinds_give_no_fault(tmp_path: Path) -> None:
    """And a second call has nothing left to do."""
    options = ("--cases", 18, "--seed", 11, "--kinds", SLICE, "--keep", tmp_path)
    done = python(FUZZ, *options)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert len(lines) == 18 and {line["kind"] for line in lines} == set(SLICE.split(","))
    assert {line["verdict"] for line in lines} >= {"refused", "legal"}
    assert [path.name for path in tmp_path.iterdir()] == ["results.jsonl"]


FAULTS = {
    "traceback": "raise ZeroDivisionError",
    "signal 6": "os.abort()",
    "exit code 1": "sys.exit(1)",
    "memory": "bytearray(b'1') * (600 << 20)",
    "out of time": "while True: pass",
    "file not named": "sys.exit(2)",
    "result unreadable": "[path.write_bytes(b'') for path in pathlib.Path('out').glob('*.parquet')]",
}


@pytest.mark.slow
@pytest.mark.system
def test_faults_get_their_verdicts(tmp_path: Path) -> None:
    """A program that does what it should not gets the verdict that it deserves."""
    code = f"""
import os, pathlib, sys
from pathlib import Path
import egvs.cli.app
from tests.fuzz import cases
from tests.fuzz.kinds import KINDS
cases.MOST_BYTES = 1 << 29
bench = cases.Bench(KINDS["sites.csv"], Path({str(tmp_path)!r}) / "bench")
whole_s = cases.MOST_SECONDS
for fault, line in {FAULTS!r}.items():
    cases.MOST_SECONDS = 0.5 if fault == "out of time" else whole_s
    def main(): exec(line)
    egvs.cli.app.main = main
    verdict = bench.judge(bench.files[0], b"site,x_m,y_m,z_m\\n")
    assert verdict.name == fault, (fault, verdict)
"""
    done = python(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.system
def test_faults_in_process_get_their_verdicts(tmp_path: Path) -> None:
    """A mutant that ends the process is a fault, and the next ones are read by another process."""
    code = f"""
import os, sys
from pathlib import Path
from tests.fuzz import cases, in_process
from tests.fuzz.kinds import KINDS
faults = {{"traceback": "raise ZeroDivisionError", "the process ended with -6": "os.abort()",
          "out of time": "while True: pass", "file not named": "sys.exit(2)", "memory": "bytearray(b'1') * (60 << 20)",
          "read": "pass"}}
in_process.MOST_SECONDS, in_process.MOST_BYTES = 0.5, 50 << 20
for number, (fault, line) in enumerate(faults.items()):
    def command_line(arguments, calls=[]):
        calls.append(arguments)
        if len(calls) > 1:  # the first reads the file as it was
            exec(line)
    cases.command_line = command_line
    folder = Path({str(tmp_path)!r}) / str(number)
    verdicts = [verdict.name for _, verdict in in_process.judge_all(KINDS["sites.csv"], folder, 1, range(2))]
    assert verdicts == [fault] * 2, (fault, verdicts)
"""
    done = python(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.system
def test_killed_runs_reproduce_same_bytes() -> None:
    """A run, a new scenario, a plan and an export."""
    done = python(FUZZ, "--kills", 4)
    assert (done.returncode, done.stdout) == (0, "4 kills: 4 same bytes\n"), done.stderr


@pytest.mark.parametrize(
    ("make", "name", "reads"),
    [
        (bases.finished("parquet"), "scenario/fcd.parquet", meaning.parquet),
        (bases.finished("xml"), "scenario/fcd.xml", meaning.xml),
        (bases.sites, "scenario/sites.geojson", meaning.lenient_json),
        (bases.mesh("house.glb"), "scenario/house.glb", meaning.glb),
        (bases.extract("map.osm"), "map.osm", meaning.xml),
        (bases.plain, "scenario/sites.csv", meaning.commas),
    ],
)
def test_change_of_structure_leaves_a_whole_file(
    make: Callable[[Path], None], name: str, reads: meaning.Meaning, tmp_path: Path
) -> None:
    """Other code reads it, and reads something else."""
    make(tmp_path)
    data = (tmp_path / name).read_bytes()
    change = mutating.structure_change(data)
    assert change is not None
    before, whole, other = reads(data), 0, 0
    for seed in range(20):
        try:
            after = reads(change(random.Random(seed), data))
        except (*meaning.DAMAGED, OverflowError, TypeError):
            continue
        whole, other = whole + 1, other + (after != before)
    assert whole >= 12 and other >= 10


def test_change_of_protocol_buffers_is_read_again() -> None:
    message = b"\x08\x05\x12\x03abc\x1a\x04\x08\x01\x10\x02"
    changed = {structure.change_protobuf(random.Random(seed), message) for seed in range(40)}
    assert len(changed) > 10
    assert all(sum(1 for _ in structure.read_fields(data)) >= 2 for data in changed)


@pytest.mark.slow
def test_same_seed_gives_same_mutants() -> None:
    """And never the file as it was."""
    for data in (b"", b"a,b\n1,2\n", gzip.compress(b"<a b='1'/>", mtime=0), bytes(range(256))):
        one, again = ([mutant(random.Random(f"x{case}"), data) for case in range(40)] for _ in range(2))
        assert one == again
        assert data not in one


@pytest.mark.parametrize(
    ("reader", "one", "same", "other", "damaged"),
    [
        (meaning.xml, b"<a x='1' y='2'/>", b'<a y="2" x="1"></a>', b"<a x='1' y='3'/>", b"<a x='1'>"),
        (meaning.text_json, b'{"a": 1, "b": 2}', b'{"b":2,"a":1}', b'{"a": 1, "b": 3}', b'{"a": 1, "a": 1}'),
        (meaning.rows, b"a,b\n1,2\n", b"a, b\r\n1,2", b"a,b\n1,3\n", b"a,b\n1\n"),
        (meaning.toml, b"a = 1\nb = 2", b"b = 2\na = 1 # one", b"a = 1", b"a = "),
        (meaning.obj, b"v 0 0 0\nf 1 1 1", b"# one\nv 0 0.0 0\nf 1//1 1 1", b"v 0 0 1\nf 1 1 1", b"v 0 0 0\nf 1 2 3"),
    ],
)
def test_meaning_ignores_form_and_detects_damage(
    reader: meaning.Meaning, one: bytes, same: bytes, other: bytes, damaged: bytes
) -> None:
    assert reader(one) == reader(same)
    assert reader(one) != reader(other)
    with pytest.raises(meaning.DAMAGED):
        reader(damaged)
