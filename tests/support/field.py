"""A field on one computer: the simulated rig, the recorder and the monitor, each a process of its own."""

import base64
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hw_sim.hand import do
from hw_sim.world import World

START_S = 30.0


def command(package: str, *words: object) -> list[str]:
    """A command line of ours that works from a checkout."""
    return [sys.executable, "-c", f"from {package}.cli import main; main()", *map(str, words)]


@dataclass
class Field:
    """Processes by name. Everything is in ``folder``."""

    folder: Path
    scale: int = 8
    rate_hz: float = 25.0
    background: str = "dark"
    extra: str = ""  # more tables of the recorder's configuration
    processes: dict[str, subprocess.Popen[str]] = field(default_factory=dict)
    address: str = ""

    @property
    def health(self) -> Path:
        """The recorder's health folder."""
        return self.folder / "health"

    def start_rig(self) -> None:
        """The hardware."""
        world = World.make(seed=4, scale=self.scale, background=self.background)
        world.write(self.folder / "world.toml")
        words = ["--world", "world.toml", "--socket", "rig.sock", "--trigger-port", "trigger"]
        process = self._start("rig", command("hw_sim", "rig", *words), stdout=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        for side in ("left", "right"):
            (self.folder / f"ssd_{side}").mkdir(exist_ok=True)
        cameras = "".join(
            f'[[cameras]]\nside = "{side}"\nname = "{name}"\naddress = "rig.sock#{side}_{name}"\n'
            for side in ("left", "right")
            for name in ("cam0", "cam1")
        )
        (self.folder / "wingcap.toml").write_text(
            f'flight = "test_07"\n[trigger]\nport = "trigger"\nrate_hz = {self.rate_hz}\n'
            '[disks]\nleft = "ssd_left"\nright = "ssd_right"\nreserve_mb = 1\n[health]\nfolder = "health"\n'
            f'[camera]\nbackend = "simulated"\nwidth = {world.sensor.width_px}\nheight = {world.sensor.height_px}\n'
            f"{self.extra}\n{cameras}"
        )

    def start_recorder(self, *words: object) -> None:
        """``wingcap record``."""
        self._start("recorder", command("capture", "record", "--config", "wingcap.toml", "--json", *words))

    def start_monitor(self, *words: object, health: Path | None = None) -> None:
        """``wingproc monitor`` on a port that is free; ``address`` then names it."""
        line = command("process", "monitor", "--health", health or self.health, "--port", 0, *words)
        self._start("monitor", line)
        deadline_s = time.monotonic() + START_S
        while time.monotonic() < deadline_s:
            found = re.search(r"monitor: (https?)://(\S+?):(\d+)/", self.said("monitor"))
            if found:
                self.address = f"{found[1]}://127.0.0.1:{found[3]}"
                return
            assert self.processes["monitor"].poll() is None, self.said("monitor")
            time.sleep(0.05)
        raise AssertionError(f"no monitor after {START_S} s: {self.said('monitor')}")

    def said(self, name: str) -> str:
        """What a process has written to standard error."""
        return (self.folder / f"{name}.err").read_text()

    def hand(self, deed: str, camera: str) -> None:
        """``unplug`` or ``plug`` a camera."""
        do(self.folder / "rig.sock", deed, camera)

    def get(
        self, path: str, token: str | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, Any, bytes]:
        """Status, headers and body of a GET."""
        request = urllib.request.Request(self.address + path, headers=dict(headers or {}))
        if token is not None:
            request.add_header("authorization", f"Bearer {token}")
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return answer.status, answer.headers, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.headers, error.read()

    def status(self, token: str | None = None) -> dict[str, Any]:
        """What the page is told."""
        code, _, body = self.get("/api/status", token)
        assert code == 200, body
        found: dict[str, Any] = json.loads(body)
        return found

    def wait_for(self, condition: Callable[[dict[str, Any]], bool], seconds: float = START_S) -> dict[str, Any]:
        """The status once it is so."""
        deadline_s = time.monotonic() + seconds
        while True:
            status = self.status()
            if condition(status):
                return status
            assert time.monotonic() < deadline_s, f"not within {seconds} s: {status}"
            time.sleep(0.05)

    def end(self, name: str, seconds: float = 20.0) -> int:
        """SIGTERM, and wait."""
        process = self.processes.pop(name)
        process.send_signal(signal.SIGTERM)
        code = process.wait(seconds)
        if process.stdout is not None:
            process.stdout.close()
        return code

    def recorded(self) -> dict[str, Any]:
        """End the recorder; its result."""
        self.end("recorder")
        found: dict[str, Any] = json.loads((self.folder / "recorder.out").read_text())
        return found

    def _start(self, name: str, line: list[str], stdout: int | None = None) -> subprocess.Popen[str]:
        with (self.folder / f"{name}.err").open("w") as err, (self.folder / f"{name}.out").open("w") as out:
            process = subprocess.Popen(
                line, cwd=self.folder, stdout=stdout or out, stderr=err, text=True, env={**os.environ, "COLUMNS": "200"}
            )
        self.processes[name] = process
        return process


@contextlib.contextmanager
def field_in(folder: Path, **options: Any) -> Iterator[Field]:
    """A field whose processes end with it."""
    made = Field(folder, **options)
    try:
        yield made
    finally:
        for process in made.processes.values():
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def basic(token: str) -> dict[str, str]:
    """As a browser sends a password."""
    return {"authorization": "Basic " + base64.b64encode(f"any:{token}".encode()).decode()}
