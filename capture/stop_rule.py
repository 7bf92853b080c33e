"""What a recording is told from outside, to when it begins and ends."""

import threading
from dataclasses import dataclass, field


@dataclass(frozen=True)
class StopRule:
    """When a recording ends by itself; it always ends when ``requested`` is set."""

    requested: threading.Event
    triggers: int = 0  # 0: no limit
    duration_s: float = 0.0  # 0: no limit
    begin: threading.Event = field(default_factory=threading.Event)  # wait no longer for what starts it

    def reached(self, triggers: int, seconds: float) -> bool:
        """One of the limits is."""
        return bool((self.triggers and triggers >= self.triggers) or (self.duration_s and seconds >= self.duration_s))
