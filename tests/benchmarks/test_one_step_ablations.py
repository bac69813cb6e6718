"""Ablations of the one-step painter: one choice at a time, every wiring once."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from one_step_ablations import wirings_by_choice
from random_pairs import write_pairs
from tiny_diffusion import write_model

from lidarpainter_models.painter.one_step.config import PAPER, PRESETS
from lidarpainter_models.painter.one_step.latent_fusion import LatentFusion

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = Path(__file__).with_name("bench_one_step.py")


@pytest.mark.parametrize("preset", PRESETS)
def test_every_table_holds_the_wiring_itself_and_can_be_built(preset):
    config = PRESETS[preset]
    tables = wirings_by_choice(config)
    for wirings in tables.values():
        assert config in wirings.values()
        assert len(set(wirings.values())) == len(wirings) > 1
        for wiring in wirings.values():
            if wiring.fusion is not None:
                LatentFusion(wiring.fusion, len(wiring.inputs))  # refuses what it cannot weigh


def test_a_table_varies_one_choice():
    config = PAPER
    tables = wirings_by_choice(config)
    fields = {"t": "timestep", "step": "denoise", "skips": "skips", "lidar": "lidar"}
    for choice, field in fields.items():
        for wiring in tables[choice].values():
            same = {**wiring.to_dict(), field: None}
            assert same == {**config.to_dict(), field: None}
    assert tables["fusion"]["off"].fusion is None
    assert tables["fusion"]["off"].inputs == config.inputs


@pytest.mark.slow
def test_every_wiring_of_a_model_is_trained_and_judged(tmp_path):
    model = write_model(tmp_path / "small-turbo")
    folders = {"--train": range(2), "--test": range(5, 6)}
    words = ["ablation", str(model)]
    for option, frames in folders.items():
        write_pairs(tmp_path / option, frames, height_px=64, width_px=80)
        words += [option, str(tmp_path / option)]
    for setting in ("steps=1", "loss.lpips=0", "loss.adversarial=0", "accumulated_batches=1"):
        words += ["--set", f"training.{setting}"]
    words += ["--set", "training.augmentation.crop_px=64"]
    answer = subprocess.run(
        [sys.executable, SCRIPT, *words],
        env=os.environ | {"PYTHONPATH": str(ROOT), "LIDARPAINTER_STORE": str(tmp_path / "store")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    found = json.loads(answer.stdout)
    assert list(found["tables"]) == ["inputs", "t", "step", "skips", "fusion", "lidar"]
    times = [label for label in found["tables"]["t"] if label.startswith("t: ")]
    assert times == ["t: 999", "t: 200", "t: 199"]
    for labels in found["tables"].values():
        assert set(labels.values()) <= set(found["painters"])
    assert set(found["weights"]) == set(found["painters"]) - {"none", "overlay", "warp"}
