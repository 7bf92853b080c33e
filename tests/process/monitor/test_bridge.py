"""The live server by its wire protocol: what is advertised comes when it is subscribed to."""

import base64
import json
import os
import re
import socket
import struct
import time

import pytest
from needs import needs_module

pytestmark = pytest.mark.slow  # the extra `foxglove` is installed with the peers


class WebSocket:
    """The little of RFC 6455 that a client needs."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=10)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self._rest = b""
        while b"\r\n\r\n" not in self._rest:
            self._rest += self._socket.recv(4096)
        head, self._rest = self._rest.split(b"\r\n\r\n", 1)
        assert head.startswith(b"HTTP/1.1 101")

    def send(self, text: str) -> None:
        data, mask = text.encode(), os.urandom(4)
        assert len(data) < 126
        self._socket.sendall(
            bytes([0x81, 0x80 | len(data)]) + mask + bytes(b ^ mask[k % 4] for k, b in enumerate(data))
        )

    def receive(self) -> tuple[int, bytes]:
        """Opcode and payload of the next message."""
        first, length = self._take(2)
        length &= 0x7F
        if length == 126:
            (length,) = struct.unpack(">H", self._take(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self._take(8))
        assert first & 0x80, "a message in one frame"
        return first & 0x0F, self._take(length)

    def _take(self, count: int) -> bytes:
        while len(self._rest) < count:
            more = self._socket.recv(65536)
            assert more, "the server hung up"
            self._rest += more
        taken, self._rest = self._rest[:count], self._rest[count:]
        return taken

    def close(self) -> None:
        self._socket.close()


def test_health_reasons_and_thumbnails_come_to_a_subscriber(field):
    needs_module("foxglove")
    field.start_rig()
    field.start_recorder()
    field.start_monitor("--foxglove", 0)
    port = int(re.search(r"foxglove: ws://127\.0\.0\.1:(\d+)", field.said("monitor"))[1])
    field.wait_for(lambda status: status["go"])
    time.sleep(1.5)  # until the bridge has seen which cameras there are
    client = WebSocket(port)
    channels: dict[str, int] = {}
    while len(channels) < 6:
        opcode, data = client.receive()
        if opcode == 1 and (message := json.loads(data))["op"] == "advertise":
            channels |= {channel["topic"]: channel["id"] for channel in message["channels"]}
    cameras = ("left/cam0", "left/cam1", "right/cam0", "right/cam1")
    assert set(channels) == {"/health", "/reasons", *(f"/{camera}/thumbnail" for camera in cameras)}
    wanted = {1: "/health", 2: "/reasons", 3: "/right/cam1/thumbnail"}
    for number, topic in wanted.items():
        subscription = {"id": number, "channelId": channels[topic]}
        client.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
    found: dict[int, bytes] = {}
    while len(found) < 3:
        opcode, data = client.receive()
        if opcode == 2 and data[0] == 1:  # message data: subscription, time, payload
            found[struct.unpack_from("<I", data, 1)[0]] = data[13:]
    client.close()
    health = json.loads(found[1])
    assert (health["go"], health["flight"], len(health["cameras"])) == (True, "test_07", 4)
    assert b"GO" in found[2]
    assert b"\xff\xd8\xff" in found[3]  # a JPEG within
    assert field.recorded()["frames_lost"] == 0
