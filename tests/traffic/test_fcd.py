"""Formats of floating car data, damaged files, and groups of frames."""

import gzip
import re
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.errors import InputError, RunError
from egvs.traffic import fcd
from egvs.traffic.fcd import FrameWindow, group_frames

HEADER = "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed"


CSV = f"""{HEADER}
0.000;;;;;;
0.500;b;1.00000000;2.00000000;90.00000000;car;3.50000000
0.500;a;-1.25000000;1e3;360.00000000;bus;0.00000000
1.000;b;2.50000000;2.00000000;90.00000000;car;3.00000000
"""


XML = """<?xml version="1.0"?>
<fcd-export>
  <timestep time="0.00"/>
  <timestep time="0.50">
    <vehicle id="b" x="1.00" y="2.00" angle="90.00" type="car" speed="3.50"/>
    <vehicle id="a" x="-1.25" y="1000.00" angle="360.00" type="bus" speed="0.00"/>
    <person id="p" x="1" y="1" angle="0" speed="1"/>
  </timestep>
  <timestep time="1.00"><vehicle id="b" x="2.50" y="2.00" angle="90.00" type="car" speed="3.00"/></timestep>
</fcd-export>
"""


ROWS = {
    "time_ms": [500, 500, 1000],
    "id": ["b", "a", "b"],
    "type": ["car", "bus", "car"],
    "x": [1.0, -1.25, 2.5],
    "y": [2.0, 1000.0, 2.0],
    "z": [0.0, 0.0, 0.0],
    "angle": [90.0, 360.0, 90.0],
    "slope": [0.0, 0.0, 0.0],
    "speed": [3.5, 0.0, 3.0],
}


def parquet_bytes(name=b"b", x=(float("nan"), 1.0, -1.25, 2.5)):
    nan = float("nan")
    names = pa.array([b"", name, b"a", name]).view(pa.string())
    table = pa.table(
        {
            "timestep_time": [0.0, 0.5, 0.5, 1.0],
            "vehicle_id": names,
            "vehicle_x": list(x),
            "vehicle_y": [nan, 2.0, 1000.0, 2.0],
            "vehicle_angle": pa.array([nan, 90.0, 360.0, 90.0], pa.float32()),
            "vehicle_type": ["", "car", "bus", "car"],
            "vehicle_speed": [nan, 3.5, 0.0, 3.0],
        }
    )
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return sink.getvalue().to_pybytes()


def read_all(path):
    return pa.concat_tables([fcd.FCD_SCHEMA.empty_table(), *fcd.read_fcd(path)])


@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gzipped"])
@pytest.mark.parametrize("form", ["csv", "xml", "parquet"])
def test_all_formats_give_the_same_rows(tmp_path, form, zipped):
    content = {"csv": CSV.encode(), "xml": XML.encode(), "parquet": parquet_bytes()}[form]
    path = tmp_path / "recorded"  # the name says nothing, the first bytes do
    path.write_bytes(gzip.compress(content) if zipped else content)
    assert read_all(path).to_pydict() == ROWS


class GrowingFile:
    """A file to which each look whether it has ended adds the next part."""

    def __init__(self, path, content, cuts):
        bounds = [0, *sorted(cuts), len(content)]
        self._parts = [content[start:end] for start, end in pairwise(bounds)]
        self._path = path
        self.error = None

    def has_ended(self):
        if not self._parts:
            if self.error is not None:
                raise self.error
            return True
        with self._path.open("ab") as file:
            file.write(self._parts.pop(0))
        return False


@pytest.mark.slow
@given(st.lists(st.integers(0, len(CSV)), max_size=6), st.sampled_from([1, 40, 1 << 20]))
def test_file_that_grows_has_the_rows_of_the_complete_file(tmp_path_factory, cuts, block_bytes):
    path = tmp_path_factory.mktemp("growing") / "fcd.csv"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fcd, "_WAIT_S", 0.0)
        patch.setattr(fcd, "_BLOCK_BYTES", block_bytes)
        growing = GrowingFile(path, CSV.encode(), cuts)
        tables = list(fcd.read_growing_fcd(path, "vehicle", growing.has_ended))
    assert pa.concat_tables(tables).to_pydict() == ROWS


def test_finished_file_is_read_in_blocks(tmp_path, monkeypatch):
    path = tmp_path / "fcd.csv"
    path.write_text(CSV)
    monkeypatch.setattr(fcd, "_BLOCK_BYTES", 60)
    tables = list(fcd.read_growing_fcd(path, "vehicle", lambda: True))
    assert len(tables) == 3  # one for each vehicle: memory does not grow with the file
    assert pa.concat_tables(tables).to_pydict() == ROWS


def test_file_that_grows_may_have_no_vehicle(tmp_path):
    growing = GrowingFile(tmp_path / "fcd.csv", b"\n", [])
    assert list(fcd.read_growing_fcd(tmp_path / "fcd.csv", "vehicle", growing.has_ended)) == []


def test_error_of_the_writer_comes_before_that_of_its_last_row(tmp_path):
    path = tmp_path / "fcd.csv"
    growing = GrowingFile(path, CSV.encode() + b"1.5;b;2.5", [])
    growing.error = RunError("the disk is full")
    with pytest.raises(RunError, match="the disk is full"):
        list(fcd.read_growing_fcd(path, "vehicle", growing.has_ended))


def test_columns_in_any_order_with_others_between(tmp_path):
    path = tmp_path / "fcd.csv"
    path.write_text(
        "vehicle_lane;vehicle_slope;vehicle_type;vehicle_angle;vehicle_z;vehicle_y;vehicle_x;vehicle_id;timestep_time\n"
        "e_0;2.5;car;10;7;3;4;v;1.000\n"
    )
    row = read_all(path).to_pylist()[0]
    assert (row["x"], row["y"], row["z"], row["angle"], row["slope"]) == (4, 3, 7, 10, 2.5)
    assert np.isnan(row["speed"])


def test_time_of_a_step_counts_in_xml(tmp_path):
    path = tmp_path / "fcd.xml"
    path.write_text(XML.replace("<vehicle ", '<vehicle time="77" '))
    assert read_all(path).to_pydict() == ROWS


def test_persons_in_csv_are_skipped(tmp_path):
    path = tmp_path / "fcd.csv"
    path.write_text(f"{HEADER};person_id;person_x\n1;;;;;;;p;3\n1;v;1;2;3;car;4;;\n")
    assert read_all(path)["id"].to_pylist() == ["v"]


def row(**changes):
    values = {"time": "1.0", "id": "v", "x": "1", "y": "2", "angle": "3", "type": "car", "speed": "4"} | changes
    return ";".join(values.values())


BAD = {
    "empty": (b"", "is empty"),
    "without angle": (HEADER.replace("vehicle_angle", "vehicle_lane").encode() + b"\n", "no column for 'angle'"),
    "without type": (HEADER.replace("vehicle_type", "vehicle_lane").encode() + b"\n", "no column for 'type'"),
    "not a number": (f"{HEADER}\n{row(x='here')}\n".encode(), r"cannot be read as CSV.*here"),
    "NaN angle": (
        f"{HEADER}\n{row()}\n{row(angle='nan')}\n".encode(),
        r"row 2: angle of vehicle 'v' is nan. Use a finite",
    ),
    "empty angle": (f"{HEADER}\n{row(angle='')}\n".encode(), r"row 1: angle of vehicle 'v' is empty"),
    "x beyond the Earth": (
        f"{HEADER}\n{row(x='1e9')}\n".encode(),
        r"row 1: x of vehicle 'v' is 1000000000.0. Use a finite number, at most",
    ),
    "infinite x": (f"{HEADER}\n{row(x='inf')}\n".encode(), r"row 1: x of vehicle 'v' is inf"),
    "x and vehicle_x": (
        f"{HEADER};x\n{row()};1\n".encode(),
        r"the columns 'vehicle_x' and 'x' both stand for 'x'. Remove one of them",
    ),
    "vehicle_x twice": (
        f"{HEADER};vehicle_x\n{row()};1\n".encode(),
        r"the columns 'vehicle_x' and 'vehicle_x' both stand for 'x'",
    ),
    "time and timestep_time": (f"{HEADER};time\n{row()};1\n".encode(), r"both stand for 'time'"),
    "no name given": (f"{HEADER}\n{row()}\n{row(id='')}\n".encode(), r"row 2: expected a name with the position, got"),
    "no type given": (f"{HEADER}\n{row(type='')}\n".encode(), r"row 1: vehicle 'v' has no type"),
    "time runs back": (f"{HEADER}\n{row(time='2')}\n{row()}\n".encode(), r"row 2: time 1 s comes after 2 s"),
    "time too fine": (f"{HEADER}\n{row(time='0.0005')}\n".encode(), r"row 1: .*milliseconds, got time 0\.000500 s"),
    "clock time": (f"{HEADER}\n{row(time='00:00:01')}\n".encode(), r"cannot be read as CSV"),
    "short row": (f"{HEADER}\n{row()}\n1.0;v;1\n".encode(), r"cannot be read as CSV"),
    "truncated gzip, CSV": (gzip.compress(CSV.encode() * 900)[:-30], r"damaged gzip|cannot be read as CSV"),
    "truncated gzip, XML": (gzip.compress(XML.encode())[:-30], r"damaged gzip"),
    "truncated gzip, Parquet": (gzip.compress(parquet_bytes())[:-30], r"damaged gzip"),
    "truncated XML": (XML[:-40].encode(), r"not well-formed XML"),
    "XML of another kind": (b"<net/>", r"expected the root element <fcd-export>, got <net>"),
    "XML without angle": (XML.replace('angle="90.00"', "").encode(), r"vehicle 'b' at time '0\.50' has no angle"),
    "XML with a bad number": (XML.replace('"-1.25"', '"west"').encode(), r"x: .*west"),
    "XML with NaN": (XML.replace('"360.00"', '"nan"').encode(), r"vehicle element 2: angle of vehicle 'a' is nan"),
    "XML with entities": (b'<!DOCTYPE f [<!ENTITY a "b">]><fcd-export>&a;</fcd-export>', r"declares XML entities"),
    "truncated Parquet": (parquet_bytes()[:-30], r"cannot be read as Parquet"),
    "Parquet with a name that is no text": (
        parquet_bytes().replace(b"vehicle_angle", b"vehicle\xffangle"),
        r"cannot be read as Parquet \(it is not utf-8 text: byte 7 is 0xff\)",
    ),
    "Parquet with texts in place of numbers": (
        parquet_bytes(x=("", "1", "west", "2.5")),
        r"vehicle_x: expected a column of numbers, got string",
    ),
    "Parquet with an id that is no text": (parquet_bytes(b"\xff"), r"cannot be read as Parquet \(.*UTF8"),
    "infinite speed": (
        f"{HEADER}\n{row(speed='inf')}\n".encode(),
        r"row 1: speed of vehicle 'v' is inf. Use a finite number",
    ),
}


@pytest.mark.parametrize(("content", "message"), BAD.values(), ids=BAD.keys())
def test_rejects_damaged_file(tmp_path, content, message):
    path = tmp_path / "bad.fcd"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        list(fcd.read_fcd(path))
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_rejects_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        list(fcd.read_fcd(tmp_path / "none.csv"))


def steps(*times_s, vehicle="v"):
    n = len(times_s)
    zeros = np.zeros(n)
    return pa.table(
        [
            np.round(np.array(times_s) * 1000).astype(np.int64),
            pa.array([vehicle] * n),
            pa.array(["car"] * n),
            *[zeros] * 6,
        ],
        schema=fcd.FCD_SCHEMA,
    )


def picked(tables, window, each=2):
    result = list(group_frames(tables, window, each, "place"))
    assert [g.first_frame for g in result] == list(np.cumsum([0] + [g.frames for g in result[:-1]]))
    assert sum(g.frames for g in result) == window.count
    return [(int(f), t) for g in result for f, t in zip(g.frame, g.rows["time_ms"].to_pylist(), strict=True)]


def test_warm_up_and_period_select_time_steps():
    times = np.arange(25_200, 25_205, 0.25)
    assert picked([steps(*times)], FrameWindow(3, 500, skip_ms=1000)) == [
        (0, 25_201_000),
        (1, 25_201_500),
        (2, 25_202_000),
    ]


def test_step_without_rows_of_complete_recording_is_an_empty_frame():
    window = FrameWindow(5, 1000, first_ms=1000, complete=True)
    assert picked([steps(0, 1, 3)], window) == [(0, 1000), (2, 3000)]
    assert picked([], window) == []


def test_rejects_too_few_frames():
    with pytest.raises(
        InputError, match=r"frames = 5: the file has 3 frames 1 s apart after a warm-up of 1 s \(4 time steps in all"
    ):
        list(group_frames([steps(0, 1, 2, 3)], FrameWindow(5, 1000, skip_ms=1000), 10, "place"))


def test_rejects_period_between_time_steps():
    with pytest.raises(InputError, match=r"frame_period_s = 0.25: the time steps of the file are 1 s apart"):
        list(group_frames([steps(0, 1, 2, 3)], FrameWindow(2, 250), 10, "place"))


def test_rejects_file_without_vehicles():
    with pytest.raises(InputError, match="the file contains no vehicles"):
        list(group_frames([], FrameWindow(2, 250), 10, "place"))


@pytest.mark.slow
@given(
    present=st.lists(st.integers(0, 3), min_size=1, max_size=40),
    cuts=st.lists(st.integers(0, 120), max_size=6),
    each=st.integers(1, 7),
)
def test_groups_do_not_depend_on_how_rows_arrive(present, cuts, each):
    full = steps(*np.repeat(np.arange(len(present)), present).tolist())
    edges = sorted({0, full.num_rows, *(c for c in cuts if c < full.num_rows)})
    pieces = [full.slice(a, b - a) for a, b in pairwise(edges) if b > a]
    window = FrameWindow(len(present), 1000, first_ms=0, complete=True)
    expected = [(f, f * 1000) for f, n in enumerate(present) for _ in range(n)]
    assert picked(pieces, window, each) == expected


def test_message_names_the_file_once(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("a;b\n1;2\n")
    with pytest.raises(InputError) as caught:
        list(fcd.read_fcd(path))
    assert len(re.findall("x.csv", str(caught.value))) == 1


def test_rejects_frames_with_too_many_vehicles(monkeypatch):
    monkeypatch.setenv("EGVS_MAX_ROWS", "5")
    tables = [steps(*[0.0] * 4), steps(*[0.0] * 4)]
    with pytest.raises(
        InputError, match=r"has more than 5 vehicles in the frames of a group\. The limit is 5 rows; set EGVS_MAX_RO"
    ):
        list(group_frames(tables, FrameWindow(1, 1000), 1, "here"))


@pytest.mark.slow
def test_rejects_parquet_file_with_implausible_number_of_rows(tmp_path):
    """Three million rows that are all the same, in a few kilobytes."""
    n = 3_000_000
    columns = {"timestep_time": pa.array(np.zeros(n)), "vehicle_id": pa.array(["v"] * n).dictionary_encode()}
    columns |= {f"vehicle_{key}": pa.array(np.zeros(n)) for key in ("x", "y", "angle")}
    columns["vehicle_type"] = columns["vehicle_id"]
    pq.write_table(pa.table(columns), tmp_path / "f.parquet", compression="zstd")
    (tmp_path / "f.parquet.gz").write_bytes(gzip.compress((tmp_path / "f.parquet").read_bytes()))
    for name in ("f.parquet", "f.parquet.gz"):
        with pytest.raises(InputError, match=rf"{name}: declares 3,000,000 rows in [0-9,]+ bytes"):
            read_all(tmp_path / name)


def test_rejects_row_group_above_limit(tmp_path, monkeypatch):
    monkeypatch.setenv("EGVS_MAX_UNPACKED_MB", "1")
    n = 30_000
    columns = {f"vehicle_{key}": np.random.default_rng(1).random(n) for key in ("x", "y", "angle", "z", "speed")}
    columns |= {"timestep_time": np.zeros(n), "vehicle_id": ["v"] * n, "vehicle_type": ["car"] * n}
    pq.write_table(pa.table(columns), tmp_path / "f.parquet")
    with pytest.raises(
        InputError,
        match=r"f.parquet: has a row group of 1 MB after decompression\. The limit is 1 MB; set EGVS_MAX_UNPACKED",
    ):
        read_all(tmp_path / "f.parquet")


def test_rejects_header_that_is_not_text(tmp_path):
    """Even if only the name of an unused column is damaged."""
    path = tmp_path / "fcd.csv"
    head = b"timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehic\xff\xffpeed\n"
    path.write_bytes(head + b"0.00;east;1.0;-2.0;90.0;car;2.0\n")
    with pytest.raises(InputError, match=r"fcd\.csv: its first line cannot be read"):
        list(fcd.read_fcd(path))
