"""Painting only what needs it: kept tiles are the render bit for bit, the others are painted."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.examples import Window
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.painter import (
    UNKNOWN_DOUBT,
    NanoPainter,
    doubt,
    doubtful_tiles,
    painted_parts,
)

KEEP_BELOW = 0.01


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    network = NanoNetwork(NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1)))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return network


@pytest.fixture
def one_doubt(make_conditions):
    """All that is known agrees, but for one pixel of the LiDAR in the second row of tiles."""
    old = make_conditions(160, 192)
    everywhere = torch.ones_like(old.warp_valid)
    lidar = old.render_rgb.clone()
    lidar[40, 80] = 1 - lidar[40, 80].round()
    return replace(
        old,
        lidar_rgb=lidar,
        lidar_hit=torch.ones_like(old.lidar_hit),
        warp_rgb=old.render_rgb.expand_as(old.warp_rgb).clone(),
        warp_valid=everywhere,
    )


def test_doubt_is_the_mean_difference_of_what_is_known(make_conditions):
    old = make_conditions(4, 4)
    valid = torch.zeros_like(old.warp_valid)
    valid[0, 0, 0] = True
    warp = torch.zeros_like(old.warp_rgb)
    warp[0, 0, 0] = old.render_rgb[0, 0] + 0.3
    hit = torch.zeros_like(old.lidar_hit)
    hit[0, :2] = True
    lidar = old.render_rgb + 0.1
    found = doubt(replace(old, warp_rgb=warp, warp_valid=valid, lidar_rgb=lidar, lidar_hit=hit))
    assert float(found[0, 0]) == pytest.approx(0.2)
    assert float(found[0, 1]) == pytest.approx(0.1)
    assert float(found[3, 3]) == pytest.approx(UNKNOWN_DOUBT)


def test_only_the_tile_with_a_doubt_is_painted(network, one_doubt):
    assert doubtful_tiles(one_doubt, 1e-4).nonzero().tolist() == [[1, 2]]
    painter = NanoPainter(network, precision=torch.float32, keep_below=1e-4)
    painting = painter.paint(one_doubt)
    inside = torch.zeros(160, 192, dtype=torch.bool)
    inside[32:64, 64:96] = True
    assert torch.equal(painting.rgb[~inside], one_doubt.render_rgb[~inside])
    assert not torch.allclose(painting.rgb[inside], one_doubt.render_rgb[inside], atol=0.01)
    assert painting.kept_share == pytest.approx(1 - 32**2 / (160 * 192))
    assert float(painting.confidence[~inside].min()) == 1


def test_doubt_everywhere_paints_as_without_tiles(network, make_conditions):
    conditions = make_conditions(40, 56)
    whole = NanoPainter(network, precision=torch.float32).paint(conditions)
    tiled = NanoPainter(network, precision=torch.float32, keep_below=KEEP_BELOW).paint(conditions)
    assert torch.equal(whole.rgb, tiled.rgb)
    assert tiled.kept_share == 0


def test_what_agrees_everywhere_is_not_painted_at_all(network, one_doubt):
    conditions = replace(one_doubt, lidar_rgb=one_doubt.render_rgb)
    painting = NanoPainter(network, precision=torch.float32, keep_below=KEEP_BELOW).paint(
        conditions
    )
    assert torch.equal(painting.rgb, conditions.render_rgb)
    assert painting.kept_share == 1


def test_a_part_has_a_border_that_ends_at_the_image():
    tiles = torch.zeros(6, 10, dtype=torch.bool)
    tiles[0, 0] = tiles[5, 9] = True
    parts = painted_parts(tiles, 180, 320)
    assert parts == [
        (Window(0, 0, 64, 64), Window(0, 0, 32, 32)),
        (Window(128, 256, 52, 64), Window(160, 288, 20, 32)),
    ]


def test_pieces_whose_boxes_overlap_become_one():
    tiles = torch.zeros(8, 20, dtype=torch.bool)
    tiles[1, 1:4] = tiles[1:4, 1] = True
    tiles[3, 3] = True
    assert [part.changed for part in painted_parts(tiles, 256, 640)] == [Window(32, 32, 96, 96)]


def test_many_parts_cost_more_than_the_whole_image():
    tiles = torch.zeros(6, 6, dtype=torch.bool)
    tiles[::2, ::2] = True
    assert painted_parts(tiles, 192, 192) == [(Window(0, 0, 192, 192), Window(0, 0, 192, 192))]


def test_a_style_paints_every_pixel(one_doubt):
    torch.manual_seed(0)
    config = NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1), prompts=("clear", "foggy"))
    painter = NanoPainter(NanoNetwork(config), precision=torch.float32, keep_below=KEEP_BELOW)
    assert painter.paint(replace(one_doubt, prompt="foggy")).kept_share == 0
    assert painter.paint(replace(one_doubt, prompt="clear")).kept_share == 1


def test_a_negative_limit_is_refused(network):
    with pytest.raises(ConfigError, match="keep_below"):
        NanoPainter(network, keep_below=-1)
