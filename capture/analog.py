"""The trigger board's analog samples to ``/analog``: one message for each configured channel, with the board's time."""

import contextlib

from capture.aux_log import Put
from capture.clock import Clock
from capture.config import AnalogConfig
from capture.errors import TriggerBoardError
from capture.listener import SILENT_S
from capture.record import ANALOG_TOPIC, Analog, Diagnostic
from capture.trigger import TriggerBoard
from capture.trigger_protocol import Sample

NAME = "analog"


class AnalogLog:
    """A companion that is handed the board's samples. A board without inputs does not stop a recording."""

    def __init__(self, config: AnalogConfig, clock: Clock) -> None:
        self.samples = 0
        self.messages = 0  # one for each configured channel of a sample
        self.lost = 0  # lines with a sample that did not come, or came garbled
        self._config = config
        self._clock = clock
        self._put: Put | None = None
        self._board: TriggerBoard | None = None
        self._trouble = "not begun"
        self._next: int | None = None
        self._taken_s = 0.0
        self._missing: set[int] = set()  # configured channels that the board does not have

    def begin(self, board: TriggerBoard) -> None:
        """Have ``board`` sample from now on. That it cannot stands in the statuses."""
        self._taken_s = self._clock.monotonic_s()
        try:
            board.sample(self._config.rate_hz)
        except TriggerBoardError as error:
            self._trouble = f"no analog samples: {error}"
            return
        self._board, self._trouble = board, ""

    def start(self, put: Put) -> None:
        """From now on samples are logged."""
        self._put = put

    def take(self, sample: Sample) -> None:
        """A sample; called from the board's reading thread."""
        put = self._put
        if put is None:
            return
        if self._next is not None and sample.number > self._next:
            self.lost += sample.number - self._next
        self._next = sample.number + 1
        self._taken_s = self._clock.monotonic_s()
        self.samples += 1
        now_ns = self._clock.utc_ns()
        for channel in self._config.channels:
            if channel.channel >= len(sample.volts):
                self._missing.add(channel.channel)
                continue
            volts = sample.volts[channel.channel]
            value = channel.scale * volts + channel.offset
            message = Analog(sample.time_ns, now_ns, sample.number, channel.channel, channel.name, volts, value)
            put(ANALOG_TOPIC, sample.time_ns, message.encode())
            self.messages += 1

    def statuses(self) -> list[Diagnostic]:
        """One line: refused, silent, lacking a channel, losing lines, or in order."""
        values = (("samples", str(self.samples)), ("lost", str(self.lost)))
        silent_s = self._clock.monotonic_s() - self._taken_s
        if self._trouble:
            return [Diagnostic(2, NAME, self._trouble, values)]
        if silent_s > SILENT_S:
            return [Diagnostic(2, NAME, f"no analog sample for {silent_s:.0f} s: check the trigger board", values)]
        if self._missing:
            said = f"the board has no channel {', '.join(map(str, sorted(self._missing)))}: correct [[analog.channels]]"
            return [Diagnostic(2, NAME, said, values)]
        return [Diagnostic(1 if self.lost else 0, NAME, "samples are lost" if self.lost else "sampling", values)]

    def stop(self) -> None:
        """No message after this returns. Safe to call twice."""
        self._put = None
        board, self._board = self._board, None
        if board is not None and board.error is None and not board.gone:
            with contextlib.suppress(TriggerBoardError):  # it has been silent before, and that is in the statuses
                board.sample(0.0)

    def account(self) -> dict[str, str]:
        """Samples taken and lost."""
        counts = {"samples": self.samples, "messages": self.messages, "lost": self.lost}
        return {f"{NAME}.{what}": str(count) for what, count in counts.items()}
