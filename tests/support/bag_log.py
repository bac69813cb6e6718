"""Write a scene as a bag: MCAP with messages of ROS 2 (CDR) or of Foxglove (protobuf).

    write_ros_bag(scene, root / "drive.mcap")
    write_foxglove_bag(scene, root / "drive.mcap")

Points are written in the frame of their LiDAR at their own time, poses as transforms, boxes as
detections in the world. ROS messages are encoded by rosbags, those of Foxglove by its own SDK.
"""

from functools import cache
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove import Channel, Context
from foxglove import messages as fox
from mcap.writer import Writer

from lidarpainter_models.geometry.timed_poses import poses_at
from lidarpainter_models.geometry.transforms import invert_rigid, quaternion_from_rotation

CAMERA, LIDAR = "cameras/{}/image/compressed", "lidars/{}/points"
WORLD, CAR = "map", "base_link"
POINT_FIELDS = (("intensity", 0, 7), ("z", 4, 7), ("y", 8, 7), ("ring", 12, 4), ("t", 14, 6))
"""Name, offset and ROS type: in an order and at places of its own; x comes last."""
POINT_BYTES = 24


class BagScene:
    """What a bag is made of: poses of the car, sensors on it, points as they were measured."""

    def __init__(self, scene, *, are_cameras_free=False):
        """Cameras are mounted on the car, or free: each image has a transform of its own."""
        self.scene, self.are_cameras_free = scene, are_cameras_free
        self.times_ns = scene.frame_timestamps_ns.numpy()
        self.images = [(scene.image_record(view), view) for view in scene.views]
        records = {record.camera_name: record for record, _ in reversed(self.images)}
        self.cameras = {name: record.camera for name, record in records.items()}
        self.lenses = {name: record.distortion for name, record in records.items()}
        self.car_from_camera = {
            name: invert_rigid(self.car_at([record.timestamp_ns])[0])
            @ self.global_from_world
            @ record.camera.world_from_camera
            for name, record in records.items()
        }
        sweeps = {sweep.lidar_name: sweep for sweep in reversed(scene.sweeps)}
        self.car_from_lidar = {
            name: invert_rigid(self.car_at([sweep.timestamp_ns])[0])
            @ self.global_from_world
            @ sweep.world_from_lidar
            for name, sweep in sweeps.items()
        }
        steps_ns = np.arange(self.times_ns[0] - 10**8, self.times_ns[-1] + 10**8, 10**7)
        stated_ns = [record.timestamp_ns for record, _ in self.images] + self.times_ns.tolist()
        self.poses_ns = np.unique(np.concatenate([steps_ns, stated_ns]))

    @property
    def global_from_world(self):
        return self.scene.global_from_world

    def car_at(self, times_ns):
        poses = poses_at(self.scene.world_from_ego, self.times_ns, np.array(times_ns))
        return self.global_from_world @ poses

    def transforms(self):
        """Moving ones: time, parent, child, pose."""
        for time_ns, pose in zip(self.poses_ns.tolist(), self.car_at(self.poses_ns), strict=True):
            yield time_ns, WORLD, CAR, pose
        for record, _ in self.images if self.are_cameras_free else ():
            pose = self.global_from_world @ record.camera.world_from_camera
            yield record.timestamp_ns, WORLD, record.camera_name, pose

    def mounts(self):
        """Static ones: parent, child, pose."""
        cameras = {} if self.are_cameras_free else self.car_from_camera
        for name, pose in {**cameras, **self.car_from_lidar}.items():
            yield CAR, name, pose

    def cloud(self, sweep):
        """Header time, and x, y, z, intensity, ring, nanoseconds after it, as measured."""
        points = self.scene.read_sweep(sweep)
        offset_ns = points.time_offset_ns.numpy().astype(np.int64)
        start_ns = sweep.timestamp_ns + int(offset_ns.min())
        times_ns = sweep.timestamp_ns + offset_ns
        lidar_from_world = (
            invert_rigid(self._stated_at(times_ns) @ self.car_from_lidar[sweep.lidar_name])
            @ self.global_from_world
        ).numpy()
        xyz_m = points.xyz_m.double().numpy()
        seen_m = np.einsum("nij,nj->ni", lidar_from_world[:, :3, :3], xyz_m)
        return start_ns, (
            seen_m + lidar_from_world[:, :3, 3],
            points.intensity.numpy(),
            points.ring.numpy().clip(0),
            times_ns - start_ns,
        )

    def _stated_at(self, times_ns):
        """Poses of the car as the transforms of the bag give them."""
        return poses_at(self.car_at(self.poses_ns), self.poses_ns, times_ns)

    def boxes(self, frame_index):
        """Time, track and pose in the bag's world."""
        for track in self.scene.tracks:
            for row in (track.frame_indices == frame_index).nonzero()[:, 0].tolist():
                pose = self.global_from_world @ track.world_from_box[row]
                yield int(track.timestamps_ns[row]), track, pose

    def messages(self):
        """What is recorded, by time: (time, kind, content)."""
        found: list[tuple[int, str, Any]] = [(int(self.poses_ns[0]), "mounts", None)]
        found += [(int(self.poses_ns[0]), "lens", name) for name in self.cameras]
        found += [(time[0], "transform", time) for time in self.transforms()]
        found += [(record.timestamp_ns, "image", (record, view)) for record, view in self.images]
        found += [(sweep.timestamp_ns + 10**7, "sweep", sweep) for sweep in self.scene.sweeps]
        found += [
            (int(time_ns) + 10**7, "boxes", frame)
            for time_ns, frame in zip(self.times_ns, self.scene.frame_indices, strict=True)
        ]
        return sorted(found, key=lambda one: one[0])


def packed(columns):
    """Points as the bytes of a cloud whose fields are `POINT_FIELDS` and x."""
    xyz_m, intensity, ring, offset_ns = columns
    kind = np.dtype(
        {
            "names": ["intensity", "z", "y", "ring", "t", "x"],
            "formats": ["<f4", "<f4", "<f4", "<u2", "<u4", "<f4"],
            "offsets": [0, 4, 8, 12, 14, 18],
            "itemsize": POINT_BYTES,
        }
    )
    rows = np.zeros(len(xyz_m), kind)
    rows["x"], rows["y"], rows["z"] = xyz_m.T
    rows["intensity"], rows["ring"], rows["t"] = intensity, ring, offset_ns
    return rows.tobytes()


@cache
def ros_types():
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    others = {
        "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
        "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
        "geometry_msgs/PoseWithCovariance pose",
        "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
        "vision_msgs/msg/Detection3D": "std_msgs/Header header\n"
        "vision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id",
        "foxglove_msgs/msg/CompressedVideo": "builtin_interfaces/Time timestamp\n"
        "string frame_id\nuint8[] data\nstring format",
        "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\n"
        "vision_msgs/Detection3D[] detections",
    }
    for name, text in others.items():
        store.register(get_types_from_msg(text, name))
    return store


class RosWriter:
    """Messages of ROS 2 into an MCAP file."""

    def __init__(self, file, **options):
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        self._opened = Path(file).open("wb")  # noqa: SIM115 - closed with the writer
        self._writer = Writer(self._opened, **{"chunk_size": 1 << 18} | options)
        self._writer.start(profile="ros2")
        self._channels = {}
        self.types = ros_types()

    def __enter__(self):
        return self

    def __exit__(self, *_error):
        self._writer.finish()
        self._opened.close()

    def make(self, name, /, **values):
        package, own = name.split("/")
        return self.types.types[f"{package}/msg/{own}"](**values)

    def stamp(self, time_ns):
        return self.make("builtin_interfaces/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)

    def header(self, time_ns, frame):
        return self.make("std_msgs/Header", stamp=self.stamp(time_ns), frame_id=frame)

    def write(self, topic, log_ns, message):
        name = message.__msgtype__
        if topic not in self._channels:
            text, _ = self.types.generate_msgdef(name, ros_version=2)
            schema = self._writer.register_schema(name, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        data = bytes(self.types.serialize_cdr(message, name))
        self._writer.add_message(self._channels[topic], log_ns, data, log_ns)

    def transform(self, time_ns, parent, child, pose):
        place, turn = place_and_turn(pose)
        moved = self.make(
            "geometry_msgs/Transform",
            translation=self.make("geometry_msgs/Vector3", **place),
            rotation=self.make("geometry_msgs/Quaternion", **turn),
        )
        header = self.header(time_ns, parent)
        kind = "geometry_msgs/TransformStamped"
        return self.make(kind, header=header, child_frame_id=child, transform=moved)

    def pose(self, pose):
        place, turn = place_and_turn(pose)
        return self.make(
            "geometry_msgs/Pose",
            position=self.make("geometry_msgs/Point", **place),
            orientation=self.make("geometry_msgs/Quaternion", **turn),
        )

    def image(self, time_ns, frame, jpeg):
        header, data = self.header(time_ns, frame), np.frombuffer(bytes(jpeg), np.uint8)
        return self.make("sensor_msgs/CompressedImage", header=header, format="jpeg", data=data)

    def lens(self, time_ns, frame, camera, distortion):
        k, p, terms = calibration(camera, distortion)
        roi = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self.header(time_ns, frame),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model="plumb_bob",
            d=np.array(terms),
            k=np.array(k),
            r=np.eye(3).ravel(),
            p=np.array(p),
            binning_x=0,
            binning_y=0,
            roi=self.make("sensor_msgs/RegionOfInterest", do_rectify=False, **roi),
        )

    def cloud(self, time_ns, frame, data):
        fields = [
            self.make("sensor_msgs/PointField", name=name, offset=at, datatype=kind, count=1)
            for name, at, kind in (*POINT_FIELDS, ("x", 18, 7))
        ]
        return self.make(
            "sensor_msgs/PointCloud2",
            header=self.header(time_ns, frame),
            height=1,
            width=len(data) // POINT_BYTES,
            fields=fields,
            is_bigendian=False,
            point_step=POINT_BYTES,
            row_step=len(data),
            data=np.frombuffer(data, np.uint8),
            is_dense=True,
        )

    def detections(self, time_ns, boxes):
        found, header = [], self.header(time_ns, WORLD)
        for _, track, pose in boxes:
            size_m = dict(zip("xyz", track.size_m.tolist(), strict=True))
            size, place = self.make("geometry_msgs/Vector3", **size_m), self.pose(pose)
            kind = "geometry_msgs/PoseWithCovariance"
            result = self.make(
                "vision_msgs/ObjectHypothesisWithPose",
                hypothesis=self.make(
                    "vision_msgs/ObjectHypothesis", class_id=track.category, score=1.0
                ),
                pose=self.make(kind, pose=place, covariance=np.zeros(36)),
            )
            box = self.make("vision_msgs/BoundingBox3D", center=place, size=size)
            about = {"header": header, "results": [result], "bbox": box, "id": track.actor_id}
            found.append(self.make("vision_msgs/Detection3D", **about))
        return self.make("vision_msgs/Detection3DArray", header=header, detections=found)


def write_ros_bag(scene, file, *, are_cameras_free=False):
    """Write a scene as ROS 2 would have recorded it."""
    bag = BagScene(scene, are_cameras_free=are_cameras_free)
    with RosWriter(file) as writer:
        for log_ns, kind, content in bag.messages():
            for topic, message in _ros_messages(writer, bag, log_ns, kind, content):
                writer.write(f"/{topic}", log_ns, message)


def _ros_messages(writer, bag, log_ns, kind, content):
    if kind == "mounts":
        transforms = [writer.transform(0, *mount) for mount in bag.mounts()]
        yield "tf_static", writer.make("tf2_msgs/TFMessage", transforms=transforms)
    elif kind == "transform":
        yield "tf", writer.make("tf2_msgs/TFMessage", transforms=[writer.transform(*content)])
    elif kind == "lens":
        lens = writer.lens(log_ns, content, bag.cameras[content], bag.lenses[content])
        yield f"cameras/{content}/camera_info", lens
    elif kind == "image":
        record, view = content
        jpeg = bag.scene.read_jpeg(view)
        image = writer.image(record.timestamp_ns, record.camera_name, jpeg)
        yield CAMERA.format(record.camera_name), image
    elif kind == "sweep":
        start_ns, columns = bag.cloud(content)
        cloud = writer.cloud(start_ns, content.lidar_name, packed(columns))
        yield LIDAR.format(content.lidar_name), cloud
    else:
        boxes = list(bag.boxes(content))
        time_ns = bag.scene.sweeps_of(content)[0].timestamp_ns
        yield "detections", writer.detections(time_ns, boxes)


def place_and_turn(pose):
    """Of a pose: x, y, z, and those of the quaternion with w, by name."""
    turn = quaternion_from_rotation(pose[:3, :3]).tolist()
    place = pose[:3, 3].tolist()
    return dict(zip("xyz", place, strict=True)), dict(zip("wxyz", turn, strict=True))


def calibration(camera, distortion):
    """K, P and D of a calibration message; pixels count from the centre of the first."""
    fx, fy, cx, cy = camera.fx_px, camera.fy_px, camera.cx_px - 0.5, camera.cy_px - 0.5
    k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return k, p, [*distortion.terms, *[0.0] * 5][: max(5, len(distortion.terms))]


def write_foxglove_bag(scene, file):
    """Write a scene as Foxglove's SDK does."""
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    bag, context, channels = BagScene(scene), Context(), {}
    with foxglove.open_mcap(file, context=context):
        for log_ns, kind, content in bag.messages():
            for topic, message in _foxglove_messages(bag, log_ns, kind, content):
                if topic not in channels:
                    form = {"schema": message.get_schema(), "message_encoding": "protobuf"}
                    channels[topic] = Channel(f"/{topic}", **form, context=context)
                channels[topic].log(message.encode(), log_time=log_ns)


def _foxglove_messages(bag, log_ns, kind, content):
    if kind == "mounts":
        found = [_frame_transform(0, *mount) for mount in bag.mounts()]
        yield "tf_static", fox.FrameTransforms(transforms=found)
    elif kind == "transform":
        yield "tf", _frame_transform(*content)
    elif kind == "lens":
        camera = bag.cameras[content]
        k, p, terms = calibration(camera, bag.lenses[content])
        yield (
            f"cameras/{content}/calibration",
            fox.CameraCalibration(
                timestamp=_timestamp(log_ns),
                frame_id=content,
                width=camera.width_px,
                height=camera.height_px,
                distortion_model="plumb_bob",
                D=terms,
                K=k,
                P=p,
                R=np.eye(3).ravel().tolist(),
            ),
        )
    elif kind == "image":
        yield (
            CAMERA.format(content[0].camera_name),
            fox.CompressedImage(
                timestamp=_timestamp(content[0].timestamp_ns),
                frame_id=content[0].camera_name,
                data=bytes(bag.scene.read_jpeg(content[1])),
                format="jpeg",
            ),
        )
    elif kind == "sweep":
        start_ns, columns = bag.cloud(content)
        kinds = fox.PackedElementFieldNumericType
        of_ros = {7: kinds.Float32, 4: kinds.Uint16, 6: kinds.Uint32}
        fields = [
            fox.PackedElementField(name=name, offset=at, type=of_ros[kind])
            for name, at, kind in (*POINT_FIELDS, ("x", 18, 7))
        ]
        yield (
            LIDAR.format(content.lidar_name),
            fox.PointCloud(
                timestamp=_timestamp(start_ns),
                frame_id=content.lidar_name,
                pose=fox.Pose(
                    position=fox.Vector3(x=0, y=0, z=0),
                    orientation=fox.Quaternion(x=0, y=0, z=0, w=1),
                ),
                point_stride=POINT_BYTES,
                fields=fields,
                data=packed(columns),
            ),
        )
    else:
        yield "scene", fox.SceneUpdate(entities=[_entity(*box) for box in bag.boxes(content)])


def _entity(time_ns, track, pose):
    place, turn = place_and_turn(pose)
    cube = fox.CubePrimitive(
        pose=fox.Pose(position=fox.Vector3(**place), orientation=fox.Quaternion(**turn)),
        size=fox.Vector3(**dict(zip("xyz", track.size_m.tolist(), strict=True))),
        color=fox.Color(r=1, g=0, b=0, a=1),
    )
    return fox.SceneEntity(
        timestamp=_timestamp(time_ns),
        frame_id=WORLD,
        id=track.actor_id,
        metadata=[fox.KeyValuePair(key="category", value=track.category)],
        cubes=[cube],
    )


def _frame_transform(time_ns, parent, child, pose):
    place, turn = place_and_turn(pose)
    return fox.FrameTransform(
        timestamp=_timestamp(time_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=fox.Vector3(**place),
        rotation=fox.Quaternion(**turn),
    )


def _timestamp(time_ns):
    return fox.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
