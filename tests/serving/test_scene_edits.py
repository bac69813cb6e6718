"""Actors that a client brings along, on a real socket: shown, taken back, or refused."""

from dataclasses import replace

import cv2
import grpc
import numpy as np
import pytest
from served_street import placed_object, served

from lidarpainter_models.painter.baselines import WarpPainter
from lidarpainter_models.serving import wire
from lidarpainter_models.serving.messages import matrix_of, read_request
from lidarpainter_models.serving.painted_streams import PaintedStreams
from lidarpainter_models.serving.protos import common_pb2
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb
from lidarpainter_models.serving.scene_edits import MOST_COME, SceneEdits, with_parked_apart

SCENE = {"scene_id": "street"}


def decoded(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(int)


@pytest.fixture
def client(street):
    with served(street) as channel:
        yield wire.client(channel)


def shown(client, message):
    return decoded(client.render_rgb(message, timeout=60).image_bytes)


def place_of(message):
    """Where the newcomer of an insertion stands first."""
    return matrix_of(message.insert[0].trajectory.poses[0].pose)


def test_who_is_put_in_is_shown_where_a_request_has_it_and_goes_when_restored(street, client, view):
    nobody = street.request(view, actors=[])
    before = shown(client, nobody)
    insertion = street.insertion(view, "newcomer", asset_id="asset-0")
    alone = street.request(view, actors=[placed_object("newcomer", place_of(insertion))])
    with pytest.raises(grpc.RpcError, match="'newcomer'"):
        client.render_rgb(alone, timeout=60)
    assert client.edit_assets(insertion, timeout=60).success
    assert np.array_equal(shown(client, nobody), before)  # who is not named is not there
    changed = np.abs(shown(client, alone) - before).max(axis=-1) > 8
    camera = street.served.found(view)
    assert 0.02 < changed.mean() < 0.9
    assert abs(np.nonzero(changed)[1].mean() + 0.5 - camera.cx_px) < 0.2 * camera.width_px
    told = client.get_dynamic_objects(pb.DynamicObjectsRequest(**SCENE), timeout=60)
    assert "newcomer" in {one.id for one in told.dynamic_objects}
    client.restore_model_parameters(pb.RestoreModelParametersRequest(**SCENE), timeout=60)
    with pytest.raises(grpc.RpcError, match="'newcomer'"):
        client.render_rgb(alone, timeout=60)


def test_an_actor_that_is_replaced_looks_otherwise_and_keeps_its_name(street, client, view):
    name = street.scene.actors.recorded_tracks[0].actor_id
    place = place_of(street.insertion(view, "x"))
    alone = street.request(view, actors=[placed_object(name, place)])
    before = shown(client, alone)
    action = pb.ReplaceAssetAction(original_id=name, replacement_id="asset-1")
    reply = client.edit_assets(pb.EditAssetsRequest(replace=[action], **SCENE), timeout=60)
    assert reply.success, reply.message
    assert np.abs(shown(client, alone) - before).max() > 20
    names = client.get_external_asset_objects(pb.ExternalAssetObjectsRequest(**SCENE), timeout=60)
    assert list(names.track_ids) == ["asset-0", "asset-1"]


def test_an_edit_that_cannot_be_done_changes_nothing_and_says_why(street, client, view):
    name = street.scene.actors.recorded_tracks[0].actor_id
    good = street.insertion(view, "newcomer")
    replaced, track, way = pb.ReplaceAssetAction, pb.DynamicObjectTrack, good.insert[0].trajectory
    no_size = common_pb2.AABB(size_x=float("nan"), size_y=2, size_z=1)
    cases = {
        "'nobody'": {"replace": [replaced(original_id="nobody")]},
        "'strange'": {"replace": [replaced(original_id=name, replacement_id="strange")]},
        "there already": {"insert": [track(id=name, trajectory=way)]},
        "1 to 4096 poses": {"insert": [track(id="b")]},
        "object_size nan": {"insert": [track(id="c", trajectory=way, object_size=no_size)]},
    }
    for words, fields in cases.items():
        message = pb.EditAssetsRequest(**SCENE, **fields)
        message.insert.extend(good.insert)
        reply = client.edit_assets(message, timeout=60)
        assert not reply.success
        assert words in reply.message
        assert "\n" not in reply.message
    told = client.get_dynamic_objects(pb.DynamicObjectsRequest(**SCENE), timeout=60)
    assert "newcomer" not in {one.id for one in told.dynamic_objects}


def test_a_placeholder_stands_for_a_stranger_where_that_is_asked_for(street, view):
    place = place_of(street.insertion(view, "x"))
    alone = street.request(view, actors=[placed_object("stranger", place)])
    with served(street, has_placeholders=True) as channel:
        client = wire.client(channel)
        first = client.render_rgb(alone, timeout=60).image_bytes
        nobody = shown(client, street.request(view, actors=[]))
        assert client.render_rgb(alone, timeout=60).image_bytes == first
        assert (np.abs(decoded(first) - nobody).max(axis=-1) > 8).mean() > 0.02
        for number in range(MOST_COME - 1):
            more = street.request(view, actors=[placed_object(f"more-{number}", place)])
            client.render_rgb(more, timeout=60)
        one_more = street.request(view, actors=[placed_object("too-many", place)])
        with pytest.raises(grpc.RpcError) as refused:
            client.render_rgb(one_more, timeout=60)
    assert refused.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED


def test_a_parked_car_can_be_left_out_once_it_is_no_part_of_the_street(street):
    apart = with_parked_apart(street.served)
    ids = {track.actor_id for track in apart.scene.actors.recorded_tracks}
    freed = ids - {track.actor_id for track in street.scene.actors.recorded_tracks}
    assert freed
    assert not freed & set(apart.parked.tracks)
    bodies = apart.scene.gaussians.body_index
    assert len(bodies) >= len(street.scene.gaussians)
    assert int((bodies > 0).sum()) > int((street.scene.gaussians.body_index > 0).sum())


def test_an_edited_scene_is_painted_too(street, view):
    insertion = street.insertion(view, "newcomer")
    alone = street.request(view, actors=[placed_object("newcomer", place_of(insertion))])
    streams = PaintedStreams(painter_of_scene=WarpPainter())
    edits = SceneEdits(
        fitted=replace(street.served, streams=streams, is_measured=False), library=street.library
    )
    edits.edit(insertion)
    nobody = edits.shown().frame(read_request(street.request(view, actors=[])), "a").rgb_u8
    shown = edits.shown().frame(read_request(alone), "b").rgb_u8
    assert (np.abs(shown.astype(int) - nobody).max(axis=-1) > 8).mean() > 0.02
