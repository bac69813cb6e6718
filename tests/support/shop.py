"""A store with a scene, two runs that share a fit, and what was made later from one of them."""

import copy
import shutil

from catalog.artefacts import Recipe
from catalog.code_closure import Code
from catalog.deletion import plan_deletion
from catalog.records import artefact_row
from catalog.store import open_store


class Shop:
    """See above."""

    def __init__(self, folder, address=None):
        self.store = open_store(address or folder / "store")
        scene = self.store.root / "scenes/toy/street"
        with self.store.scene_lock("toy/street"):
            scene.mkdir(parents=True)
            (scene / "manifest.json").write_text('{"content_digest": "scene-digest"}')
        row = {"scene_id": "toy/street", "content_digest": "scene-digest"}
        self.store.tables.merge("scenes", [row])
        self.fit = self.made("fit", scene="scene-digest")
        self.first = self.made("first", fit=self.fit.digest)
        self.second = self.made("second", fit=self.fit.digest)
        self.flicker = self.made("flicker", fitted=self.first.digest)
        self.run("r1", self.fit, self.first)
        self.run("r2", self.fit, self.second)
        weights = f"artefacts/{self.second.artefact_id}/w.safetensors"
        self.store.tables.merge("painters", [{"painter_id": "p1", "path": weights}])

    def copied(self, folder):
        """The same store at another place: making one takes a dozen commits."""
        shutil.copytree(self.store.root, folder / "store")
        other = copy.copy(self)
        other.store = open_store(folder / "store")
        return other

    def made(self, kind, **inputs):
        recipe = Recipe(kind=kind, inputs=inputs, config={}, code=Code(modules={}, starts=()))

        def build(place):
            (place.output / "data").write_bytes(b"-" * 1000)

        ref, _is_new = self.store.artefacts.produce(recipe, build)
        manifest = self.store.artefacts.manifest(ref)
        self.store.tables.merge("artefacts", [artefact_row(ref, manifest)])
        return ref

    def run(self, run_id, *refs, status="complete"):
        row = {"run_id": run_id, "scene_id": "toy/street", "status": status}
        artefacts = [ref.artefact_id for ref in refs]
        self.store.tables.merge("runs", [{**row, "artefacts": artefacts}])
        metric = {"metric_id": f"m-{run_id}", "run_id": run_id, "scene_id": "toy/street"}
        self.store.tables.merge("metrics", [{**metric, "name": "psnr", "value": 30.0}])

    def change(self, table, name, **values):
        self.store.tables.merge(table, [{**self.store.tables.row(table, name), **values}])

    def plan(self, table, name):
        return plan_deletion(self.store, table, self.store.row(table, name))

    def names(self, table):
        key = next(iter(self.store.tables.arrow(table).column_names))
        return {row[key].split("/")[0] for row in self.store.rows(table)}
