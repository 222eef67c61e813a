"""Tables of a LeRobot dataset: reads untrusted ones, with limits of size and expected types, and writes new ones.

Shapes: N steps, D components.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from vla.io.errors import UserError
from vla.io.files import require_file
from vla.spec import Array

REMEDY = "copy the dataset again from where it is whole"  # where a copy may be damaged or incomplete
CORRECTION = "correct the dataset, or write it again"  # where a copy cannot help
MAX_ROWS = 10_000_000  # of a file: 280 hours at 10 Hz
MAX_BYTES = 2**33  # to unpack at once
MAX_SECONDS = 1e6  # video [s]

Column = pa.ChunkedArray
Kind = tuple[str, Callable[[Column], bool]]  # what a column must hold, and whether it does


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)


def is_text(kind: pa.DataType) -> bool:
    """Return whether a column of this type holds texts."""
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _are_numbers(column: Column) -> bool:
    kind = column.type.value_type if _is_list(column.type) else column.type
    return pa.types.is_floating(kind) or pa.types.is_integer(kind)


def _are_files(column: Column) -> bool:
    fields = [*column.type] if pa.types.is_struct(column.type) else []
    kinds = {field.name: field.type for field in fields}
    if "bytes" not in kinds or len(kinds) < len(fields):  # a cell with two fields of one name cannot be read
        return False
    # Null: all images are files beside the tables.
    return any(holds(kinds["bytes"]) for holds in (pa.types.is_binary, pa.types.is_large_binary, pa.types.is_null))


def _is_within(column: Column, high: float) -> bool:
    values = column.to_numpy()  # nulls become NaN
    return not column.null_count and bool(((values >= 0) & (values <= high)).all())


COUNTS: Kind = "integers from 0 on", lambda column: pa.types.is_integer(column.type) and _is_within(column, 2**53)
TIMES: Kind = "seconds", lambda column: pa.types.is_floating(column.type) and _is_within(column, MAX_SECONDS)
TEXTS: Kind = "text", lambda column: is_text(column.type) and not column.null_count
NUMBERS: Kind = "lists of numbers", _are_numbers
PICTURES: Kind = "images, as the bytes of a file", _are_files


def files(folder: Path) -> list[Path]:
    """Return the files of a table, in their order; a UserError if there are none."""
    if paths := sorted(folder.glob("chunk-*/file-*.parquet")):
        return paths
    raise UserError(f"{folder} holds no tables: {REMEDY}")


def read(paths: Sequence[Path], columns: Mapping[str, Kind], only: Any = None) -> pa.Table:
    """Read the named columns of Parquet files, concatenated; `only` filters rows (UserError: a file is damaged, is too
    large, or lacks a column of the expected type)."""
    tables = list[pa.Table]()
    for path in paths:
        require(path, columns)
        if (size := _unpacked_size(path, columns, only is not None)) > MAX_BYTES:
            raise UserError(f"{path} unpacks to {size / 1e9:.1f} GB, more than {MAX_BYTES / 1e9:.1f} GB: divide it")
        try:
            table = pq.read_table(path, columns=[*columns], filters=only, page_checksum_verification=True)
            table.validate(full=True)
        except (pa.ArrowException, OSError) as error:
            raise UserError(f"{path} cannot be read ({str(error)[:200]}): {REMEDY}") from error
        _require_kinds(path, table, columns)
        tables.append(table)
    try:
        return pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise UserError(
            f"{paths[0]} and files beside it have other types ({str(error)[:200]}): {CORRECTION}"
        ) from error


def _unpacked_size(path: Path, columns: Collection[str], filtered: bool) -> int:
    """Estimate the decoded size of columns [bytes], summed over row groups or, if filtered, of the largest one.

    The estimate uses the metadata of the file; dictionary-encoded texts can take more memory.
    """
    metadata, sizes = pq.read_metadata(path), []
    for group in (metadata.row_group(number) for number in range(metadata.num_row_groups)):
        parts = [group.column(number) for number in range(group.num_columns)]
        parts = [part for part in parts if any(f"{part.path_in_schema}.".startswith(f"{name}.") for name in columns)]
        sizes.append(sum(max(part.total_uncompressed_size, 8 * part.num_values) for part in parts))
    return (max if filtered else sum)([0, *sizes])


def require(path: Path, columns: Mapping[str, Kind]) -> None:
    """Raise a UserError unless a file has columns of the expected types; their values are not read."""
    empty_table = schema_of(path).empty_table()
    if wrong_columns := [name for name in columns if empty_table.column_names.count(name) != 1]:
        raise UserError(f"{path} lacks the columns {', '.join(wrong_columns)}, or has them twice: {CORRECTION}")
    _require_kinds(path, empty_table, columns)


def schema_of(path: Path) -> pa.Schema:
    """Return the columns of a Parquet file; a UserError if it is damaged, no ordinary file, or has too many rows."""
    require_file(path)
    try:
        with pq.ParquetFile(path) as file:
            rows, schema = file.metadata.num_rows, file.schema_arrow
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read ({str(error)[:200]}): {REMEDY}") from error
    if rows > MAX_ROWS:
        raise UserError(f"{path} has {rows} rows, more than the {MAX_ROWS} that such a file can have")
    return schema


def _require_kinds(path: Path, table: pa.Table, columns: Mapping[str, Kind]) -> None:
    for name, (kind, holds) in columns.items():
        if not holds(table[name]):
            raise UserError(f"{path}: {name} does not hold {kind}: {CORRECTION}")


def vectors(column: Column, size: int, dtype: type[np.floating] = np.float32) -> Array | None:
    """Return numbers, or lists of them, as (N, size), NaN if missing; None if rows have another size."""
    rows = len(column)
    if _is_list(column.type):
        if not pc.all(pc.equal(pc.list_value_length(column), size)).as_py():
            return None
        column = pc.list_flatten(column)
    values = np.asarray(column.combine_chunks(), dtype)
    return values.reshape(rows, size) if values.size == rows * size else None


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the table of tasks with pandas metadata that make the task its index, as LeRobot expects."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object"), None: ("unicode", "object")}
    *columns, index = (
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, (kind, numpy) in kinds.items()
    )
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [index | {"metadata": {"encoding": "UTF-8"}}],
        "columns": columns,
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path, write_page_checksum=True)


def write_rows(path: Path, episodes: Sequence[Mapping[str, Array]]) -> None:
    """Write columns, each (N,) or (N, D), with a row group per episode.

    The schema metadata has the types that the package `datasets` needs. LeRobot reads a vector of one component as a
    number.
    """
    episodes = [{name: _without_unit_axis(values) for name, values in rows.items()} for rows in episodes]
    features = {name: _feature(values) for name, values in episodes[0].items()}
    metadata = {"huggingface": json.dumps({"info": {"features": features}})}
    tables = [pa.table({name: _arrow(values) for name, values in rows.items()}, metadata=metadata) for rows in episodes]
    with pq.ParquetWriter(path, tables[0].schema, compression="zstd", write_page_checksum=True) as writer:
        for table in tables:
            writer.write_table(table)


def _without_unit_axis(values: Array) -> Array:
    return values[:, 0] if values.shape[1:] == (1,) else values


def _feature(values: Array) -> dict[str, Any]:
    """Return the type of a column for `datasets`."""
    value = {"dtype": values.dtype.name, "_type": "Value"}
    return value if values.ndim == 1 else {"feature": value, "length": values.shape[1], "_type": "List"}


def _arrow(values: Array) -> pa.Array:
    flat = pa.array(values.ravel())
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
