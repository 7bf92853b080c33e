"""The recorder's control socket, for start and stop from the page."""

from capture.errors import CaptureError
from capture.health import Health


class NoControl:
    """Where nobody may start or stop from the page."""

    def __init__(self, reason: str) -> None:
        self._reason = reason

    def refusal(self, health: Health | None) -> str | None:
        """Always the same."""
        return self._reason

    def act(self, health: Health, action: str) -> str:
        """Refused."""
        raise CaptureError(self._reason)
