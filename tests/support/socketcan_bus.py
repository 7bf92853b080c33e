"""Run where there is SocketCAN (module vcan, root): a bus that is heard, flooded, taken down and brought back.

Writes what happened, as JSON, to the file named on the command line.
"""

import collections
import itertools
import json
import subprocess
import sys
import time
from pathlib import Path

import can

from capture.can_log import CanLink
from capture.clock import SystemClock
from capture.config import CanConfig
from capture.listener import Listener
from capture.record import CanFrame
from hw_sim.aircraft import Aircraft
from hw_sim.can_node import CanNode
from hw_sim.world import World

DEADLINE_S = 60.0
FLOOD = 20_000


def ip(*words: str) -> None:
    subprocess.run(["ip", "link", *words], check=True)


def wait_until(condition, what: str) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(what)
        time.sleep(0.05)


def main(out: Path) -> None:
    clock, told = SystemClock(), {}
    config = CanConfig(name="bus", interface="socketcan", channel="vcan0")
    heard: list[CanFrame] = []
    late_ns: list[int] = []

    def put(topic: str, time_ns: int, data: bytes) -> None:
        heard.append(CanFrame.decode(data))
        late_ns.append(clock.utc_ns() - time_ns)

    listener = Listener("can.bus", lambda: CanLink(config, clock), clock)
    listener.start(put)
    wait_until(lambda: "cannot be opened" in listener.statuses()[0].message, "said to be missing")
    ip("add", "vcan0", "type", "vcan")
    ip("set", "vcan0", "up")
    wait_until(lambda: listener.statuses()[0].level < 2, "found")

    node = CanNode(Aircraft(World.make(1, scale=8)), "socketcan:vcan0", clock)
    node.start()
    wait_until(lambda: len(heard) >= 300, "heard")
    node.close()
    time.sleep(1.0)
    told["sent"], told["heard"] = node.sent, len(heard)
    told["by_identifier"] = dict(collections.Counter(frame.id for frame in heard))
    told["counter_steps"] = sorted(
        {
            (later.data[6] - earlier.data[6]) % 256
            for frames in [[frame for frame in heard if frame.id == 256]]
            for earlier, later in itertools.pairwise(frames)
        }
    )
    told["stamps_grow"] = all(a.stamp_ns <= b.stamp_ns for a, b in itertools.pairwise(heard))
    told["latest_after_stamp_s"] = max(late_ns) / 1e9
    told["earliest_after_stamp_s"] = min(late_ns) / 1e9

    before = len(heard)
    with can.Bus(channel="vcan0", interface="socketcan") as flood:
        flood.socket.setblocking(True)
        for number in range(FLOOD):
            flood.send(can.Message(arbitration_id=number % 2048, is_extended_id=False))
    wait_until(lambda: len(heard) - before + listener.lost.total() >= FLOOD, f"all accounted for: {listener.lost}")
    time.sleep(1.0)
    told["flood"] = {"sent": FLOOD, "heard": len(heard) - before, "lost": dict(listener.lost)}

    ip("set", "vcan0", "down")
    wait_until(lambda: listener.statuses()[0].level == 2, "said to be gone")
    ip("set", "vcan0", "up")
    wait_until(lambda: listener.statuses()[0].level < 2, "found again")
    before = len(heard)
    with can.Bus(channel="vcan0", interface="socketcan") as sender:
        for number in range(10):
            sender.send(can.Message(arbitration_id=number, is_extended_id=False))
    wait_until(lambda: len(heard) == before + 10, "heard again")
    listener.stop()
    told["account"] = listener.account()
    out.write_text(json.dumps(told))


main(Path(sys.argv[1]))
