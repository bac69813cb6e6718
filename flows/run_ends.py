"""Runs that end early are entered as such: failed or interrupted."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from catalog.records import RunRecord
from flows.interruption import at_interruption
from tasks.reconstruction.publish import end_run


@contextmanager
def early_end_recorded(store_path: Path, record: RunRecord) -> Iterator[None]:
    """Enter into the catalog that a run failed or was interrupted, and let the error go on."""
    interrupted = partial(end_run.fn, store_path, record, "interrupted", None)  # asks no server
    with at_interruption(interrupted):
        try:
            yield
        except Exception as error:
            end_run(store_path, record, "failed", f"{type(error).__name__}: {error}")
            raise
