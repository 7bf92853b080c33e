"""Start and stop from the page, by the recorder's control socket."""

from pathlib import Path

from capture.control import ask
from capture.errors import CaptureError
from capture.health import Health

NOT_ALLOWED = "start and stop are not allowed from this page: the monitor must be run with --control"


class Control:
    """Asks the recorder, where that is allowed."""

    def __init__(self, allowed: bool) -> None:
        self._allowed = allowed

    def refusal(self, health: Health | None) -> str | None:
        """Why it cannot be asked; None: it can."""
        if not self._allowed:
            return NOT_ALLOWED
        if health is None:
            return "there is no recorder to start or stop"
        if health.control_socket is None:
            return "this recorder takes no commands"
        return None

    def act(self, health: Health, action: str) -> str:
        """``start`` or ``stop``; the recorder's answer.

        Raises:
            CaptureError: it refused, or does not answer.
        """
        answer = ask(Path(str(health.control_socket)), action)
        if not answer.ok:
            raise CaptureError(answer.message)
        return answer.message
