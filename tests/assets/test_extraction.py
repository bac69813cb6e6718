"""What is taken out of a scene, in its own frame and in neutral exposure."""

import csv
import json

import cv2
import pytest
import torch
from gaussian_world import round_gaussians
from parked_world import PARKED, RED, SIZE_M, clip

from lidarpainter_models.assets.asset_files import ABOUT_FILE, ORIGIN_FILE, read_asset
from lidarpainter_models.assets.extraction import WAYPOINTS_FILE, write_assets
from lidarpainter_models.assets.street_blocks import BLOCK_M, street_blocks
from lidarpainter_models.assets.turntables import HEIGHT_PX, NUM_AZIMUTHS, WIDTH_PX, turntable
from lidarpainter_models.editing.actor_models import NEUTRAL_ROAD_RGB
from lidarpainter_models.errors import DataError
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import transform_points
from lidarpainter_models.storage.tensor_files import read_tensors


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("assets")
    return folder, write_assets(clip(), folder)


def of_kind(records, kind):
    return [record for record in records if record["kind"] == kind]


@pytest.mark.slow
def test_a_parked_car_comes_out_whole_and_in_its_box_frame(written):
    folder, records = written
    (car,) = of_kind(records, "actor")
    assert (car["actor_id"], car["is_moving"]) == (PARKED, False)
    model = read_asset(folder / car["folder"])
    assert len(model.gaussians) == car["num_gaussians"] > 500
    assert bool((model.gaussians.means.abs() <= SIZE_M / 2 + 0.16).all())
    assert len(model.points) == car["num_points"] > 500
    assert [car["x_m"], car["y_m"], car["z_m"]] == pytest.approx(
        [1e6 + 7, 1.8, 0.55], abs=1e-6, rel=0
    )
    assert car["heading_rad"] == pytest.approx(0.2)
    assert "rear" in car["sides"]
    assert "front" not in car["sides"]
    strip = cv2.imread(str(folder / car["thumbnail"]))
    assert strip.shape == (HEIGHT_PX, NUM_AZIMUTHS * WIDTH_PX, 3)


def test_the_street_has_no_cars_and_every_gaussian_once(written):
    folder, records = written
    (car,) = of_kind(records, "actor")
    models = [read_asset(folder / record["folder"]) for record in of_kind(records, "street")]
    street = clip().world.scene.gaussians
    assert sum(len(model.gaussians) for model in models) == len(street) - car["num_gaussians"]
    grey = torch.cat([model.gaussians.base_rgb for model in models])
    assert torch.allclose(grey, torch.tensor(NEUTRAL_ROAD_RGB).expand_as(grey), atol=0.01)


def test_a_scene_recorded_a_third_brighter_gives_the_same_colours(tmp_path):
    """To within what eight bits of a road's colour leave open: half a step of 77 is 0.7 %."""
    colours = []
    for exposure in (1.0, 1.3, 0.7):
        folder = tmp_path / str(exposure)
        records = write_assets(clip(exposure=exposure), folder)
        (car,) = of_kind(records, "actor")
        colours.append(read_asset(folder / car["folder"]).gaussians.base_rgb)
    for other in colours[1:]:
        assert float((other / colours[0].clamp(min=1e-3) - 1).abs().max()) < 0.015
    assert torch.allclose(colours[0].mean(0), RED * 0.4 / 0.3, atol=0.03)  # of a road of 0.3


def test_a_trajectory_begins_at_its_own_origin(written):
    folder, records = written
    (way,) = of_kind(records, "trajectory")
    with (folder / way["folder"] / WAYPOINTS_FILE).open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["x_m"]) for row in rows] == pytest.approx([0, 0.3, 0.6, 0.9])
    assert way["length_m"] == pytest.approx(0.9)


def test_blocks_hold_what_lies_beside_them():
    """A path along x: a block is 20 m of it, its frame in the middle of the road there."""
    times = torch.arange(50)
    poses = torch.eye(4, dtype=torch.float64).repeat(50, 1, 1)
    poses[:, 0, 3] = times
    path = DrivenPath(timestamps_ns=times * 100_000_000, world_from_body=poses)
    places = torch.rand(3000, 3, generator=torch.Generator().manual_seed(1))
    places = (places - torch.tensor([0.0, 0.5, 0.0])) * torch.tensor([60.0, 40.0, 5.0])
    street = round_gaussians(places, torch.full((3000, 3), 0.5), sigma_m=0.1)
    blocks = street_blocks(street, path)
    assert [block.number for block in blocks] == [0, 1, 2]
    for block in blocks:
        expected = places[(places[:, 0] // BLOCK_M) == block.number]
        back = carried_gaussians(block.gaussians, block.world_from_block).means
        assert torch.allclose(back, expected, atol=1e-4)
        middle = transform_points(block.world_from_block, torch.zeros(1, 3).double())
        assert middle[0].tolist() == pytest.approx([(block.number + 0.5) * BLOCK_M, 0, 0])


def test_a_turntable_begins_ahead_and_goes_to_the_left():
    """A red front, a green left, a blue rear."""
    places = torch.tensor([[2.0, 0, 0], [0, 1, 0], [-2, 0, 0]])
    colours = torch.eye(3) * 0.9
    strip = turntable(
        round_gaussians(places, colours, sigma_m=0.3, opacity=0.99), torch.tensor([4.0, 2.0, 1.5])
    )
    for azimuth, channel in ((0, 0), (2, 1), (4, 2)):
        part = strip[:, azimuth * WIDTH_PX : (azimuth + 1) * WIDTH_PX]
        middle = part[HEIGHT_PX // 2, WIDTH_PX // 2]
        assert int(middle.argmax()) == channel


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"category": "car", "size_m": [1], "road_rgb": null}']
)
def test_a_damaged_asset_is_one_line(tmp_path, text):
    (tmp_path / ABOUT_FILE).write_text(text)
    with pytest.raises(DataError, match=ABOUT_FILE):
        read_asset(tmp_path)


def test_what_is_known_stands_beside_the_files(written):
    folder, records = written
    (car,) = of_kind(records, "actor")
    about = json.loads((folder / car["folder"] / ABOUT_FILE).read_text())
    assert about["sides"] == car["sides"]
    assert len(about["looks"]) == car["num_views"] == 4
    tensors, _ = read_tensors(folder / car["folder"] / ORIGIN_FILE)
    assert tensors["origin"].tolist() == [0] * car["num_gaussians"]  # no surface: seen, all of it
    assert (car["seen_share"], car["mirrored_share"], car["guessed_share"]) == (1.0, 0.0, 0.0)
