"""Patterns of the addresses, ports, system ids and key files in the node's settings."""

_BYTE = r"(?:[0-9]|[1-9][0-9]|1[0-9]{2}|2[0-4][0-9]|25[0-5])"
_IPV4 = rf"(?:{_BYTE}\.){{3}}{_BYTE}"
# The last label of a name has a letter, so that 999.1.1.1 is not taken for a name.
_NAME = r"(?:[A-Za-z0-9_-]+\.)*[0-9_-]*[A-Za-z][A-Za-z0-9_-]*\.?"
_SYSTEM = r"(?:[1-9]|[1-9][0-9]|1[0-9]{2}|2[0-4][0-9]|25[0-5])"
_PORT = r"(?:[0-9]{1,4}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"

ADDRESS = rf"(?:{_IPV4}|{_NAME})"
"""An IPv4 address, or a name."""

ANY_ADDRESS = rf"(?:{ADDRESS}|[0-9A-Fa-f.]*:[0-9A-Fa-f.:]+)"
"""An IPv4 or IPv6 address, or a name."""

CONNECTION = rf"udp(?:in|out):{ADDRESS}:{_PORT}|/[A-Za-z0-9_./:,-]+"
"""What `aero_planner.onboard.transport.open_transport` opens."""

GOAL_SENDER = rf"(?:vehicle|{_SYSTEM}@{ADDRESS})"
"""A sender of goals."""
TOPIC = r"(/[A-Za-z_]\w*)+"
"""Name of a topic of ROS 2, such as /livox/lidar."""

KEY_FILE = r"[A-Za-z0-9_./~+-]+"
"""The path of a file with a key, or none."""
