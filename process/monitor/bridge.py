"""Health and thumbnails to a live server of Foxglove's protocol, for its app on this computer or through a tunnel."""

import time
from typing import Any

import foxglove
from foxglove.channels import CompressedImageChannel, LogChannel
from foxglove.messages import CompressedImage, Log, LogLevel, Timestamp

from capture.errors import UsageError
from capture.worker import Worker
from process.monitor.app import Status
from process.monitor.gallery import Gallery

PERIOD_S = 0.5
HOST = "127.0.0.1"
"""Not an option: the protocol knows no token."""


class Bridge(Worker):
    """Publishes ``/health`` (JSON), ``/reasons`` (log) and ``/left/cam0/thumbnail`` … to those who subscribed."""

    def __init__(self, port: int, status: Status, gallery: Gallery) -> None:
        """Listen at ``port`` (0: any that is free).

        Raises:
            UsageError: the port cannot be had.
        """
        super().__init__("foxglove")
        self._status, self._gallery = status, gallery
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name="wingshape", host=HOST, port=port, context=self._context)
        except RuntimeError as error:
            raise UsageError(f"--foxglove {port}: cannot listen there ({error}): give another port") from error
        self.port: int = self._server.port
        self._health = foxglove.Channel("/health", message_encoding="json", context=self._context)
        self._reasons = LogChannel("/reasons", context=self._context)
        self._images: dict[str, Any] = {}
        self._shown: dict[str, int] = {}

    def work(self) -> None:
        """Publish twice a second until asked to stop."""
        try:
            while not self.stop_requested.wait(PERIOD_S):
                self.publish()
        finally:
            self._server.stop()

    def publish(self) -> None:
        """Send what is new."""
        health, verdict = self._status.health()
        if self._health.has_sinks():
            self._health.log({**({} if health is None else health.as_dict()), "go": verdict.go})
        if self._reasons.has_sinks():
            reasons = "; ".join(f"{reason.name}: {reason.message}" for reason in verdict.reasons)
            level = LogLevel.Info if verdict.go else LogLevel.Error
            text = "GO" if verdict.go else f"NO-GO: {reasons}"
            self._reasons.log(Log(timestamp=_now(), level=level, message=text, name="wingshape"))
        for place in health.previews if health is not None else ():
            if place not in self._images:
                self._images[place] = CompressedImageChannel(f"/{place}/thumbnail", context=self._context)
        if any(channel.has_sinks() for channel in self._images.values()):
            self._publish_pictures()

    def _publish_pictures(self) -> None:
        for place, picture in self._gallery.pictures().items():
            if place in self._images and self._shown.get(place) != picture.trigger_index:
                self._shown[place] = picture.trigger_index
                frame_id = place.replace("/", "_")
                image = CompressedImage(timestamp=_now(), frame_id=frame_id, data=picture.jpeg, format="jpeg")
                self._images[place].log(image)


def _now() -> Timestamp:
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    return Timestamp(sec=seconds, nsec=nanoseconds)
