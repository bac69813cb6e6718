"""A scene written as a bag and read back is the same scene."""

import io
from dataclasses import replace
from fractions import Fraction

import av
import numpy as np
import pytest
from bag_log import BagScene, RosWriter, _ros_messages, write_ros_bag
from scene_differences import scene_differences

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.readers import ingest_scene, list_sequences, open_log
from lidarpainter_models.readers.bags.pictures import BagVideo
from lidarpainter_models.readers.bags.rig import read_rig, rig_of, rig_text
from lidarpainter_models.readers.source_logs.log import write_log
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.image_bytes import decode_image
from tasks.ingest.rigs import propose_rig


def read(root, name, store, **options):
    return DrivingScene.open(ingest_scene("mcap", root, name, store, **options))


def read_as(root, name, rig, store):
    log = open_log("mcap", root, name, rig=rig)
    return DrivingScene.open(write_log(log, store))


def written(file, bag, change):
    """A bag of the messages of another, each as `change` leaves it: topic, message, or None."""
    with RosWriter(file) as writer:
        for log_ns, kind, content in bag.messages():
            for topic, message in _ros_messages(writer, bag, log_ns, kind, content):
                for new_topic, new in change(writer, f"/{topic}", message, log_ns):
                    writer.write(new_topic, log_ns, new)
    return file


@pytest.mark.parametrize("name", ["ros", "foxglove"])
def test_scene_comes_back_as_it_was(street, bags, tmp_path, name):
    scene = read(bags, name, tmp_path)
    found = scene_differences(street, scene)
    # the poses of points are those between 10 ms, mixed again between 1 ms
    found.require_rounding(metres=1e-9, point_m=1e-4, degrees=1e-9)
    assert [check for check in check_scene(scene) if check.verdict != "ok"] == []
    true_ns = [sweep.timestamp_ns for sweep in street.sweeps]
    apart_ns = np.subtract([sweep.timestamp_ns for sweep in scene.sweeps], true_ns)
    assert np.abs(apart_ns).max() < 1_000_000  # its middle is that of its points


def test_bag_is_read_wherever_it_lies(bags, street, tmp_path):
    assert list_sequences("mcap", bags) == ("foxglove", "ros")
    assert list_sequences("mcap", bags / "ros.mcap") == ("ros",)
    whole = read(bags / "ros.mcap", "ros", tmp_path / "whole")
    split = tmp_path / "bags/split"
    split.mkdir(parents=True)
    (split / "metadata.yaml").write_text("rosbag2_bagfile_information:")
    messages = BagScene(street).messages()
    half_ns = messages[len(messages) // 2][0]
    for number, is_early in ((9, True), (10, False)):

        def part(_writer, topic, message, log_ns, is_early=is_early):
            return [(topic, message)] if (log_ns < half_ns) == is_early else []

        written(split / f"drive_{number}.mcap", BagScene(street), part)
    assert list_sequences("mcap", tmp_path / "bags") == ("split",)
    assert list_sequences("mcap", split) == ("split",)
    pieces = read(split, "split", tmp_path / "pieces")
    assert scene_differences(whole, pieces).point_m < 1e-6
    with pytest.raises(DataError, match="no bag other, expected"):
        read(bags, "other", tmp_path / "none")


def test_proposed_rig_reads_the_bag_as_it_is_read_without(bags, tmp_path):
    proposed = propose_rig(bags / "ros.mcap")
    assert proposed["missing"] == []
    rates = {row["topic"]: row["hz"] for row in proposed["topics"] if row["kind"] == "cloud"}
    assert rates == {"/lidars/main_pandar64/points": pytest.approx(10)}
    rig = tmp_path / "rig.toml"
    rig.write_text(proposed["rig"])
    assert rig_text(read_rig(rig)) == proposed["rig"]
    told = read_as(bags, "ros", rig, tmp_path / "told")
    assert told.content_digest == read(bags, "ros", tmp_path / "proposed").content_digest
    assert told.manifest["licence"] == "not told"
    with pytest.raises(ConfigError, match="a map is for mcap"):
        open_log("canonical", tmp_path, "x", rig=rig)


def test_raw_images_and_videos_are_read_too(street, tmp_path):
    """The front images as raw pixels in rows with padding, the side ones as H.264."""
    bag = BagScene(street)
    packets = {v.timestamp_ns: p for v, p in h264(street, "stereo_front_left")}

    def change(writer, topic, message, _log_ns):
        if "front_center/image" in topic:
            time_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            pixels = decode_image(message.data.tobytes())
            rows = np.pad(pixels[:, :, ::-1].reshape(len(pixels), -1), ((0, 0), (0, 7)))
            raw = writer.make(
                "sensor_msgs/Image",
                header=writer.header(time_ns, message.header.frame_id),
                height=pixels.shape[0],
                width=pixels.shape[1],
                encoding="rgb8",
                is_bigendian=0,
                step=rows.shape[1],
                data=rows.ravel(),
            )
            return [("/front/image_raw", raw)]
        if "stereo_front_left/image" in topic:
            time_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            video = writer.make(
                "foxglove_msgs/CompressedVideo",
                timestamp=writer.stamp(time_ns),
                frame_id="stereo_front_left",
                data=np.frombuffer(packets[time_ns], np.uint8),
                format="h264",
            )
            return [("/side/video", video)]
        return [(topic, message)]

    written(tmp_path / "bags/drive.mcap", bag, change)
    scene = read(tmp_path / "bags", "drive", tmp_path / "store")
    assert len(scene.views) == len(street.views)
    true_views = {(v.timestamp_ns, v.camera_name): v for v in street.views}
    names = {"front": "ring_front_center", "side": "stereo_front_left"}
    for view in scene.views:
        true_view = true_views[view.timestamp_ns, names[view.camera_name]]
        apart = scene.read_image(view).float() - street.read_image(true_view).float()
        assert float(apart.abs().mean()) < (2 if view.camera_name == "front" else 6)


def h264(street, camera):
    """The images of a camera with their packets, each a whole picture of a video."""
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = 96, 54, "yuv420p"
    codec.time_base, codec.options = Fraction(1, 10), {"tune": "zerolatency", "crf": "5", "bf": "0"}
    views = street.views_of(camera)
    found = []
    for number, view in enumerate(views):
        pixels = decode_image(bytes(street.read_jpeg(view)))
        frame = av.VideoFrame.from_ndarray(pixels, format="bgr24")
        frame.pts = number
        found += codec.encode(frame)
    found += codec.encode(None)
    return zip(views, map(bytes, found), strict=True)


def test_recorders_clock_is_taken_where_headers_have_none(street, tmp_path):
    def without_times(writer, topic, message, _log_ns):
        if "tf" not in topic and "detections" not in topic:
            message.header.stamp = writer.stamp(0)
        return [(topic, message)]

    written(tmp_path / "bags/drive.mcap", BagScene(street), without_times)
    proposed = propose_rig(tmp_path / "bags/drive.mcap")
    assert 'clock = "log"' in proposed["rig"]
    rig = tmp_path / "rig.toml"  # sweeps reach the recorder 60 ms after they begin
    rig.write_text(proposed["rig"].replace('point_time = "t"', 'point_time = "t"\nlate_s = -0.06'))
    scene = read_as(tmp_path / "bags", "drive", rig, tmp_path / "store")
    assert [view.timestamp_ns for view in scene.views] == [v.timestamp_ns for v in street.views]


def test_bag_without_poses_or_boxes_is_read_in_the_frame_of_the_car(street, tmp_path):
    def sensors_alone(_writer, topic, message, _log_ns):
        return [] if topic in ("/tf", "/detections") else [(topic, message)]

    file = written(tmp_path / "bags/drive.mcap", BagScene(street), sensors_alone)
    proposed = propose_rig(file)
    (missing,) = proposed["missing"]
    assert missing.startswith("no pose of the car: nothing moves main_pandar64 in a frame")
    assert "lidarpainter localise" in missing
    with pytest.raises(DataError, match="no pose of the car"):
        read(file.parent, "drive", tmp_path / "refused")
    rig = tmp_path / "rig.toml"
    rig.write_text(proposed["rig"])
    scene = read_as(file.parent, "drive", rig, tmp_path / "store")
    assert scene.tracks == ()
    assert not scene.has_poses
    assert float((scene.world_from_ego - scene.world_from_ego[0]).abs().max()) == 0.0
    assert len(scene.views) == len(street.views)


def test_what_a_bag_lacks_is_told_by_the_rig(street, tmp_path):
    """A LiDAR that nothing ties to the car, until the rig says where it is."""

    def without_mount(_writer, topic, message, _log_ns):
        if topic == "/tf_static":
            kept = [t for t in message.transforms if t.child_frame_id != "main_pandar64"]
            return [(topic, replace(message, transforms=kept))]
        return [(topic, message)]

    bag = BagScene(street)
    file = written(tmp_path / "bags/drive.mcap", bag, without_mount)
    (untied,) = [line for line in propose_rig(file)["missing"] if "pandar64' of" in line] or [""]
    assert untied or any("no pose" in line for line in propose_rig(file)["missing"])
    w, x, y, z = np.eye(4)[0]
    place = bag.car_from_lidar["main_pandar64"][:3, 3].tolist()
    values = {
        "licence": "own",
        "world": "map",
        "ego": "base_link",
        "camera": [
            {"name": n, "topic": f"/cameras/{n}/image/compressed"}
            | {"lens": f"/cameras/{n}/camera_info"}
            for n in street.camera_names
        ],
        "lidar": [{"name": "roof", "topic": "/lidars/main_pandar64/points", "point_time": "t"}],
    }
    rig = tmp_path / "rig.toml"
    rig.write_text(rig_text(rig_of(values, "test")))
    with pytest.raises(DataError, match="nothing ties frame 'main_pandar64' to 'map'"):
        read_as(file.parent, "drive", rig, tmp_path / "refused")
    mount = {"parent": "base_link", "child": "main_pandar64", "translation_m": place}
    values["transform"] = [{**mount, "rotation_wxyz": [w, x, y, z]}]
    rig.write_text(rig_text(rig_of(values, "test")))
    scene = read_as(file.parent, "drive", rig, tmp_path / "store")
    assert scene.lidar_names == ("roof",)


@pytest.mark.slow
def test_real_log_comes_back_from_a_bag(tmp_path, shared_folder):
    """Six frames of PandaSet 002: six cameras, both LiDARs, boxes."""
    root = shared_folder / "data/pandaset"
    real = DrivingScene.open(
        ingest_scene("pandaset", root, "002", tmp_path / "real", frames=slice(0, 6))
    )
    write_ros_bag(real, tmp_path / "bags/drive.mcap", are_cameras_free=True)
    scene = read(tmp_path / "bags", "drive", tmp_path / "store")
    true_views = {
        (view.camera_name, real.image_record(view).timestamp_ns): view for view in real.views
    }
    assert len(scene.views) >= 35  # the back camera's images are nearest to the sweep before
    for view in scene.views:
        true_view = true_views[view.camera_name, view.timestamp_ns]
        assert bytes(scene.read_jpeg(view)) == bytes(real.read_jpeg(true_view))
        poses = [
            one.global_from_world @ one.image_record(its).camera.world_from_camera
            for one, its in ((scene, view), (real, true_view))
        ]
        assert float((poses[0] - poses[1]).abs().max()) < 1e-9
    real.views = scene.views = ()
    found = scene_differences(real, scene)
    assert found.num_unpaired_boxes == 0
    assert found.box_centre_m < 1e-9
    assert found.point_m < 1e-4


def test_video_before_its_first_whole_picture_is_left_out(street):
    packets = [packet for _, packet in h264(street, "stereo_front_left")]
    video = BagVideo("h264", "test")
    shown = [
        number
        for number, packet in enumerate([*packets[1:], *packets])
        for number, _ in video.pictures(packet, number, {number}, "test")
    ]
    assert set(shown) <= {2, 3, 4}
    assert {2, 3, 4} <= {*shown, *(n for n, _ in video.pictures(None, 0, set(), "test"))}
    with pytest.raises(DataError, match="video format 'vp9', expected h264"):
        BagVideo("vp9", "test")
    assert io.BytesIO(packets[0]).read(4) == b"\x00\x00\x00\x01"
