"""Writers of logs as other programs write them, from the poses and commands of a record.

Their conversions are homogeneous matrices by scipy, which the readers do not use.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from identify.record.recording import poses

Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # turns z up into y up
FIRST_FRAME = 100  # number of the first frame of an export of Vicon


def matrices(record):
    """Homogeneous matrices (N, 4, 4) of the measured poses, NaN where lost."""
    measured = poses(record, "measured")
    found = np.full((len(measured), 4, 4), np.nan)
    ok = np.isfinite(measured).all(axis=1)
    found[ok] = np.eye(4)
    found[ok, :3, :3] = Rotation.from_euler("XYZ", measured[ok, 3:]).as_matrix()
    found[ok, :3, 3] = measured[ok, :3]
    return found


def cells(values):
    """Numbers as text; what is not finite is empty."""
    return ["" if not np.isfinite(value) else repr(float(value)) for value in values]


def quaternions(moved):
    """Unit quaternions (N, 4), x y z w, of matrices, NaN where lost."""
    found = np.full((len(moved), 4), np.nan)
    ok = np.isfinite(moved[:, 0, 0])
    found[ok] = Rotation.from_matrix(moved[ok, :3, :3]).as_quat()
    return found


def write_motive(path, record, version="1.23"):
    """An export of Motive: y up, millimetres, quaternions, and a marker beside the body."""
    moved = Y_UP @ matrices(record) @ np.linalg.inv(Y_UP)
    count = 4 + 3 + 1 + 3
    kinds = ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 3
    bodies = ["Plate"] * 8 + ["Plate:Marker1"] * 3
    what = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * 3
    labels = (["", "Type"], ["", "Name"], ["", "ID"]) if version > "1.23" else (["", ""],) * 3
    head = [
        f"Format Version,{version},Take Name,Take 1,Capture Frame Rate,60.000000,"
        "Export Frame Rate,60.000000,Rotation Type,Quaternion,Length Units,Millimeters,"
        "Coordinate Space,Global",
        "",
        ",".join([*labels[0], *kinds]),
        ",".join([*labels[1], *bodies]),
        ",".join([*labels[2], *(["6F"] * count)]),
        ",".join(["", "", *what]),
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z",
    ]
    turned = quaternions(moved)
    rows = [
        ",".join(
            [
                str(k),
                repr(float(time)),
                *cells(turned[k]),
                *cells(1e3 * moved[k, :3, 3]),
                *cells([0.01, 1.0, 2.0, 3.0]),
            ]
        )
        for k, time in enumerate(record["time"].values)
    ]
    path.write_text("\n".join([*head, *rows]) + "\n")


def write_vicon(path, record, frame_from_base, platform_from_body):
    """An export of Vicon: rotation vectors in degrees, millimetres, frames of a rate."""
    moved = frame_from_base @ matrices(record) @ platform_from_body
    head = [
        "Segments",
        "60",
        ",,Base:Base,,,,,,Plate:Plate,,,,,",
        "Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,RY,RZ,TX,TY,TZ",
        ",,deg,deg,deg,mm,mm,mm,deg,deg,deg,mm,mm,mm",
    ]
    rows = []
    for k, one in enumerate(moved):
        lost = not np.isfinite(one).all()
        turn = [np.nan] * 3 if lost else Rotation.from_matrix(one[:3, :3]).as_rotvec(degrees=True)
        still = ["0"] * 6
        rows.append(
            ",".join([str(k + FIRST_FRAME), "0", *still, *cells(turn), *cells(1e3 * one[:3, 3])])
        )
    path.write_text(
        "\n".join([*head, *rows]) + "\n\nTrajectories\n60\n,,M1,,\n"
        "Frame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n100,0,1,2,3\n"
    )


def write_commands(path, record, signs, zeros, offset_s=0.0):
    """A table of commands alone: degrees, other directions and zeros, milliseconds."""
    degrees = np.rad2deg(record["command"].values) * signs + zeros
    lines = ["t_ms;" + ";".join(f"q{k}" for k in range(degrees.shape[1]))]
    for time, row in zip(record["time"].values, degrees, strict=True):
        lines.append(";".join([repr(1e3 * (float(time) - offset_s)), *cells(row)]))
    path.write_text("\n".join(lines) + "\n")


def message_types():
    """The types of messages of ROS 2 Humble: a store, and classes by their names."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    return store, {name.rpartition("/")[2]: kind for name, kind in store.types.items()}


def write_transforms(folder, count):
    """A bag of transforms, those of the plate in every second message, and arrays without stamp.

    Message k is of k ms after 1.7e9 s, and written 5 us later; the plate is at x = 0.01 k.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    store, kinds = message_types()
    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {
            kind: bag.add_connection(topic, kinds[kind].__msgtype__, typestore=store)
            for topic, kind in (("/tf", "TFMessage"), ("/cmd", "Float64MultiArray"))
        }
        for k in range(count):
            stamp = kinds["Time"](sec=1_700_000_000, nanosec=k * 1_000_000)
            header = kinds["Header"](stamp=stamp, frame_id="world")
            bodies = {"base": 0.0} | ({"vicon/plate.1": 0.01 * k} if k % 2 else {})
            transforms = [
                kinds["TransformStamped"](
                    header=header,
                    child_frame_id=name,
                    transform=kinds["Transform"](
                        translation=kinds["Vector3"](x, 0.0, 0.2),
                        rotation=kinds["Quaternion"](0.0, 0.0, 0.0, 1.0),
                    ),
                )
                for name, x in bodies.items()
            ]
            layout = kinds["MultiArrayLayout"](dim=[], data_offset=0)
            moment = 1_700_000_000_000_000_000 + k * 1_000_000 + 5_000
            for message in (
                kinds["TFMessage"](transforms=transforms),
                kinds["Float64MultiArray"](layout=layout, data=k + np.arange(6.0)),
            ):
                raw = store.serialize_cdr(message, message.__msgtype__)
                bag.write(topics[type(message).__name__.rpartition("__")[2]], moment, raw)


def write_bag(folder, record, start_ns=1_700_000_000_000_000_000, mcap=True):
    """A bag of ROS 2: stamped poses, commands as joint states in another order, and a text."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    store, kinds = message_types()
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    moved = matrices(record)
    turned = quaternions(moved)
    command = record["command"].values
    names = [f"crank{k + 1}" for k in range(command.shape[1])]
    order = np.arange(len(names))[::-1]
    with Writer(folder, version=8, storage_plugin=plugin) as bag:
        topics = {
            topic: bag.add_connection(topic, kinds[kind].__msgtype__, typestore=store)
            for topic, kind in (
                ("/plate/pose", "PoseStamped"),
                ("/joint_commands", "JointState"),
                ("/rosout", "String"),
            )
        }

        def write(topic, moment, message):
            raw = store.serialize_cdr(message, message.__msgtype__)
            bag.write(topics[topic], moment + 300_000, raw)

        for k, time in enumerate(record["time"].values):
            moment = start_ns + round(1e9 * float(time))
            stamp = kinds["Time"](sec=moment // 10**9, nanosec=moment % 10**9)
            header = kinds["Header"](stamp=stamp, frame_id="base")
            # Its tracker sends no message where the pose is lost.
            if np.isfinite(moved[k]).all():
                pose = kinds["Pose"](
                    position=kinds["Point"](*moved[k, :3, 3].tolist()),
                    orientation=kinds["Quaternion"](*turned[k].tolist()),
                )
                write("/plate/pose", moment, kinds["PoseStamped"](header=header, pose=pose))
            write(
                "/joint_commands",
                moment,
                kinds["JointState"](
                    header=header,
                    name=[names[place] for place in order],
                    position=command[k, order],
                    velocity=np.array([]),
                    effort=np.array([]),
                ),
            )
            if k % 50 == 0:
                write("/rosout", moment, kinds["String"](data="all is well"))
