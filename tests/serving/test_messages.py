"""What is on the wire: messages and calls as the interface's description has them."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from lidarpainter_models.serving import wire
from lidarpainter_models.serving.protos import sensorsim_pb2

ROOT = Path(__file__).resolve().parents[2]
PROTOS = "lidarpainter_models/serving/protos"


def test_generated_code_is_what_the_proto_files_give(tmp_path):
    if importlib.util.find_spec("grpc_tools") is None:
        pytest.skip("grpcio-tools is not installed")
    names = ("common", "sensorsim")
    subprocess.run(
        [sys.executable, "-m", "grpc_tools.protoc", "-I", "."]
        + [f"--python_out={tmp_path}"]
        + [f"{PROTOS}/{name}.proto" for name in names],
        cwd=ROOT,
        check=True,
    )
    for file in [f"{PROTOS}/{name}_pb2.py" for name in names]:
        assert (tmp_path / file).read_bytes() == (ROOT / file).read_bytes(), file


def test_a_request_has_the_bytes_of_its_description():
    """Field numbers and types, worked out by hand from the encoding of protocol buffers."""
    request = sensorsim_pb2.RGBRenderRequest(
        scene_id="a", resolution_h=2, frame_start_us=3, image_quality=1.0, insert_ego_mask=True
    )
    fields = [b"\x0a\x01a", b"\x10\x02", b"\x29" + (3).to_bytes(8, "little")]
    fields += [b"\x55\x00\x00\x80\x3f", b"\x58\x01"]
    assert request.SerializeToString() == b"".join(fields)


def test_every_call_has_its_message_and_its_reply():
    calls = wire.calls()
    assert len(calls) == 17
    assert calls["batch_render_rgb"] == calls["batch_render_camera"]
    names = {name: (request.__name__, reply.__name__) for name, (request, reply) in calls.items()}
    assert names["get_available_scenes"] == ("Empty", "AvailableScenesReturn")
    assert names["render_rgb"] == ("RGBRenderRequest", "RGBRenderReturn")
