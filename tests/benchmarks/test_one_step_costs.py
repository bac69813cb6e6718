"""Parameters, arithmetic and bytes at full size, counted on the meta device."""

import pytest
import torch
from one_step_costs import count_bytes, count_parameters, count_tflop
from turbo_shapes import SD_TURBO

from lidarpainter_models.painter.one_step.architectures import build_tiny
from lidarpainter_models.painter.one_step.config import FAST, PAPER, PRESETS


def test_parameters_are_sd_turbos():
    counts = count_parameters(PAPER)
    assert counts["unet"] == 865_910_724
    assert counts["first_layer_added"] == 320 * 4 * 9
    assert counts["autoencoder"] == 83_653_863
    assert counts["text_encoder"] == 340_387_840
    assert counts["skips"] == 512 * 512 + 256 * 512 + 128 * 512 + 128 * 256
    with torch.device("meta"):
        tiny = build_tiny(SD_TURBO)
    assert sum(parameter.numel() for parameter in tiny.parameters()) == 2_445_063


def test_arithmetic_at_the_papers_size_is_the_computed_floor():
    whole = count_tflop(PAPER, height_px=576, width_px=1024)
    assert whole["total"] == pytest.approx(13.2, rel=0.02)
    assert whole["denoise"] == pytest.approx(2.149, rel=0.01)
    assert whole["encode"] == pytest.approx(5.218, rel=0.01)
    tiny = count_tflop(FAST, height_px=576, width_px=1024)
    assert tiny["total"] == pytest.approx(3.0, rel=0.02)


@pytest.mark.parametrize("preset", PRESETS)
def test_what_training_changes_fits_in_20_mb(preset):
    header = 150_000  # 664 names of tensors take 102 kB; settings, provenance
    assert count_bytes(PRESETS[preset])["trained_file"] + header < 20e6
