"""Fifty who watch cost the recorder no frame; and without the extra the command says what to install."""

import http.client
import json
import subprocess
import sys
import threading
import time

import pytest

from capture.verify import inspect

CLIENTS, SECONDS = 50, 8.0
PLACES = ("left/cam0", "left/cam1", "right/cam0", "right/cam1")


class Client(threading.Thread):
    """Asks as a page does, from an address of its own."""

    def __init__(self, number: int, port: int, stop: threading.Event) -> None:
        super().__init__()
        self.answers: list[tuple[str, int, float]] = []
        self.error: Exception | None = None
        self._stop_asking = stop
        self._connection = http.client.HTTPConnection(
            "127.0.0.1", port, timeout=20, source_address=(f"127.0.1.{number + 1}", 0)
        )

    def run(self) -> None:
        try:
            while not self._stop_asking.wait(0.5):
                self._ask("/api/status")
                if len(self.answers) % 2:
                    continue
                for place in PLACES:
                    self._ask(f"/api/thumbnail/{place}")
        except Exception as error:
            self.error = error
        finally:
            self._connection.close()

    def _ask(self, path: str) -> None:
        begin_s = time.monotonic()
        self._connection.request("GET", path)
        answer = self._connection.getresponse()
        answer.read()
        self.answers.append((path, answer.status, time.monotonic() - begin_s))


@pytest.mark.slow
def test_fifty_clients_cost_the_recorder_no_frame(field):
    field.scale = 4
    field.start_rig()
    field.start_recorder()
    field.start_monitor()
    field.wait_for(lambda status: status["go"] and len(status["pictures"]) == 4)
    stop = threading.Event()
    clients = [Client(number, int(field.address.rsplit(":", 1)[1]), stop) for number in range(CLIENTS)]
    for client in clients:
        client.start()
    time.sleep(SECONDS)
    stop.set()
    for client in clients:
        client.join(30)
    result = field.recorded()
    assert result["frames_lost"] == 0
    assert result["frames_recorded"] == 4 * result["triggers"]
    assert result["triggers"] > 25 * SECONDS * 0.8
    assert inspect([field.folder / "ssd_left", field.folder / "ssd_right"]).problems == []
    assert [client.error for client in clients] == [None] * CLIENTS
    answers = [answer for client in clients for answer in client.answers]
    assert {status for _, status, _ in answers} == {200}
    waits_s = sorted(wait_s for _, _, wait_s in answers)
    print(f"{len(answers)} answers, median {1e3 * waits_s[len(waits_s) // 2]:.0f} ms, slowest {waits_s[-1]:.2f} s")
    print(json.dumps(result["ring_high_water"]))


def test_without_the_extra_the_command_says_what_to_install():
    code = (
        "import sys; sys.modules['starlette'] = None; sys.modules['uvicorn'] = None\n"
        "from process.cli import main; sys.argv = ['wingproc', 'monitor']; main()"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert answer.returncode == 1
    assert answer.stderr.count("\n") == 1
    assert "pip install 'wingshape[monitor]'" in answer.stderr
