"""Run by a Python with rosbags and Pillow, not by ours: writes a rosbag2 recording in MCAP as ROS 2 would.

python ros_bags.py FOLDER    two seconds: joints and commands at 100 Hz, a raw and a compressed camera at 30 Hz
"""

import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

BEGIN_NS, PX = 1_700_000_000_000_000_000, (48, 64)
NAMES = ["gripper", "wrist_yaw", "wrist_roll", "wrist_flex", "elbow_flex", "shoulder_lift", "shoulder_pan"]


def main(folder: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {name: store.types[name] for name in store.types}
    time, header = kinds["builtin_interfaces/msg/Time"], kinds["std_msgs/msg/Header"]

    def stamped(at_ns: int):
        return header(stamp=time(sec=at_ns // 10**9, nanosec=at_ns % 10**9), frame_id="base")

    def joints(at_ns: int, offset: float):
        values = offset + 0.001 * np.arange(7) + 0.1 * (at_ns - BEGIN_NS) / 1e9
        none = np.zeros(0)
        return kinds["sensor_msgs/msg/JointState"](
            header=stamped(at_ns), name=NAMES, position=values, velocity=none, effort=none
        )

    def raw(at_ns: int, shade: int):
        pixels = np.full((*PX, 3), shade, np.uint8)
        pixels[..., 2] = 200  # blue in rgb8
        return kinds["sensor_msgs/msg/Image"](
            header=stamped(at_ns), height=PX[0], width=PX[1], encoding="rgb8", is_bigendian=0, step=3 * PX[1],
            data=pixels.reshape(-1),
        )  # fmt: skip

    def compressed(at_ns: int, shade: int):
        file = io.BytesIO()
        Image.fromarray(np.full((*PX, 3), 255 - shade, np.uint8)).save(file, "JPEG", quality=95)
        return kinds["sensor_msgs/msg/CompressedImage"](
            header=stamped(at_ns), format="rgb8; jpeg compressed bgr8", data=np.frombuffer(file.getvalue(), np.uint8)
        )

    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        made = {}
        for topic, kind in (
            ("/joint_states", "JointState"), ("/commands", "JointState"),
            ("/front/image_raw", "Image"), ("/wrist/image/compressed", "CompressedImage"),
        ):  # fmt: skip
            made[topic] = bag.add_connection(topic, f"sensor_msgs/msg/{kind}", typestore=store)
        said = []
        for number in range(200):
            at_ns = BEGIN_NS + number * 10_000_000
            said += [(at_ns, "/joint_states", joints(at_ns, 0.0)), (at_ns + 1_000_000, "/commands", joints(at_ns, 0.5))]
        for number in range(60):
            at_ns = BEGIN_NS + number * 10**9 // 30
            said += [
                (at_ns, "/front/image_raw", raw(at_ns, 4 * number)),
                (at_ns, "/wrist/image/compressed", compressed(at_ns, 4 * number)),
            ]
        for at_ns, topic, message in sorted(said, key=lambda each: each[0]):
            connection = made[topic]
            # recorded 2 ms after its stamp
            bag.write(connection, at_ns + 2_000_000, store.serialize_cdr(message, connection.msgtype))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
