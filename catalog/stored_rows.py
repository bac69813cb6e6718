"""Read rows out of the Parquet files of a table, and of few files if few rows are wanted.

Files are read on the caller's thread alone. Arrow's own threads hold files that Delta Lake opens in
Python; one that lets go of such a file as the interpreter ends aborts the process.
"""

from collections.abc import Collection, Mapping
from functools import reduce

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

SMALL_BYTES = 1 << 20
"""A file up to this size is read whole: from a bucket that takes as long as one of its columns."""


def read_rows(
    there: ds.Dataset, wanted: pa.Schema, where: Mapping[str, Collection[str]] | None
) -> pa.Table:
    """The rows of a dataset in the columns of a schema; a column that it lacks is null.

    `where` takes rows with one of some values in any of these columns, None all. Of each file that
    is not small only these columns are read, and of those with such a row the wanted ones.
    """
    asked = {name: values for name, values in (where or {}).items() if name in there.schema.names}
    if where is not None and not any(asked.values()):
        return wanted.empty_table()
    keys = pa.schema([there.schema.field(name) for name in asked])
    found = [wanted.empty_table()]
    for fragment in there.get_fragments():
        with fragment.open() as file, _parquet(file) as parquet:
            if where is None:
                found.append(_read(parquet, wanted))
            # compared here, as Arrow cannot compare the statistics of Delta's texts
            elif pc.any(mask := _has_one_of(_read(parquet, keys), asked)).as_py():
                found.append(_read(parquet, wanted).filter(mask))
    return pa.concat_tables(found)


def _parquet(file: pa.NativeFile) -> pq.ParquetFile:
    """A file to read columns of; a small one is read at once."""
    source = pa.BufferReader(file.read()) if file.size() <= SMALL_BYTES else file
    return pq.ParquetFile(source, pre_buffer=False)


def _read(parquet: pq.ParquetFile, wanted: pa.Schema) -> pa.Table:
    """A file in the columns of a schema; null where the file is older than a column."""
    names = [name for name in wanted.names if name in parquet.schema_arrow.names]
    read = parquet.read(names, use_threads=False)
    columns = [
        read[field.name].cast(field.type)
        if field.name in names
        else pa.nulls(parquet.metadata.num_rows, field.type)
        for field in wanted
    ]
    return pa.table(columns, schema=wanted)


def _has_one_of(keys: pa.Table, asked: Mapping[str, Collection[str]]) -> pa.Array:
    """Which rows have one of some values in any of these columns."""
    return reduce(
        pc.or_,
        (
            pc.is_in(keys[name], value_set=pa.array(values, keys[name].type))
            for name, values in asked.items()
        ),
    )
