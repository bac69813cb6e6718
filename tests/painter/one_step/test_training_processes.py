"""Training in a process of its own, killed and resumed."""

import multiprocessing
import os
import signal
import time
from dataclasses import replace

import pytest
import torch
from random_pairs import write_pairs
from small_training import CONTEST, train_small

SPAWN = multiprocessing.get_context("spawn")
PATIENCE_S = 240


@pytest.fixture
def pairs(tmp_path):
    write_pairs(tmp_path / "pairs", range(4), height_px=64, width_px=80)
    return tmp_path / "pairs"


@pytest.mark.slow
def test_training_resumes_bit_for_bit_after_kill_9(pairs, tmp_path):
    config = replace(CONTEST, steps=12)
    folder = tmp_path / "checkpoints"
    child = SPAWN.Process(target=train_small, args=(pairs, config, folder))
    child.start()
    deadline_s = time.monotonic() + PATIENCE_S
    while not (folder / "training.pt").exists() and time.monotonic() < deadline_s:
        time.sleep(0.02)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    assert child.exitcode == -signal.SIGKILL  # killed before its end
    stood_at = torch.load(folder / "training.pt", weights_only=True)["step"]
    assert 0 < stood_at < config.steps
    resumed, again = train_small(pairs, config, folder)
    straight, record = train_small(pairs, config)
    assert again["steps"] == record["steps"] == config.steps
    for name, weight in straight.items():
        assert torch.equal(resumed[name], weight)
