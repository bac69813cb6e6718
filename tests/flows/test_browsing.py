"""A run in a browser, asked for by commands."""

import pytest
from commands import call, succeed

from flows import interruption


def test_page_is_one_file_that_names_the_scene(tiny_run, tmp_path):
    out = tmp_path / "drive.html"
    answer = succeed(
        "export", "latest", "--format", "page", "--out", out, "--json", store=tiny_run.store
    )
    page = out.read_text("utf-8")
    assert answer.json["path"] == str(out)
    assert answer.json["bytes"] == len(page) < 3_000_000
    assert f"<title>LidarPainter: {tiny_run.result['scene']}</title>" in page


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--postpaint",), "a browser shows the scene itself"),
        (("--trajectory", "lateral:90"), "lateral:90"),
        (("--camera", "rear"), "rear"),
    ],
)
def test_page_that_cannot_be_is_one_line(tiny_run, tmp_path, words, expected):
    out = tmp_path / "drive.html"
    asked = ("export", tiny_run.run_id, "--format", "page", "--out", out, *words)
    answer = call(*asked, store=tiny_run.store)
    assert answer.code == 2
    assert expected in answer.err
    assert answer.err.count("\n") == 1
    assert not out.exists()


def test_view_says_where_it_is_and_opens_a_browser_there(tiny_run, monkeypatch):
    from lidarpainter_models.viewing.viewer import LiveViewer

    visited = []
    monkeypatch.setattr(LiveViewer, "play", lambda *_: None)  # else it plays until Ctrl-C
    monkeypatch.setattr("webbrowser.open", visited.append)
    answer = succeed("view", "latest", store=tiny_run.store)
    assert answer.out.startswith("http://127.0.0.1:")
    assert answer.out.splitlines() == visited
    assert interruption.message() == "closed"  # what Ctrl-C says from then on
