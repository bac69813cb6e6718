"""Read rows out of the Parquet files of a table, and of few files if few rows are wanted."""

from collections.abc import Collection, Mapping
from functools import reduce

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds


def read_rows(
    there: ds.Dataset, wanted: pa.Schema, where: Mapping[str, Collection[str]] | None
) -> pa.Table:
    """The rows of a dataset in the columns of a schema; a column that it lacks is null.

    `where` takes rows with one of some values in any of these columns, None all. Of each file only
    these columns are read, and of those with such a row the wanted ones.
    """
    names = [name for name in wanted.names if name in there.schema.names]
    # pyarrow's threads may outlive the read and abort the interpreter as it ends
    if where is None:
        stored = there.to_table(columns=names, use_threads=False)
    else:
        stored = _matching(there, names, where)
    columns = [
        stored[field.name].cast(field.type)
        if field.name in names
        else pa.nulls(stored.num_rows, field.type)
        for field in wanted
    ]
    return pa.table(columns, schema=wanted)


def _matching(
    there: ds.Dataset, names: list[str], where: Mapping[str, Collection[str]]
) -> pa.Table:
    found = [there.schema.empty_table().select(names)]
    asked = {name: values for name, values in where.items() if name in there.schema.names}
    for fragment in there.get_fragments() if any(asked.values()) else ():
        # without a filter of Arrow's, which cannot compare the statistics of Delta's texts
        keys = fragment.to_table(there.schema, list(asked), use_threads=False)
        hits = (
            pc.is_in(keys[name], value_set=pa.array(values, keys[name].type))
            for name, values in asked.items()
        )
        mask = reduce(pc.or_, hits)
        if pc.any(mask).as_py():
            rows = fragment.to_table(there.schema, names, use_threads=False)
            found.append(rows.filter(mask))
    return pa.concat_tables(found)
