"""Where the actors of an edit come from: other runs, the library of assets, files."""

from dataclasses import dataclass, replace
from pathlib import Path

from catalog.artefacts import ArtefactRef
from catalog.assets import find_asset
from catalog.digests import canonical_json, digest_file, digest_text
from catalog.store import Store
from lidarpainter_models.assets.asset_files import read_asset
from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.editing.motions import LogTimes
from lidarpainter_models.editing.script import ActorSource
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.model.ply_files import read_ply
from lidarpainter_models.scenes.driving_scene import driven_road
from tasks.opened import open_scene
from tasks.runs import FinishedRun, open_run
from tasks.stored import load_observations, load_scene

PARKED = "parked"
"""What the summary of edited observations calls those that are still part of the street."""
CATEGORY = "car"
"""The category of an actor from a file, which does not say one."""


@dataclass(frozen=True, kw_only=True)
class LibraryActor:
    """The files of an actor of the library of assets."""

    path: Path
    digest: str
    """Digest of the files, which may become others when the actor is seen better."""

    @classmethod
    def named(cls, store: Store, name: str) -> "LibraryActor":
        """An actor by the id of its asset, or a unique prefix of one.

        Raises:
            UnknownRecordError: there is none, or several begin so.
            DamagedArtefactError: its files are not what was written.
            ConfigError: it is no actor, or has no files.
        """
        row = find_asset(store, name)
        if row["kind"] != "actor":
            raise ConfigError(f"asset {row['asset_id']} is a {row['kind']}, expected an actor")
        ref = ArtefactRef.of_id(row["artefact_id"])
        files = store.artefacts.verified(ref).files
        own = {file: one for file, one in files.items() if file.startswith(f"{row['folder']}/")}
        if not own:
            raise ConfigError(f"asset {row['asset_id']} has no files in {row['artefact_id']}")
        path = store.artefacts.folder(ref) / row["folder"]
        return cls(path=path, digest=digest_text(canonical_json(own)))


Donor = FinishedRun | LibraryActor | Path
"""What an actor is taken out of: another run, an asset, or a file with Gaussians."""


def donor_of(store: Store, source: ActorSource) -> Donor | None:
    """What an actor is taken out of; None is the edited run itself.

    The store is the one that the source names, or that of the edited run.

    Raises:
        ConfigError: a file is not there, an asset is no actor, or a store is named without a run.
        UnknownRecordError: there is no such run or asset.
    """
    if source.ply is not None:
        path = Path(source.ply)
        if not path.is_file():
            raise ConfigError(f"no file {path}, expected Gaussians as PLY")
        return path
    if source.asset is not None:
        return LibraryActor.named(store, source.asset)
    if source.run is None:
        if source.store is not None:
            raise ConfigError("a store without a run, expected both or neither")
        return None
    return open_run(store, source.run)


def model_of(store: Store, source: ActorSource) -> ActorModel:
    """What an actor of another run, of the library or of a file looks like."""
    donor = donor_of(store, source)
    if isinstance(donor, FinishedRun):
        world = opened_world(store, donor)
        return world.model_of(world.find(str(source.actor)))
    if isinstance(donor, LibraryActor):
        return read_asset(donor.path).with_points_all_round()
    if donor is None:
        raise ConfigError("the edited run's own actors are found in its world, not in another")
    return ActorModel.of_gaussians(read_ply(donor), CATEGORY)


def digests_of(part: str, donor: Donor | None) -> dict[str, str]:
    """Digests of what is read of a donor, by the part that it plays."""
    if donor is None:
        return {}
    if isinstance(donor, LibraryActor):
        return {part: donor.digest}
    if isinstance(donor, Path):
        return {part: digest_file(donor)}
    seen, fitted = donor.final.observations, donor.final.gaussians
    return {part: fitted.digest, f"{part}-observations": seen.digest}


def opened_world(store: Store, run: FinishedRun) -> EditedWorld:
    """A finished run, ready to be edited."""
    scene = open_scene(store, run.scene_id)
    seen = load_observations(store, run.final.observations)
    # what is mended is mended by day
    fitted = replace(load_scene(store, run.final.gaussians), style=None)
    bodies = {track.actor_id for track in fitted.actors.recorded_tracks}
    parked = [track for track in scene.tracks if not track.is_moving]
    left = store.artefacts.manifest(run.final.observations).summary.get(PARKED)
    return EditedWorld(
        scene=fitted,
        fitted=fitted,
        lidar_map=seen.lidar_map,
        views=seen.views,
        parked=tuple(
            track
            for track in parked
            if track.actor_id not in bodies and (left is None or track.actor_id in left)
        ),
        log=LogTimes(ego=driven_road(scene)),
    )
