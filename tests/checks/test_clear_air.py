"""Rain before a LiDAR is named, dry air is not."""

import pytest
import torch

from lidarpainter_models.checks.sweeps import check_clear_air
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig, record_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS


@pytest.mark.parametrize(
    ("share", "verdict_then", "says"),
    [
        (0.003, "ok", "stand alone"),
        (0.02, "ok", "stand alone: they are left out where they are many"),
        (0.06, "warn", "stand alone, as of rain, snow or spray: they are left out"),
    ],
)
def test_rain_is_named_and_dry_air_is_not(tmp_path, share, verdict_then, says):
    config = SyntheticStreetConfig(
        seed=7, num_frames=3, width_px=64, height_px=36, cameras=DEFAULT_CAMERAS[:1]
    )
    scene = DrivingScene.open(record_street(SyntheticStreet(config), tmp_path))
    verdict, detail = check_clear_air(scene)
    assert verdict == "ok"
    assert detail.endswith("of the returns 3 to 40 m away stand alone")
    assert 0 < float(detail.partition("%")[0]) < 0.6

    whole, generator = scene.read_column, torch.Generator().manual_seed(0)

    def rained(sweep, name):
        column = whole(sweep, name)
        if name != "xyz_m":
            return column
        origin = sweep.world_from_lidar[:3, 3].to(column)
        stops = torch.rand(len(column), 1, generator=generator)
        is_drop = torch.rand(len(column), 1, generator=generator) < share
        return torch.where(is_drop, origin + stops * (column - origin), column)

    scene.read_column = rained
    verdict, detail = check_clear_air(scene)
    assert verdict == verdict_then
    assert detail.endswith(says)
