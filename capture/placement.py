"""A thread's share of the machine: real-time priority and processors, taken by the thread itself."""

import os
from dataclasses import dataclass


@dataclass(frozen=True)
class Placement:
    """Where and how a thread runs. The default changes nothing."""

    priority: int = 0  # of SCHED_FIFO, 1 to 99; 0: the usual scheduler
    cpus: tuple[int, ...] = ()  # processors it may run on; none named: any

    def take(self) -> str | None:
        """Apply to the calling thread; what the system refused, or None."""
        try:
            if self.cpus:
                os.sched_setaffinity(0, self.cpus)
        except OSError as error:
            return f"processors {self.cpus} cannot be used ({error.strerror}): correct `threads` in the configuration"
        try:
            if self.priority:
                policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK  # threads that it starts choose for themselves
                os.sched_setscheduler(0, policy, os.sched_param(self.priority))
        except OSError as error:
            return f"no real-time priority {self.priority} ({error.strerror}): allow it with LimitRTPRIO"
        return None
