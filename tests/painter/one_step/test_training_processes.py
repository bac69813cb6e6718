"""Training in processes of their own: killed and resumed, and two that train together."""

import multiprocessing
import os
import signal
import socket
import time
from dataclasses import replace

import pytest
import torch
from random_pairs import write_pairs
from small_training import CONTEST, train_as_one_of_two, train_small, untrained_weights

SPAWN = multiprocessing.get_context("spawn")
PATIENCE_S = 240


@pytest.fixture
def pairs(tmp_path):
    write_pairs(tmp_path / "pairs", range(4), height_px=64, width_px=80)
    return tmp_path / "pairs"


def vector(weights):
    return torch.cat([weight.flatten() for weight in weights.values()])


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


@pytest.mark.slow
def test_two_processes_take_the_steps_of_one_with_twice_the_batches(pairs, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    out = tmp_path / "two"
    out.mkdir()
    both = [
        SPAWN.Process(target=train_as_one_of_two, args=(index, port, pairs, CONTEST, out))
        for index in range(2)
    ]
    for one in both:
        one.start()
    for one in both:
        one.join(PATIENCE_S)
        assert one.exitcode == 0
    found = [torch.load(out / f"trained-{index}.pt", weights_only=True) for index in range(2)]
    alone, record = train_small(pairs, replace(CONTEST, accumulated_batches=2))
    for name in alone:
        assert torch.equal(found[0]["weights"][name], found[1]["weights"][name])
    start = vector(untrained_weights(CONTEST))
    moved = (vector(alone) - start).norm()
    # Adam divides gradients by their size, so the order of a sum counts where they are nearly 0
    assert (vector(found[0]["weights"]) - vector(alone)).norm() < 0.01 * moved
    for entry, other in zip(found[0]["history"], record["history"], strict=True):
        assert entry["total"] == pytest.approx(other["total"], rel=1e-4)
    assert (out / "training.pt").exists()
