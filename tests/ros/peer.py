"""Another program in the graph, which does what the lines of its input say: python -m tests.ros.peer [NODE]

Each line is a JSON object, and so is each answer. {"read": [topics]} waits for the next message of each, with
clouds as their size; {"set": {name: value}} sets parameters of the node, by default /aero_viz,
and tells for each why not, or ""; {"get": [names]} and {"describe": [names]} return their values and descriptions.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from typing import Any

from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python

from aero_viz.ros.graph import Graph

_TIMEOUT = 60.0
_NODE = sys.argv[1] if len(sys.argv) > 1 else "/aero_viz"


def plain(value: Any) -> Any:
    """Return a message as plain values."""
    if hasattr(value, "point_step"):
        return {"frame": value.header.frame_id, "width": value.width, "fields": [f.name for f in value.fields]}
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return list(value)
    return value if isinstance(value, str | int | float) else [plain(item) for item in value]


def _wait(get: Any) -> Any:
    deadline = time.monotonic() + _TIMEOUT
    while (found := get()) is None:
        assert time.monotonic() < deadline, f"nothing in {_TIMEOUT:g} s"
        time.sleep(0.01)
    return found


@functools.cache
def _client(graph: Graph, service: Any, name: str) -> Any:
    return graph.node.create_client(service, f"{_NODE}/{name}")


def _call(graph: Graph, service: Any, name: str, request: Any) -> Any:
    client = _client(graph, service, name)
    assert client.wait_for_service(_TIMEOUT)
    future = client.call_async(request)
    return _wait(lambda: future.result() if future.done() else None)


def _read(graph: Graph, topics: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in topics:
        kind = _wait(lambda name=name: next((topic.types[0] for topic in graph.topics() if topic.name == name), None))
        graph.subscribe(name, kind, lambda message, name=name: found.setdefault(name, message))
    _wait(lambda: found if len(found) == len(topics) else None)
    return {name: plain(message) for name, message in found.items()}


def main() -> None:
    with Graph("peer") as graph:
        print("ready", flush=True)
        for line in sys.stdin:
            request = json.loads(line)
            (verb, content), answer = next(iter(request.items())), None
            if verb == "read":
                answer = _read(graph, content)
            elif verb == "set":
                values = [Parameter(name, value=value).to_parameter_msg() for name, value in content.items()]
                reply = _call(graph, SetParameters, "set_parameters", SetParameters.Request(parameters=values))
                answer = ["" if result.successful else result.reason for result in reply.results]
            elif verb == "get":
                reply = _call(graph, GetParameters, "get_parameters", GetParameters.Request(names=content))
                answer = [parameter_value_to_python(value) for value in reply.values]
            elif verb == "describe":
                reply = _call(
                    graph, DescribeParameters, "describe_parameters", DescribeParameters.Request(names=content)
                )
                answer = plain(reply.descriptors)
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
