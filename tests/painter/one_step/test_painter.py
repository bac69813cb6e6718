"""The painter: any size in, the same size out; its inputs and its confidence."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.batches import stack_conditions
from lidarpainter_models.painter.one_step.config import (
    AS_SHIPPED,
    PAPER,
    WITH_REFERENCE,
    OneStepConfig,
)
from lidarpainter_models.painter.one_step.loading import load_one_step
from lidarpainter_models.painter.one_step.painter import painter_inputs, support


@pytest.fixture(scope="module")
def painter(model_folder):
    return load_one_step(f"{model_folder}:with-reference", dtype=torch.float32)


def test_edges_are_repeated_below_and_to_the_right(make_conditions):
    batch = stack_conditions([make_conditions(70, 130)], num_sources=2)
    images, masks = painter_inputs(batch, PAPER)
    assert masks is None
    assert images.shape == (2, 1, 3, 128, 192)
    assert torch.equal(images[0, ..., :70, :130], batch.render)
    assert torch.equal(images[0, ..., 100, :130], batch.render[..., 69, :])
    assert torch.equal(images[0, ..., :70, 180], batch.render[..., 129])


def test_lidar_enters_pure_or_over_the_render(make_conditions):
    conditions = make_conditions(64, 64)
    batch = stack_conditions([conditions], num_sources=2)
    found = {
        kind: painter_inputs(batch, replace(PAPER, lidar=kind))[0][1, 0].permute(1, 2, 0)
        for kind in ("pure", "over-render", "bright-over-render")
    }
    hit = conditions.lidar_hit
    assert torch.equal(found["pure"], conditions.lidar_rgb)
    assert torch.equal(found["over-render"][hit], conditions.lidar_rgb[hit])
    assert torch.equal(found["over-render"][~hit], conditions.render_rgb[~hit])
    bright = (conditions.lidar_rgb > 0.2).any(dim=-1)
    assert bool((hit & ~bright).any())
    assert torch.equal(found["bright-over-render"][bright], conditions.lidar_rgb[bright])
    assert torch.equal(found["bright-over-render"][~bright], conditions.render_rgb[~bright])
    assert AS_SHIPPED.lidar == "bright-over-render"


def test_the_reference_is_the_first_valid_warp_else_the_render(make_conditions):
    conditions = make_conditions(64, 64, 2)
    batch = stack_conditions([conditions], num_sources=2)
    warp = painter_inputs(batch, WITH_REFERENCE)[0][2, 0].permute(1, 2, 0)
    first, second = conditions.warp_valid
    assert torch.equal(warp[first], conditions.warp_rgb[0][first])
    assert torch.equal(warp[second & ~first], conditions.warp_rgb[1][second & ~first])
    neither = ~first & ~second
    assert torch.equal(warp[neither], conditions.render_rgb[neither])


def test_masks_are_shares_of_hits_in_each_cell(make_conditions):
    conditions = make_conditions(64, 64, 2)
    batch = stack_conditions([conditions], num_sources=2)
    _, masks = painter_inputs(batch, OneStepConfig(masks=True))
    assert masks.shape == (1, 2, 8, 8)
    expected = conditions.lidar_hit[8:16, :8].float().mean()
    torch.testing.assert_close(masks[0, 0, 1, 0], expected)
    expected = conditions.warp_valid.any(dim=0)[:8, 8:16].float().mean()
    torch.testing.assert_close(masks[0, 1, 0, 1], expected)


def test_confidence_asks_what_supports_the_colour(make_conditions):
    batch = stack_conditions([make_conditions(8, 8)], num_sources=0)
    hit = batch.lidar_hit[:, 0] > 0
    kept = support(batch, batch.render)
    assert bool((kept >= batch.render_alpha[:, 0] - 1e-6).all())
    by_lidar = support(batch, batch.lidar)
    torch.testing.assert_close(by_lidar[hit], torch.ones_like(by_lidar[hit]))
    invented = support(batch, 1 - batch.render)
    assert float(invented[~hit].mean()) < float(kept[~hit].mean())


def test_prompts_are_encoded_once_and_change_the_image(painter, make_conditions, monkeypatch):
    clear, night = (make_conditions(64, 64, prompt=prompt) for prompt in ("clear", "night"))
    images = [painter.paint(conditions).rgb for conditions in (clear, night)]
    assert not torch.equal(*images)
    import lidarpainter_models.painter.one_step.prompts as prompts

    def unwanted(*_):
        raise AssertionError("encoded twice")

    monkeypatch.setattr(prompts, "encode_text", unwanted)
    assert torch.equal(painter.paint(night).rgb, images[1])
    assert set(painter.prompts.encoded) == {"clear", "night"}


def test_a_prompt_without_a_text_encoder_is_one_line():
    from lidarpainter_models.painter.one_step.prompts import PromptBook

    book = PromptBook({"clear": torch.zeros(77, 16)})
    with pytest.raises(ConfigError, match=r"no prompt 'night' \(known: clear\)"):
        book.encode("night")


@pytest.mark.gpu
def test_a_graph_paints_what_the_network_paints(model_folder, make_conditions):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    conditions = make_conditions(70, 100)
    here = load_one_step(f"{model_folder}:paper", dtype=torch.float32).paint(conditions)
    there = load_one_step(f"{model_folder}:paper", dtype=torch.float32).to(torch.device("cuda"))
    for _ in range(2):  # captured, then replayed
        torch.testing.assert_close(there.paint(conditions).rgb, here.rgb, rtol=0, atol=2e-2)
