import pytest
import torch

from lidarpainter_models.errors import SceneError, WriteError
from lidarpainter_models.gaussians.fitting.checkpoint import FILE_NAME, CheckpointFolder


def test_empty_folder_holds_no_checkpoint(tmp_path):
    assert CheckpointFolder(path=tmp_path / "none").load() is None


def test_saved_state_comes_back(tmp_path):
    folder = CheckpointFolder(path=tmp_path, identity="a")
    folder.save({"x": torch.arange(3.0)}, {"step": 7})
    folder.save({"x": torch.arange(4.0)}, {"step": 8})
    tensors, numbers = folder.load()
    assert torch.equal(tensors["x"], torch.arange(4.0))
    assert numbers == {"step": 8}
    assert [path.name for path in tmp_path.iterdir()] == [FILE_NAME]


def test_damaged_checkpoint_is_refused(tmp_path):
    folder = CheckpointFolder(path=tmp_path)
    folder.save({"x": torch.zeros(100)}, {})
    whole = (tmp_path / FILE_NAME).read_bytes()
    (tmp_path / FILE_NAME).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneError, match="is not a readable"):
        folder.load()


def test_folder_that_cannot_be_written_is_one_clear_error(tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(WriteError, match="cannot be written"):
        CheckpointFolder(path=tmp_path / "taken").save({"x": torch.zeros(1)}, {})


def test_checkpoints_are_due_by_the_clock(tmp_path):
    assert CheckpointFolder(path=tmp_path, every_seconds=0.0).is_due
    assert not CheckpointFolder(path=tmp_path, every_seconds=1e6).is_due
