"""What a view costs is told of a finished run."""

import sys

import torch
import view_costs


def test_views_of_a_finished_run_are_timed(tiny_run, monkeypatch, capsys):
    threads = torch.get_num_threads()
    words = ["view_costs.py", str(tiny_run.store.root), "--run", tiny_run.run_id, "--views", "1"]
    monkeypatch.setattr(sys, "argv", words)
    try:
        view_costs.main()
    finally:
        torch.set_num_threads(threads)
    told = capsys.readouterr().out
    assert "96 x 54 px" in told
    assert "ms a painted view" in told
