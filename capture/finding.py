"""What one check of the preflight looks at and what it says: in order or not, with figures and what to do."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from capture.clock import Clock
from capture.config import Config


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    name: str
    ok: bool
    found: str  # with its figures
    remedy: str = ""  # what to do, where it is not in order
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "name": self.name,
            "ok": self.ok,
            "found": self.found,
            "remedy": self.remedy,
            "numbers": dict(self.numbers),
        }


@dataclass(frozen=True)
class Situation:
    """What a check may look at."""

    config: Config
    clock: Clock


Check = Callable[[Situation], list[Finding]]
"""Looks at one thing and says what it found, good or bad. A CaptureError that it raises is a finding too."""
