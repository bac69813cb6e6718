"""Content-addressed artefacts of a bucket, made and read in its mirror.

An artefact is made in the mirror as in a folder, and published from there. Two machines that make
one at once both compute it: the first that is done counts, the other goes on with that one. The
processes of one machine wait for each other, as in a folder. Scratch stays on the machine, so what
another one takes over begins anew. Whether an artefact is complete is asked of the bucket.
"""

from collections.abc import Collection
from pathlib import Path

from catalog.artefacts import MANIFEST_NAME, ArtefactRef, ArtefactStore, Build, Manifest, Recipe
from catalog.errors import DamagedArtefactError
from catalog.mirrors import Mirror


class MirroredArtefacts(ArtefactStore):
    """The artefacts of the bucket behind a mirror."""

    def __init__(self, mirror: Mirror) -> None:
        super().__init__(mirror.root)
        self._mirror = mirror

    def files(self, ref: ArtefactRef, names: Collection[str] | None = None) -> Path:
        """Folder of an artefact with all its files or the named ones, checked as they came; in use.

        Raises:
            UnknownRecordError: the bucket has no such artefact.
            DamagedArtefactError: a file in the bucket is not what was published.
        """
        return self._mirror.fetch(ref.entry, names)

    def ids(self) -> set[str]:
        """The id of every artefact that is published."""
        return {name.removeprefix("artefacts/") for name in self._mirror.entries("artefacts")}

    def is_complete(self, ref: ArtefactRef) -> bool:
        """Whether the bucket has all its files at their sizes; none is fetched."""
        try:
            listing = self._mirror.listing(ref.entry)
        except DamagedArtefactError:
            return False
        return listing is not None and self._mirror.is_whole(ref.entry, listing)

    def manifest(self, ref: ArtefactRef) -> Manifest:
        """The manifest of a published artefact, which alone is fetched.

        Raises:
            UnknownRecordError: there is no such artefact.
            DamagedArtefactError: its manifest cannot be read.
        """
        self._mirror.fetch(ref.entry, [MANIFEST_NAME])
        return super().manifest(ref)

    def _place(self, ref: ArtefactRef, folder: Path) -> None:
        """Publish a folder, in place of a damaged artefact if there is one."""
        before = self._mirror.version(ref.entry)
        self._mirror.forget(ref.entry)
        super()._place(ref, folder)
        self._mirror.publish(ref.entry, replacing=before)

    def _build(self, recipe: Recipe, build: Build) -> bool:
        """Make it here, then publish it, in place of a damaged one if there is one."""
        entry = ArtefactRef(recipe.kind, recipe.digest).entry
        before = self._mirror.version(entry)
        self._mirror.forget(entry)
        super()._build(recipe, build)
        return self._mirror.publish(entry, replacing=before)
