"""Reader of untrusted tables of a LeRobot dataset: bounded in rows, and of the expected types."""

from __future__ import annotations

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
MEND = "correct the dataset, or write it again"  # where a copy cannot help
MOST_ROWS = 10_000_000  # of a file: 280 hours at 10 Hz
MOST_BYTES = 2**33  # to unpack at once
LONGEST = 1e6  # video [s]

Kind = Callable[[pa.ChunkedArray], bool]  # predicate of a column; its docstring is the expected type


def counts(column: pa.ChunkedArray) -> bool:
    """integers from 0 on"""
    return pa.types.is_integer(column.type) and _within(column, 0, 2**53)


def times(column: pa.ChunkedArray) -> bool:
    """seconds"""
    return pa.types.is_floating(column.type) and _within(column, 0, LONGEST)


def texts(column: pa.ChunkedArray) -> bool:
    """text"""
    return (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)) and not column.null_count


def numbers(column: pa.ChunkedArray) -> bool:
    """lists of numbers"""
    of = column.type.value_type if _is_list(column.type) else column.type
    return pa.types.is_floating(of) or pa.types.is_integer(of)


def pixels(column: pa.ChunkedArray) -> bool:
    """lists of lists of unsigned 16-bit integers"""
    nested = _is_list(column.type) and _is_list(column.type.value_type)
    return nested and bool(pa.types.is_uint16(column.type.value_type.value_type))


def pictures(column: pa.ChunkedArray) -> bool:
    """images, as the bytes of a file"""
    if not pa.types.is_struct(column.type) or column.type.get_field_index("bytes") < 0:
        return False
    content = column.type.field("bytes").type
    return pa.types.is_binary(content) or pa.types.is_large_binary(content)


def files(folder: Path) -> list[Path]:
    """Return the files of a table, in their order.

    Raises:
        UserError: there are none.
    """
    if found := sorted(folder.glob("chunk-*/file-*.parquet")):
        return found
    raise UserError(f"{folder} holds no tables: {REMEDY}")


def read(paths: Sequence[Path], columns: Mapping[str, Kind], only: Any = None) -> pa.Table:
    """Read the named columns of Parquet files, concatenated; `only` filters rows.

    Raises:
        UserError: a file is damaged, too large, or lacks a column of the expected type.
    """
    found = [_read(path, columns, only) for path in paths]
    try:
        return pa.concat_tables(found, promote_options="permissive")
    except pa.ArrowException as error:
        raise UserError(f"{paths[0]} and others beside it differ ({str(error)[:200]}): {MEND}") from error


def schema_of(path: Path) -> pa.Schema:
    """Return the columns of a Parquet file.

    Raises:
        UserError: it is damaged, no ordinary file, or has too many rows.
    """
    require_file(path)
    try:
        with pq.ParquetFile(path) as file:
            rows, schema = file.metadata.num_rows, file.schema_arrow
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read ({str(error)[:200]}): {REMEDY}") from error
    if rows > MOST_ROWS:
        raise UserError(f"{path} has {rows} rows, more than the {MOST_ROWS} that such a file can have")
    return schema


def require(path: Path, columns: Mapping[str, Kind]) -> None:
    """Require a Parquet file to have columns of the expected types; their values are not read.

    Raises:
        UserError: it has not, or cannot be read.
    """
    empty = schema_of(path).empty_table()
    if missing := [name for name in columns if name not in empty.column_names]:
        raise UserError(f"{path} lacks the columns {', '.join(missing)}: {MEND}")
    _require_kinds(path, empty, columns)


def _require_kinds(path: Path, table: pa.Table, columns: Mapping[str, Kind]) -> None:
    for name, is_kind in columns.items():
        if not is_kind(table[name]):
            raise UserError(f"{path}: {name} does not hold {is_kind.__doc__}: {MEND}")


def _read(path: Path, columns: Mapping[str, Kind], only: Any) -> pa.Table:
    require(path, columns)
    if (unpacked := _unpacked_size(path, columns, only is not None)) > MOST_BYTES:
        raise UserError(f"{path} unpacks to {unpacked / 1e9:.0f} GB, more than the {MOST_BYTES / 1e9:.0f} GB it may")
    try:
        table = pq.read_table(path, columns=[*columns], filters=only, page_checksum_verification=True)
        table.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        raise UserError(f"{path} cannot be read ({str(error)[:200]}): {REMEDY}") from error
    _require_kinds(path, table, columns)
    return table


def _unpacked_size(path: Path, columns: Collection[str], filtered: bool) -> int:
    """Estimate the decoded size of columns [bytes], summed over row groups or, if filtered, of the largest one.

    The estimate uses the metadata of the file; dictionary-encoded texts can take more memory.
    """
    metadata, sizes = pq.read_metadata(path), []
    for group in (metadata.row_group(number) for number in range(metadata.num_row_groups)):
        of = [group.column(number) for number in range(group.num_columns)]
        chosen = [each for each in of if any(f"{each.path_in_schema}.".startswith(f"{name}.") for name in columns)]
        sizes.append(sum(max(column.total_uncompressed_size, 8 * column.num_values) for column in chosen))
    return (max if filtered else sum)([0, *sizes])


def matrix(column: pa.ChunkedArray, size: int, dtype: type[np.floating] = np.float32) -> Array | None:
    """Return a column of `numbers` as (N, size); None if rows have another size. Missing numbers become NaN."""
    if _is_list(column.type) and not lists_have(column, size):
        return None
    flat = pc.list_flatten(column) if _is_list(column.type) else column
    values = np.asarray(flat.combine_chunks(), dtype)
    return values.reshape(-1, size) if len(values) == len(column) * size else None


def lists_have(column: pa.ChunkedArray, *sizes: int) -> bool:
    """Return whether all lists of a column have the first of the sizes, the lists in these the next, and so on."""
    for size in sizes:
        if not pc.all(pc.equal(pc.list_value_length(column), size)).as_py():
            return False
        column = pc.list_flatten(column)
    return True


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)


def _within(column: pa.ChunkedArray, low: float, high: float) -> bool:
    values = column.to_numpy()  # nulls become NaN
    return not column.null_count and bool(((values >= low) & (values <= high)).all())
