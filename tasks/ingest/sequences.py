"""Which sequences of a dataset are meant."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from lidarpainter_models.errors import DataError, LidarPainterError
from lidarpainter_models.readers import CANONICAL, known_datasets, list_sequences, scene_id_of
from lidarpainter_models.scenes.schema import MANIFEST_NAME
from tasks.ingest.bucket_roots import is_in_bucket, root_at_hand, sequences_in_bucket


def find_sequences(dataset: str, root: Path, named: Sequence[str] = ()) -> list[str]:
    """The sequences that were named, each once, or all that are found below a root or address.

    Raises:
        DataError: the dataset is not known, none is found, or the root is part of a dataset: then
            the folder above is named.
    """
    if is_in_bucket(root):
        return list(dict.fromkeys(named or sequences_in_bucket(root)))
    found: tuple[str, ...] = ()
    with suppress(DataError):
        found = list_sequences(dataset, root)
    parent = Path(root).absolute().parent
    if not found and dataset in known_datasets() and parent != parent.parent:
        above: tuple[str, ...] = ()
        with suppress(LidarPainterError, OSError):
            above = list_sequences(dataset, parent)
        if above:
            raise DataError(
                f"{root}: expected the root of {dataset}, use its parent {parent}, "
                f"which holds {_some(above)}"
            )
    return list(dict.fromkeys(named or found or list_sequences(dataset, root)))


def find_scene_id(dataset: str, root: Path, sequence: str) -> str:
    """What a sequence will be called in a store; see `readers.scene_id_of`.

    Raises:
        DataError: it is a scene from elsewhere whose manifest says no names.
        StorageError: the bucket does not answer.
    """
    if dataset != CANONICAL:
        return f"{dataset}/{sequence}"
    with root_at_hand(root, sequence, only=MANIFEST_NAME) as folder:
        return scene_id_of(dataset, folder, sequence)


def _some(names: Sequence[str], most: int = 5) -> str:
    return ", ".join([*names[:most], *(["..."] if len(names) > most else [])])
