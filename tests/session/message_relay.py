"""A relay between a node and its viewers that loses, delays, repeats and reorders messages."""

import contextlib
import socket
import struct
import threading
from collections.abc import Callable, Iterator

_HEADER = struct.Struct("<4sHHIII")

Handler = Callable[[int, bytes], list[bytes]]
"""Gets kind and bytes of a message, and returns what is passed on."""


def _pass_on(_: int, message: bytes) -> list[bytes]:
    return [message]


class MessageRelay:
    """Passes messages on over sockets of its own. Use it as a context manager.

    Args:
        port: TCP port of the node.

    Attributes:
        port: TCP port for the viewer.
        to_node, to_viewer: what becomes of each message.
    """

    def __init__(self, port: int) -> None:
        self.to_node: Handler = _pass_on
        self.to_viewer: Handler = _pass_on
        self._node_port = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._connections: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> "MessageRelay":
        return self

    def __exit__(self, *_: object) -> None:
        self._server.close()
        self.cut()

    def cut(self) -> None:
        """End all connections."""
        for connection in self._connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def send_to_node(self, message: bytes) -> None:
        """Send a message to the node on the newest connection."""
        self._connections[-1].sendall(message)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                viewer, _ = self._server.accept()
                node = socket.create_connection(("127.0.0.1", self._node_port))
                self._connections += [viewer, node]
                for source, target, is_up in ((viewer, node, True), (node, viewer, False)):
                    threading.Thread(target=self._pump, args=(source, target, is_up), daemon=True).start()

    def _pump(self, source: socket.socket, target: socket.socket, is_up: bool) -> None:
        with contextlib.suppress(OSError):
            for kind, message in _messages(source):
                for passed in (self.to_node if is_up else self.to_viewer)(kind, message):
                    target.sendall(passed)
        with contextlib.suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


def _messages(source: socket.socket) -> Iterator[tuple[int, bytes]]:
    buffer = b""
    while data := source.recv(1 << 16):
        buffer += data
        while len(buffer) >= _HEADER.size:
            _, _, kind, length, _, _ = _HEADER.unpack_from(buffer)
            if len(buffer) < (end := _HEADER.size + length):
                break
            yield kind, buffer[:end]
            buffer = buffer[end:]
