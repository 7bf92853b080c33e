"""Run inside an own network namespace: python-can's udp_multicast bus in two processes, one of them our listener.

Prints the identifiers of what was heard, as JSON.
"""

import json
import subprocess
import sys
import time

from capture.can_log import CanLink
from capture.clock import SystemClock
from capture.config import CanConfig
from capture.listener import Listener
from capture.record import CanFrame

GROUP = "239.74.163.2"
SENDER = f"""
import can
bus = can.Bus(channel="{GROUP}", interface="udp_multicast")
for number in range(200):
    bus.send(can.Message(arbitration_id=number, data=[number], is_extended_id=False))
bus.shutdown()
"""

for words in (("link", "set", "lo", "up", "multicast", "on"), ("route", "add", "239.0.0.0/8", "dev", "lo")):
    subprocess.run(["ip", *words], check=True)
config = CanConfig(name="bus", interface="udp_multicast", channel=GROUP)
listener = Listener("can.bus", lambda: CanLink(config, SystemClock()), SystemClock())
heard: list[int] = []
listener.start(lambda topic, time_ns, data: heard.append(CanFrame.decode(data).id))
deadline_s = time.monotonic() + 10.0
while listener.statuses()[0].level == 2 and time.monotonic() < deadline_s:
    time.sleep(0.02)
subprocess.run([sys.executable, "-c", SENDER], check=True)
while len(heard) < 200 and time.monotonic() < deadline_s:
    time.sleep(0.02)
listener.stop()
print(json.dumps(heard))
