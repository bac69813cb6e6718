"""Training pairs on disk."""

import json
from dataclasses import replace

import pytest
import torch
from random_conditions import random_conditions

from lidarpainter_models.errors import DataError, ShapeError, WriteError
from lidarpainter_models.painter.examples import PaintingPair, PairSource, Window
from lidarpainter_models.painter.protocol import PaintingConditions
from lidarpainter_models.training_data.pairs import PairFolder, PairWriter, load_pair


def make_pair(height_px=12, width_px=20, num_sources=2, seed=0, with_reference=True):
    conditions = random_conditions(height_px, width_px, num_sources, seed)
    if not with_reference:
        conditions = replace(conditions, reference_rgb=None)
    return PaintingPair(
        conditions=conditions,
        target_rgb=1 - conditions.render_rgb,
        target_valid=conditions.render_alpha < 0.9,
    )


@pytest.fixture
def folder(tmp_path):
    writer = PairWriter(tmp_path / "pairs")
    for index in range(3):
        writer.add(f"pair-{index}", make_pair(seed=index), {"frame": index})
    return tmp_path / "pairs"


def assert_close(pair, expected):
    for name in PaintingConditions.__dataclass_fields__:
        found, wanted = getattr(pair.conditions, name), getattr(expected.conditions, name)
        if not isinstance(wanted, torch.Tensor):
            assert found == wanted
        elif wanted.dtype == torch.bool:
            assert torch.equal(found, wanted)
        elif "depth" in name:
            torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3)  # float16
        else:
            torch.testing.assert_close(found, wanted, rtol=0, atol=0.51 / 255)  # bytes
    torch.testing.assert_close(pair.target_rgb, expected.target_rgb, rtol=0, atol=0.51 / 255)
    assert torch.equal(pair.target_valid, expected.target_valid)


@pytest.mark.parametrize("num_sources", [0, 1, 2])
def test_a_pair_survives_the_round_trip(tmp_path, num_sources):
    pair = make_pair(num_sources=num_sources)
    path = PairWriter(tmp_path).add("only", pair, {})
    assert_close(load_pair(path), pair)


def test_a_window_is_the_same_part_of_the_pair(folder):
    pairs = PairFolder(folder)
    window = Window(2, 5, 8, 9)
    assert isinstance(pairs, PairSource)
    assert_close(pairs.read(1, window), pairs.read(1).cropped(window))
    assert pairs.read(1, window).conditions.height_width_px == (8, 9)


def test_pairs_without_a_reference_are_still_read_and_named(folder):
    assert PairFolder(folder).first_without("reference_rgb") is None
    old = make_pair(with_reference=False)
    assert_close(load_pair(PairWriter(folder).add("old", old, {})), old)
    assert PairFolder(folder).first_without("reference_rgb") == "old"


def test_the_index_tells_what_is_there(folder):
    pairs = PairFolder(folder)
    assert len(pairs) == 3
    assert pairs.size_px(0) == (12, 20)
    assert pairs.name(2) == "pair-2"
    assert pairs.provenance(2) == {"frame": 2}
    assert pairs.describe()["pairs"]["pair-1"] == {"frame": 1}
    pairs.verify()


def test_the_digest_follows_the_content(folder, tmp_path):
    before = PairFolder(folder).digest
    again = PairWriter(tmp_path / "again")
    for index in range(3):
        again.add(f"pair-{index}", make_pair(seed=index), {"frame": index})
    assert PairFolder(tmp_path / "again").digest == before
    again.add("more", make_pair(seed=9), {})
    assert PairFolder(tmp_path / "again").digest != before


def test_a_harvest_can_be_continued(folder):
    writer = PairWriter(folder)
    assert "pair-1" in writer
    assert "pair-3" not in writer
    writer.add("pair-3", make_pair(seed=3), {})
    assert len(PairFolder(folder)) == 4


@pytest.mark.parametrize("name", ["pair-1", "../out", "a/b", "", ".hidden"])
def test_taken_and_odd_names_are_refused(folder, name):
    with pytest.raises(DataError, match="pair name"):
        PairWriter(folder).add(name, make_pair(), {})


def truncate(path):
    path.write_bytes(path.read_bytes()[:200])


def overwrite(path):
    path.write_bytes(b"\xff" * 64)


@pytest.mark.parametrize("spoil", [truncate, overwrite])
def test_a_damaged_pair_is_one_clear_line(folder, spoil):
    path = folder / "pair-1.safetensors"
    spoil(path)
    with pytest.raises(DataError, match=r"pair-1\.safetensors is not a readable") as caught:
        PairFolder(folder).read(1)
    assert "\n" not in str(caught.value)


def test_a_changed_byte_is_found_by_verify(folder):
    path = folder / "pair-2.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(DataError, match="SHA-256"):
        PairFolder(folder).verify()


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"pairs": [1]}', '{"pairs": [], "format": "x"}']
)
def test_a_damaged_index_is_one_clear_line(folder, text):
    (folder / "index.json").write_text(text)
    with pytest.raises(DataError, match=r"index\.json") as caught:
        PairFolder(folder)
    assert "\n" not in str(caught.value)


def test_an_index_cannot_point_outside_its_folder(folder):
    index = json.loads((folder / "index.json").read_text())
    index["pairs"][0]["file"] = "../elsewhere.safetensors"
    (folder / "index.json").write_text(json.dumps(index))
    with pytest.raises(DataError, match="elsewhere"):
        PairFolder(folder)


def test_missing_pairs_and_folders_are_named(folder, tmp_path):
    (folder / "pair-0.safetensors").unlink()
    with pytest.raises(DataError, match=r"lacks pair-0\.safetensors"):
        PairFolder(folder)
    with pytest.raises(DataError, match="no training pairs in"):
        PairFolder(tmp_path / "nowhere")


def test_a_disk_that_refuses_leaves_the_index_as_it_was(folder, monkeypatch):
    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", refuse)
    with pytest.raises(WriteError, match="No space left"):
        PairWriter(folder).add("pair-3", make_pair(), {})
    monkeypatch.undo()
    assert len(PairFolder(folder)) == 3
    assert len(list(folder.iterdir())) == 4


def test_a_pair_needs_one_pixel_grid():
    pair = make_pair()
    with pytest.raises(ShapeError, match="one pixel grid"):
        replace(pair, target_rgb=torch.zeros(3, 4, 3), target_valid=torch.ones(3, 4) > 0)
