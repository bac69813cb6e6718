"""NeuroNCAP's routes: what its client asks, it gets."""

import base64
import io

import cv2
import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient

from lidarpainter_models.serving.http_routes import HttpScene, http_app
from lidarpainter_models.serving.render_queue import RenderQueue


@pytest.fixture
def http(street):
    queue = RenderQueue(8, 60.0)
    with TestClient(http_app(HttpScene(scene=lambda: street.served, queue=queue))) as client:
        yield client
    queue.close()


def asked(street, view, **changes):
    pose = street.served.found(view).world_from_camera.tolist()
    message = {
        "pose": pose,
        "timestamp": view.timestamp_ns // 1000,
        "camera_name": view.camera_name,
        "image_format": "png",
    }
    return message | changes


def shown(reply):
    assert reply.status_code == 200, reply.text
    return cv2.imdecode(np.frombuffer(reply.content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_the_server_lives_and_knows_when_the_drive_began(street, http):
    assert http.get("/alive").json() is True
    first_ns = int(street.recording.frame_timestamps_ns[0])
    assert http.get("/start_time").json() == first_ns // 1000


def test_an_image_is_that_of_the_scene(street, http, view):
    camera = street.served.found(view)
    rgb = street.scene.render(camera, view.timestamp_ns, camera_name=view.camera_name).rgb
    expected = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    png = http.post("/render_image", json=asked(street, view))
    difference = np.abs(shown(png).astype(int) - expected)
    assert difference.mean() < 0.5  # actors are between their boxes, the fit's between its views
    raw = http.post("/render_image", json=asked(street, view, image_format="raw"))
    tensor = torch.load(io.BytesIO(base64.b64decode(raw.content)))
    assert np.array_equal(tensor.numpy(), shown(png))
    assert float(png.headers["lidarpainter-confidence"]) >= 0


def test_actors_go_where_they_are_put_and_are_as_large_as_they_are_told(street, http, view):
    actors = http.get("/get_actors").json()
    assert {one["uuid"] for one in actors} == {track.actor_id for track in street.scene.tracks}
    before = shown(http.post("/render_image", json=asked(street, view)))
    for one in actors:
        reply = http.post("/set_actor_scale", json={"uuid": one["uuid"], "scale": 2.0})
        assert reply.status_code == 200
    larger = shown(http.post("/render_image", json=asked(street, view)))
    assert http.post("/update_actors", json=[]).status_code == 200
    nobody = shown(http.post("/render_image", json=asked(street, view)))

    def actor_pixels(image):
        return int((np.abs(image.astype(int) - nobody).max(axis=-1) > 8).sum())

    assert 0 < actor_pixels(before) < actor_pixels(larger)


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"camera_name": "nobody"}, 404),
        ({"timestamp": 2**50}, 416),
        ({"pose": [[0.0] * 4] * 4}, 422),
        ({"pose": [[1e300] * 4] * 4}, 422),
        ({"image_format": "avi"}, 422),
    ],
)
def test_what_makes_no_sense_is_refused(street, http, view, changes, status):
    reply = http.post("/render_image", json=asked(street, view, **changes))
    assert reply.status_code == status, reply.text


def test_strangers_are_refused(http):
    assert http.post("/set_actor_scale", json={"uuid": "nobody", "scale": 2}).status_code == 422
    stranger = [{"uuid": "nobody", "poses": [], "timestamps": []}]
    assert http.post("/update_actors", json=stranger).status_code == 422
