"""numba's cache on disk, safe for processes that compile the same function at the same time.

numba numbers the compiled code of a function in the order of its argument types. Two processes that
save code for different types at once both take the next number: the index then leads to code for
other types, which reads past the end of arrays or computes nonsense (numba's issues 4807 and
10128). Test workers and the runs of a fleet do compile at once.
"""

import hashlib
from collections.abc import Hashable

from numba.core import caching


class KeyedCodeFiles(caching.IndexDataCacheFile):
    """Files of compiled code, named by the argument types and the source that they were made for.

    The index is written after the code. An entry that another process wrote at the same time may be
    lost, and its code is compiled once more.
    """

    def save(self, key: Hashable, data: object) -> None:
        """Keep compiled code.

        Args:
            key: Argument types, machine and bytecode, as numba tells them apart.
            data: The code, for pickle.
        """
        made_for = hashlib.sha256(repr((key, self._source_stamp)).encode()).hexdigest()[:16]
        name = self._index_name.replace(".nbi", f".{made_for}.nbc")
        self._save_data(name, data)
        self._save_index({**self._load_index(), key: name})


def keep_code_by_key() -> None:
    """Have every function that is compiled from here on keep its code in `KeyedCodeFiles`."""
    caching.IndexDataCacheFile = KeyedCodeFiles  # type: ignore[misc]  # numba has no other door
