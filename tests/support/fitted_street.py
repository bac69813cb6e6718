"""A synthetic street, fitted to every second frame and judged on the others."""

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import write_street


class FittedStreet:
    """A fit of a street, and the held-out images it is judged on."""

    def __init__(self, street, folder, config, **observed):
        size = ObservationConfig(width_px=street.width_px, **observed)
        recording = DrivingScene.open(write_street(street, folder / f"seed-{config.seed}"))
        split = split_views(recording, "alternate", None)
        seen = prepare_observations(recording, split, size)
        self.scene = fit_gaussians(seen, config).scene
        self.held_out = HeldOut(scene=recording, test_views=split.test, observation=size)

    def shown(self, held_out=None):
        """Camera, truth and render of every held-out view, its own or those of a twin."""
        for view in (held_out or self.held_out).recorded_views(self.scene, "interpolated"):
            name = view.name.partition("/")[0]
            image = self.scene.render(view.camera, view.timestamp_ns, camera_name=name).rgb
            yield name, view, image.clamp(0, 1)
