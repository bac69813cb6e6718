"""Parquet files whose footer says less than their pages hold."""

import pyarrow.parquet as pq

STATED_BYTES = 1000


def understate(path):
    """Write another footer that says a thousand bytes of every group of rows and column."""
    footer, content = pq.read_metadata(path), path.read_bytes()
    begin = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    said = content[begin:-8]
    groups = [footer.row_group(number) for number in range(footer.num_row_groups)]
    columns = [group.column(index) for group in groups for index in range(group.num_columns)]
    sizes = {column.total_uncompressed_size for column in columns}
    for size in {*sizes, *(group.total_byte_size for group in groups)}:
        if size > 2**16:
            true = _varint(2 * size)
            said = said.replace(true, _varint(2 * STATED_BYTES, num_bytes=len(true)))
    path.write_bytes(content[:begin] + said + content[-8:])
    told = pq.read_metadata(path)
    assert all(told.row_group(n).total_byte_size == STATED_BYTES for n in range(len(groups)))


def _varint(number, num_bytes=None):
    """As Thrift writes it; in so many bytes, which need not be the fewest."""
    num_bytes = num_bytes or -(-number.bit_length() // 7)
    parts = [(number >> 7 * place) & 127 for place in range(num_bytes)]
    return bytes([*(part | 128 for part in parts[:-1]), parts[-1]])
