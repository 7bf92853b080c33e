"""Messages on /can, /analog and /mavlink, held against what the recorder says in its last record that it heard."""

import json
from collections import Counter
from pathlib import Path

from capture.record import ANALOG_TOPIC, CAN_TOPIC, MAVLINK_TOPIC

_TOPICS = {"can": CAN_TOPIC, "analog": ANALOG_TOPIC, "mavlink": MAVLINK_TOPIC}  # by the first word of an account's keys


class OtherBooks:
    """The books of what was recorded beside the frames, of all aux files of a flight."""

    def __init__(self) -> None:
        self.problems: list[str] = []
        self._notes: dict[str, None] = {}  # the two disks' accounts are one
        self._counted: Counter[tuple[Path, str]] = Counter()

    @property
    def notes(self) -> list[str]:
        """What was lost or gone, as the recorder itself says."""
        return list(self._notes)

    def take(self, path: Path, topic: str) -> None:
        """A message that is there."""
        self._counted[path, topic] += 1

    def close(self, path: Path, end: dict[str, str]) -> None:
        """The file's last record. One that cannot be understood is a problem."""
        try:
            self._hold_against(path, end)
        except ValueError as error:
            self.problems.append(f"{path}: its last record's account of other data cannot be read ({error})")

    def _hold_against(self, path: Path, end: dict[str, str]) -> None:
        dropped: dict[str, int] = json.loads(end.get("aux_dropped", "{}"))
        heard: Counter[str] = Counter()
        for key, value in end.items():
            source, _, what = key.rpartition(".")
            topic = _TOPICS.get(source.partition(".")[0])
            if topic is None:
                continue
            if what == "messages":
                heard[topic] += int(value)
            elif what == "lost" and value not in ("{}", "0"):
                self._notes[f"{source}: messages lost: {value}"] = None
            elif what == "outages_in_all" and int(value):
                self._notes[f"{source}: was gone {value} times"] = None
        for topic, count in heard.items():
            there, lost = self._counted[path, topic], dropped.get(topic, 0)
            if lost:
                self._notes[f"{lost} messages on {topic} found no room in the recorder"] = None
            if there != count - lost:
                self.problems.append(f"{path}: {there} messages on {topic}, the recorder counted {count - lost}")
