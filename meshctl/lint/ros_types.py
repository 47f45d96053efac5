"""The messages of ROS's own packages, which are complete: a name that is not among them does not exist.

Sources: common_msgs and std_msgs of Noetic, common_interfaces and rcl_interfaces of Humble to Jazzy; both together,
since a topic's type does not say which ROS its robots run.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

MESSAGES: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        package: frozenset(names.split())
        for package, names in {
            "std_msgs": """Bool Byte ByteMultiArray Char ColorRGBA Duration Empty Float32 Float32MultiArray Float64
                Float64MultiArray Header Int16 Int16MultiArray Int32 Int32MultiArray Int64 Int64MultiArray Int8
                Int8MultiArray MultiArrayDimension MultiArrayLayout String Time UInt16 UInt16MultiArray UInt32
                UInt32MultiArray UInt64 UInt64MultiArray UInt8 UInt8MultiArray""",
            "geometry_msgs": """Accel AccelStamped AccelWithCovariance AccelWithCovarianceStamped Inertia
                InertiaStamped Point Point32 PointStamped Polygon PolygonInstance PolygonInstanceStamped PolygonStamped
                Pose Pose2D PoseArray PoseStamped PoseStampedArray PoseWithCovariance PoseWithCovarianceStamped
                Quaternion QuaternionStamped Transform TransformStamped Twist TwistStamped TwistWithCovariance
                TwistWithCovarianceStamped Vector3 Vector3Stamped VelocityStamped Wrench WrenchStamped""",
            "sensor_msgs": """BatteryState CameraInfo ChannelFloat32 CompressedImage FluidPressure Illuminance Image
                Imu JointState Joy JoyFeedback JoyFeedbackArray LaserEcho LaserScan MagneticField MultiDOFJointState
                MultiEchoLaserScan NavSatFix NavSatStatus PointCloud PointCloud2 PointField Range RegionOfInterest
                RelativeHumidity Temperature TimeReference""",
            "nav_msgs": """Goals GetMapAction GetMapActionFeedback GetMapActionGoal GetMapActionResult GetMapFeedback
                GetMapGoal GetMapResult GridCells MapMetaData OccupancyGrid Odometry Path Trajectory TrajectoryPoint""",
            "diagnostic_msgs": "DiagnosticArray DiagnosticStatus KeyValue",
            "actionlib_msgs": "GoalID GoalStatus GoalStatusArray",
            "shape_msgs": "Mesh MeshTriangle Plane SolidPrimitive",
            "stereo_msgs": "DisparityImage",
            "trajectory_msgs": """JointTrajectory JointTrajectoryPoint MultiDOFJointTrajectory
                MultiDOFJointTrajectoryPoint""",
            "visualization_msgs": """ImageMarker InteractiveMarker InteractiveMarkerControl InteractiveMarkerFeedback
                InteractiveMarkerInit InteractiveMarkerPose InteractiveMarkerUpdate Marker MarkerArray MenuEntry
                MeshFile UVCoordinate""",
        }.items()
    }
)
