"""Compiled code on disk: two processes that save it at once never get each other's."""

import numba
import numpy as np
import pytest
from numba.core import caching

from lidarpainter_models.kernels.code_cache import KeyedCodeFiles
from lidarpainter_models.kernels.point_blend import cpu


def files_in(folder, *, stamp="source", kind=KeyedCodeFiles):
    return kind(str(folder), "module.function-1.py311", stamp)


@pytest.fixture
def saved_at_once(tmp_path):
    """Two writers who read the index before the other wrote it; the disk of the second is slow."""

    def saved(kind):
        first, second = (files_in(tmp_path, kind=kind) for _ in range(2))
        write_index, late = first._save_index, []

        def interrupted(index):
            second._save_data = lambda *entry: late.append(entry)
            second.save(("float64",), "code for float64")
            write_index(index)

        first._save_index = interrupted
        first.save(("float32",), "code for float32")
        files = files_in(tmp_path, kind=kind)
        for entry in late:
            files._save_data(*entry)
        return files

    return saved


def test_code_saved_at_once_is_never_that_for_other_types(saved_at_once):
    files = saved_at_once(KeyedCodeFiles)
    assert files.load(("float32",)) == "code for float32"
    assert files.load(("float64",)) is None  # lost: compiled once more


def test_numbas_own_files_mix_up_what_is_saved_at_once(saved_at_once):
    """The reason for files of our own: they go once this fails."""
    assert saved_at_once(KeyedCodeFiles.__base__).load(("float32",)) == "code for float64"


def test_changed_source_finds_no_older_code(tmp_path):
    files_in(tmp_path).save(("float32",), "older")
    changed = files_in(tmp_path, stamp="changed source")
    assert changed.load(("float32",)) is None
    changed.save(("float32",), "newer")
    assert files_in(tmp_path, stamp="changed source").load(("float32",)) == "newer"


def test_kernels_keep_their_code_so():
    assert caching.IndexDataCacheFile is KeyedCodeFiles
    assert isinstance(cpu._scatter._cache._cache_file, KeyedCodeFiles)


def test_code_is_found_again(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))  # numba reads it again as it compiles
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    body = "import numba\n@numba.njit(cache=True)\ndef twice(values):\n    return values * 2\n"
    (tmp_path / "doubling.py").write_text(body)
    monkeypatch.syspath_prepend(tmp_path)
    import doubling

    for dtype in ("float32", "float64"):
        assert doubling.twice(np.ones(3, dtype)).dtype == dtype
    assert len(list(tmp_path.rglob("*.nbc"))) == 2
    again = numba.njit(cache=True)(doubling.twice.py_func)
    assert again(np.ones(3, "float32")).dtype == "float32"
    assert sum(again.stats.cache_hits.values()) == 1
