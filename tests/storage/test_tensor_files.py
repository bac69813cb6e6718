"""Tensors and their header come back as they were, or the file is found to be damaged."""

import math

import pytest
import torch

from lidarpainter_models.errors import DataError, WeightsError, WriteError
from lidarpainter_models.storage.tensor_files import (
    open_tensors,
    pack_tensors,
    read_tensors,
    write_tensors,
)


def some_tensors():
    generator = torch.Generator().manual_seed(0)
    return {
        "a": torch.randn(3, 4, generator=generator, dtype=torch.float64).T,
        "b": torch.tensor([True, False]),
        "empty": torch.zeros(0, 3, dtype=torch.uint8),
    }


def test_tensors_and_header_come_back_bit_for_bit(tmp_path):
    tensors, header = some_tensors(), {"schema": 1, "names": ["ä", "b"], "pi": math.pi}
    write_tensors(tmp_path / "x.safetensors", tensors, header)
    found, described = read_tensors(tmp_path / "x.safetensors")
    assert described == header
    assert found.keys() == tensors.keys()
    assert all(torch.equal(found[name], tensors[name]) for name in tensors)
    assert (tmp_path / "x.safetensors").read_bytes() == pack_tensors(tensors, header)


def test_one_tensor_is_read_without_the_others(tmp_path):
    write_tensors(tmp_path / "x.safetensors", some_tensors(), {"kind": "some"})
    with open_tensors(tmp_path / "x.safetensors") as (file, header):
        assert header == {"kind": "some"}
        assert torch.equal(file.get_slice("a")[1:2], some_tensors()["a"][1:2])


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"not tensors",
        b"\x08\x00\x00\x00\x00\x00\x00\x00{}",
        pack_tensors({}, {}).replace(b"{}", b"{!"),
        pack_tensors({}, {}).replace(b"{}", b"[]"),
    ],
)
def test_a_file_of_something_else_is_damaged(tmp_path, content):
    path = tmp_path / "x.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.safetensors (is not|has a damaged)"):
        read_tensors(path)
    with pytest.raises(WeightsError):
        read_tensors(path, damaged=WeightsError)


def test_an_error_of_the_reader_of_a_file_passes_as_it_is(tmp_path):
    write_tensors(tmp_path / "x.safetensors", some_tensors(), {})
    with (
        pytest.raises(WeightsError, match=r"^no tensor of that shape$"),
        open_tensors(tmp_path / "x.safetensors"),
    ):
        raise WeightsError("no tensor of that shape")


def test_a_failed_write_leaves_the_older_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "x.safetensors"
    write_tensors(path, some_tensors(), {"age": "old"})

    def refuse(*_arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lidarpainter_models.storage.whole_files.sync", refuse)
    with pytest.raises(WriteError, match="No space left on device; free some space"):
        write_tensors(path, some_tensors(), {"age": "new"})
    assert read_tensors(path)[1] == {"age": "old"}
    assert list(tmp_path.iterdir()) == [path]
