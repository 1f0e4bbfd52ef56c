"""Types of the ROS 2 messages in flight logs, and their definitions for MCAP's "ros2msg" schemas.

The types are ROS 2's own, so that other tools can read them, except for three that are defined here.
"""

from __future__ import annotations

ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
CLOUD = "sensor_msgs/msg/PointCloud2"
PATH = "nav_msgs/msg/Path"
GOAL = "geometry_msgs/msg/PoseStamped"
MARKERS = "visualization_msgs/msg/MarkerArray"
PLAN = "aero_viz_msgs/msg/Plan"
COSTS = "aero_viz_msgs/msg/Costs"
SAFETY = "aero_planner_msgs/msg/Safety"
MISSION = "std_msgs/msg/String"

PLAN_DEFINITION = """\
# Result of one tick of the planner. Arrays have one entry per instance of the ensemble, M in all.
std_msgs/Header header
string[] kinds            # "anchor", "previous", "brake"
int32 best                # instance that is flown
int32 status              # 0 safe, 1 no safe candidate: braking, 2 the cloud is stale: braking
float32[] stage2_cost     # S2 = J_goal + J_col + options
float32[] goal_cost       # J_goal
float32[] collision_cost  # J_col
float32[] clearance       # smallest distance to the cloud over the horizon [m]
float32[4] command        # first control: thrust [N], body rates [rad/s]
float32 plan_ms           # duration of planning [ms]
uint32 config_version     # attachment config_<version>.yaml
"""

COSTS_DEFINITION = """\
# Costs of the candidates of a plan, M in all, by term.
std_msgs/Header header
string[] terms
float32[] values          # term by term, the M candidates of each
"""

_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v\n",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data\n",
    "visualization_msgs/Marker": (
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n"
        "geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\n"
        "bool frame_locked\ngeometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n"
        "sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\nstring text\n"
        "string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n"
    ),
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
}
_MESSAGES = {
    ODOMETRY: (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    ),
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n",
    CLOUD: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    PATH: "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n",
    GOAL: _PARTS["geometry_msgs/PoseStamped"],
    MARKERS: "visualization_msgs/Marker[] markers\n",
    MISSION: "string data\n",
    PLAN: PLAN_DEFINITION,
    COSTS: COSTS_DEFINITION,
    SAFETY: (
        "# The node's safety state changed.\n"
        "std_msgs/Header header\nstring source  # state before\nstring target  # state now\nstring cause\n"
    ),
}


def _definition(text: str) -> str:
    """Return `text` followed by the definitions of the types it uses, as MCAP's "ros2msg" schemas require."""
    found: list[str] = []
    waiting = [text]
    while waiting:
        for line in waiting.pop(0).splitlines():
            name = line.split("#")[0].split(" ")[0].split("[")[0]
            if name in _PARTS and name not in found:
                found.append(name)
                waiting.append(_PARTS[name])
    return "".join([text, *(f"{'=' * 80}\nMSG: {name}\n{_PARTS[name]}" for name in found)])


DEFINITIONS: dict[str, str] = {kind: _definition(text) for kind, text in _MESSAGES.items()}
"""Definition of each message type, with those of the types it uses."""
