"""Sizes of Parquet and Feather files are read from the headers of their parts, whatever their footers say.

Evidence: sizes that pyarrow states for files that it wrote, in every compression and encoding.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.formats import arrow_bounds
from egvs.traffic import fcd

ROWS = 20_000


def fcd_table(rows: int = ROWS, name: str = "a") -> pa.Table:
    numbers = pa.array(np.arange(rows, dtype=np.float64))
    names = pa.array([name] * rows)
    return pa.table({"time": numbers, "id": names, "x": numbers, "y": numbers, "angle": numbers, "type": names})


def varint(value: int, size: int | None = None) -> bytes:
    """A number in Thrift's compact protocol; with a size, as so many bytes."""
    data = bytearray()
    value *= 2
    while value >= 128 or (size is not None and len(data) < size - 1):
        data.append(value & 127 | 128)
        value >>= 7
    return bytes([*data, value])


def with_false_sizes(path: Path) -> Path:
    """Write 1 for each size after decompression that the footer of a file states."""
    group = pq.read_metadata(path).row_group(0)
    sizes = {group.total_byte_size, *(group.column(i).total_uncompressed_size for i in range(group.num_columns))}
    data = path.read_bytes()
    start = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    footer = data[start:]
    for size in sizes:
        footer = footer.replace(varint(size), varint(1, len(varint(size))))
    path.write_bytes(data[:start] + footer)
    group = pq.read_metadata(path).row_group(0)
    assert group.total_byte_size == 1
    return path


@pytest.mark.parametrize("compression", ["NONE", "snappy", "gzip", "zstd", "lz4", "brotli"])
@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("is_encoded", [True, False])
def test_size_of_parquet_is_that_of_its_pages(tmp_path: Path, compression: str, version: str, is_encoded: bool) -> None:
    path = tmp_path / "a.parquet"
    random = np.random.default_rng(1)
    table = pa.table({"a": random.random(ROWS), "b": random.integers(0, 9, ROWS).astype(str), "c": [None] * ROWS})
    pq.write_table(
        table, path, row_group_size=ROWS // 2, compression=compression, data_page_version=version,
        use_dictionary=is_encoded, data_page_size=20_000,
    )  # fmt: skip
    with pq.ParquetFile(path) as file:
        sizes = arrow_bounds.parquet_group_bytes(file, path, ["a", "b", "c"], path)
        stated = [file.metadata.row_group(number).total_byte_size for number in range(2)]
    assert len(sizes) == 2
    for size, with_headers in zip(sizes, stated, strict=True):
        assert 0.95 * with_headers < size < with_headers


@pytest.mark.parametrize("encoding", ["BYTE_STREAM_SPLIT", "PLAIN", "DELTA_BINARY_PACKED"])
def test_reads_fcd_in_each_encoding(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "f.parquet"
    table = fcd_table()
    if encoding == "DELTA_BINARY_PACKED":
        table = pa.table({name: values.cast(pa.int64()) if name in "xy" else values for name, values in
                          zip(table.column_names, table.columns, strict=True)})  # fmt: skip
    pq.write_table(table, path, use_dictionary=False, column_encoding={"x": encoding, "y": encoding})
    rows = pa.concat_tables(fcd.read_fcd(path))
    assert rows.num_rows == ROWS
    assert set(rows["id"].to_pylist()) == {"a"}


def test_false_sizes_of_parquet_are_not_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "f.parquet"
    pq.write_table(fcd_table(200_000), path, use_dictionary=False, compression="zstd")
    with_false_sizes(path)
    assert path.stat().st_size < 2_000_000
    monkeypatch.setenv(limits.UNPACKED.name, "8")
    with pytest.raises(InputError, match=r"f\.parquet: has a row group of 8 MB after decompression\. The"):
        list(fcd.read_fcd(path))
    monkeypatch.setenv(limits.UNPACKED.name, "9")
    assert sum(table.num_rows for table in fcd.read_fcd(path)) == 200_000


def test_inconsistent_statistics_of_parquet_are_an_error(tmp_path: Path) -> None:
    """Arrow's description of such a column ends the program."""
    path = tmp_path / "f.parquet"
    pq.write_table(fcd_table(), path)
    optional, required = b"\x25\x02\x18\x05angle", b"\x25\x00\x18\x05angle"
    data = path.read_bytes()
    assert data.count(optional) == 1
    path.write_bytes(data.replace(optional, required))
    with pytest.raises(InputError, match=r"f\.parquet: cannot be read as Parquet"):
        list(fcd.read_fcd(path))


@pytest.mark.parametrize("rows", [1, 70_000])
def test_footer_of_parquet_is_read_as_arrow_reads_it(tmp_path: Path, rows: int) -> None:
    path = tmp_path / "f.parquet"
    pq.write_table(fcd_table(rows), path, row_group_size=20_000)
    metadata = pq.read_metadata(path)
    with path.open("rb") as file:
        groups = arrow_bounds.read_parquet_groups(file)
    assert len(groups) == metadata.num_row_groups
    for number, chunks in enumerate(groups):
        columns = [metadata.row_group(number).column(i) for i in range(metadata.num_columns)]
        expected = [
            (c.path_in_schema, c.num_values, c.total_compressed_size, c.dictionary_page_offset) for c in columns
        ]
        assert [(c.name, c.values, c.packed_bytes, c.start) for c in chunks] == expected


@pytest.mark.slow
def test_long_text_in_each_row_is_not_repeated(tmp_path: Path) -> None:
    """A text of 100 kB that a dictionary contains once: 2 GB in 20,000 rows."""
    path = tmp_path / "f.parquet"
    pq.write_table(fcd_table(name="a" * 100_000), path, compression="zstd")
    assert path.stat().st_size < 500_000
    before = pa.total_allocated_bytes()
    with pytest.raises(InputError, match=r"f\.parquet: id: expected texts of at most 1,000 bytes, got 100,000"):
        list(fcd.read_fcd(path))
    assert pa.total_allocated_bytes() - before < 10_000_000


@pytest.mark.slow
def test_rejects_columns_that_repeat_values(tmp_path: Path) -> None:
    path = tmp_path / "f.parquet"
    pq.write_table(fcd_table(), path, use_dictionary=False, column_encoding={"id": "DELTA_BYTE_ARRAY"})
    with pytest.raises(InputError, match=r"f\.parquet: id: the encoding DELTA_BYTE_ARRAY is not supported"):
        list(fcd.read_fcd(path))
    lists = fcd_table().set_column(2, "x", pa.array([[1.0, 2.0]] * ROWS))
    pq.write_table(lists, path)
    with pytest.raises(InputError, match=r"f\.parquet: x\.list\.element: expected one number or text in each row, got"):
        list(fcd.read_fcd(path))
    wide = fcd_table().set_column(2, "x", pa.array([b"a" * 100_000] * ROWS, pa.binary(100_000)))
    pq.write_table(wide, path, compression="zstd")
    with pytest.raises(InputError, match=r"f\.parquet: x: expected one number or text in each row, got long"):
        list(fcd.read_fcd(path))


@pytest.mark.parametrize("compression", ["uncompressed", "lz4", "zstd"])
def test_size_of_feather_is_that_of_its_buffers(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.feather"
    table = pa.table({"a": np.zeros(ROWS), "b": pa.array(["name"] * ROWS).dictionary_encode(), "c": ["text"] * ROWS})
    pyarrow.feather.write_feather(table, path, compression=compression, chunksize=ROWS // 3)
    with path.open("rb") as file:
        assert arrow_bounds.feather_bytes(file, path) == pytest.approx(table.nbytes, rel=0.01)


def test_damaged_feather_is_rejected(tmp_path: Path) -> None:
    """Each change of a byte gives an error, or a size; never anything else."""
    path = tmp_path / "a.feather"
    pyarrow.feather.write_feather(pa.table({"a": [1.0, 2.0]}), path, compression="zstd")
    good = path.read_bytes()
    random = np.random.default_rng(1)
    sizes = []
    for _ in range(300):
        data = bytearray(good)
        data[random.integers(len(data))] = random.integers(256)
        path.write_bytes(data)
        with path.open("rb") as file:
            try:
                sizes.append(arrow_bounds.feather_bytes(file, path))
            except (ValueError, arrow_bounds.struct.error, InputError):
                sizes.append(-1)
    assert min(sizes) == -1 and max(sizes) >= 16
