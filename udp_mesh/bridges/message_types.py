"""Message types that the bridges know in both versions of ROS: their ROS 1 definitions, without comments. Pure.

Only types listed here or in the bridge's configuration are converted between ROS 1 and ROS 2 (`mixed_team`): a type of
the same name need not have the same fields. The md5sums that follow from these texts are those of the ROS 1 packages
(tests/udp_mesh/bridges/test_message_codec.py compares them).
"""

from __future__ import annotations

from typing import Dict, Optional

from udp_mesh.bridges.message_definition import MessageDefinition

_NEXT = "=" * 80 + "\nMSG: "
_PARTS = {
    "std_msgs/Header": "uint32 seq\ntime stamp\nstring frame_id\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation\n",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular\n",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation\n",
    "geometry_msgs/TransformStamped": "Header header\nstring child_frame_id\nTransform transform\n",
    "sensor_msgs/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n"
        "uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
}
_POSE = ("geometry_msgs/Pose", "geometry_msgs/Point", "geometry_msgs/Quaternion")
_TWIST = ("geometry_msgs/Twist", "geometry_msgs/Vector3")
_CLOUD = (
    "Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\nuint32 point_step\n"
    "uint32 row_step\nuint8[] data\nbool is_dense\n"
)


def contained(name: str, text: Optional[str] = None) -> str:
    """A message inside another, as it follows the other's own fields. Without `text`: one that is known here."""
    return "{}{}\n{}".format(_NEXT, name, _PARTS[name] if text is None else text)


def _defined(name: str, text: str, *parts: str) -> MessageDefinition:
    return MessageDefinition(name, text + "".join(contained(part) for part in parts))


TYPES: Dict[str, MessageDefinition] = {
    each.name: each
    for each in (
        _defined("std_msgs/String", "string data\n"),
        _defined("std_msgs/Empty", ""),
        _defined("std_msgs/Bool", "bool data\n"),
        _defined("std_msgs/Int32", "int32 data\n"),
        _defined("std_msgs/Float32", "float32 data\n"),
        _defined("std_msgs/Float64", "float64 data\n"),
        _defined("geometry_msgs/Point", _PARTS["geometry_msgs/Point"]),
        _defined("geometry_msgs/Twist", _PARTS["geometry_msgs/Twist"], "geometry_msgs/Vector3"),
        _defined("geometry_msgs/PoseStamped", "Header header\nPose pose\n", "std_msgs/Header", *_POSE),
        _defined(
            "nav_msgs/Odometry",
            "Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
            "geometry_msgs/TwistWithCovariance twist\n",
            *("std_msgs/Header", "geometry_msgs/PoseWithCovariance", *_POSE),
            *("geometry_msgs/TwistWithCovariance", *_TWIST),
        ),
        _defined(
            "nav_msgs/Path",
            "Header header\ngeometry_msgs/PoseStamped[] poses\n" + _NEXT + "geometry_msgs/PoseStamped\n"
            "Header header\nPose pose\n",
            *("std_msgs/Header", *_POSE),
        ),
        _defined("sensor_msgs/PointCloud2", _CLOUD, "std_msgs/Header", "sensor_msgs/PointField"),
        _defined("sensor_msgs/CompressedImage", "Header header\nstring format\nuint8[] data\n", "std_msgs/Header"),
        _defined(
            "sensor_msgs/Image",
            "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
            "uint8[] data\n",
            "std_msgs/Header",
        ),
        _defined(
            "tf2_msgs/TFMessage",
            "geometry_msgs/TransformStamped[] transforms\n",
            *("geometry_msgs/TransformStamped", "std_msgs/Header", "geometry_msgs/Transform"),
            *("geometry_msgs/Vector3", "geometry_msgs/Quaternion"),
        ),
    )
}
