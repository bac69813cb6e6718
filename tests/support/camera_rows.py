"""The table of cameras of a stored scene, which says more than a view: lenses and shutters."""

import pyarrow.parquet as pq


def camera_rows(scene):
    """One row per view, by the view's index."""
    return pq.read_table(scene.path / "cameras.parquet").to_pylist()
