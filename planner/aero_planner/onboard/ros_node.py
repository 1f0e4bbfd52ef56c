"""A node of ROS 2 that runs on a thread of its own, for the onboard node and the workbench. Imports rclpy when used."""

from __future__ import annotations

import importlib
import logging
import os
import threading
from collections.abc import Callable
from typing import Any

_log = logging.getLogger(__name__)

_DOMAIN_MAX = 232
"""Largest number of a domain: beyond it, Fast DDS has no ports left and ends the process."""
_SPIN_PERIOD = 0.5
"""Longest wait for a message, and so between two calls of `between` [s]."""
_CLOSE_TIMEOUT = 5.0
"""Longest wait for the thread of a node that is closed [s]."""


def open_context(domain: int | None = None) -> Any:
    """Return a context of rclpy that leaves signals alone, so that several live in one process.

    Args:
        domain: number of the domain; None is that of ROS_DOMAIN_ID.

    Raises:
        ImportError: there is no ROS 2.
        OSError: it cannot start in this domain; says what to do.
    """
    rclpy = importlib.import_module("rclpy")
    from rclpy.signals import SignalHandlerOptions

    number = os.environ.get("ROS_DOMAIN_ID") or "0" if domain is None else str(domain)
    context = rclpy.Context()
    try:
        if number.isdecimal() and int(number) > _DOMAIN_MAX:
            raise ValueError(f"domains are 0 to {_DOMAIN_MAX}")
        rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy raises several unrelated classes
        raise _cannot_start(context, number, error) from error
    return context


def _cannot_start(context: Any, domain: object, error: Exception) -> OSError:
    context.try_shutdown()
    return OSError(f"ROS 2 can't start in domain {domain}: {error}; check ROS_DOMAIN_ID.")


def message_class(type_name: str) -> Any:
    """Return the class of a type of messages, such as sensor_msgs/msg/PointCloud2.

    Raises:
        ImportError: its package is not installed, or has no such type.
    """
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ImportError(
            f"the messages {type_name} are not installed ({error}); source the workspace that has the package {package}"
        ) from error


class RosNode:
    """A node whose callbacks run one at a time on a thread of its own, from `start` to `close`.

    Args:
        context: see `open_context`; it outlives the node.
        name: name of the node.
        namespace: its namespace.
        parameters: True lets others list and set the node's parameters.

    Raises:
        OSError: it cannot start, and the context has ended; says what to do.

    Attributes:
        node: the node of rclpy.
    """

    def __init__(self, context: Any, name: str, *, namespace: str = "", parameters: bool = False) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        options: Any = {"start_parameter_services": parameters, "enable_rosout": False}
        try:
            self.node: Any = Node(name, context=context, namespace=namespace, **options)
        except Exception as error:  # as in `open_context`
            raise _cannot_start(context, context.get_domain_id(), error) from error
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, between: Callable[[], None] = lambda: None) -> None:
        """Start the thread, which calls `between` at least every half second."""
        name = f"ros-{self.node.get_name()}"
        self._thread = threading.Thread(target=self._run, args=(between,), name=name, daemon=True)
        self._thread.start()

    def _run(self, between: Callable[[], None]) -> None:
        while not self._closed.is_set():
            try:
                between()
                self._executor.spin_once(timeout_sec=_SPIN_PERIOD)
            except Exception:  # a message that cannot be read, for example; those that follow may be good
                if not self._closed.is_set():
                    _log.exception("a message of ROS 2 was lost")

    def close(self) -> None:
        """Leave the graph. May be called twice."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._executor.wake()
        if self._thread is not None:
            self._thread.join(_CLOSE_TIMEOUT)
        self._executor.shutdown(0.0)
        self.node.destroy_node()
