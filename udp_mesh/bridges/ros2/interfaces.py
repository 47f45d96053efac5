"""Names of ROS 2 interfaces -> rclpy's classes, and what a caller gets when there is no response.

A peer chooses the names, so only messages, services and actions of a package are imported. rosidl_runtime_py has such a
function but is not part of every distribution of rclpy.
"""

from __future__ import annotations

import importlib
import re
from typing import Any, Optional

# https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html: package and message names
_NAME = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Z][A-Za-z0-9]*)(_SendGoal|_GetResult|_FeedbackMessage)?")
_PARTS = {
    "_SendGoal": "SendGoalService",
    "_GetResult": "GetResultService",
    "_FeedbackMessage": "FeedbackMessage",
}
STATUS_ABORTED = 6
"""action_msgs/msg/GoalStatus"""
ERROR_REJECTED = 1
"""action_msgs/srv/CancelGoal"""


def interface_class(name: str, *kinds: str) -> Any:
    """`std_msgs/msg/String` -> its class, if it is of one of these kinds (msg, srv, action). Raises ValueError,
    ModuleNotFoundError or AttributeError."""
    found = _NAME.fullmatch(name)
    if found is None or found[2] not in kinds or bool(found[4]) != (found[2] == "action"):
        raise ValueError("expected PACKAGE/{}/TYPE".format(kinds[0]))
    known = getattr(importlib.import_module("{}.{}".format(found[1], found[2])), found[3])
    return getattr(known.Impl, _PARTS[found[4]]) if found[4] else known


def unknown_type(name: str, error: Exception) -> str:
    """The line for the log when `interface_class` fails."""
    advice = ""
    if isinstance(error, (ModuleNotFoundError, AttributeError)):
        package = name.partition("/")[0]
        advice = ": install {} on this robot, or source the workspace that has it, and restart the bridge".format(
            package
        )
    return "type-unknown type={} {}{}".format(name, error, advice)


def failed_response(type_name: str, response: Any, text: str) -> Optional[Any]:
    """`response` as the error of a call that got none; None for a service that has no way to say so.

    Actions have: a goal that is rejected, a result of an aborted goal, a cancellation that is rejected. So do services
    with the fields of std_srvs/srv/Trigger and SetBool.
    """
    if type_name.endswith("_SendGoal"):
        response.accepted = False
    elif type_name.endswith("_GetResult"):
        response.status = STATUS_ABORTED
    elif type_name == "action_msgs/srv/CancelGoal":
        response.return_code = ERROR_REJECTED
    elif _has_error_fields(response.get_fields_and_field_types()):
        response.success, response.message = False, text
    else:
        return None
    return response


def _has_error_fields(fields: "dict[str, str]") -> bool:
    return fields.get("success") == "boolean" and fields.get("message") == "string"
