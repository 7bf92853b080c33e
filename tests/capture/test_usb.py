"""What preflight says of cameras on USB: on a tree of files as the kernel lays it out, in order and with each fault."""

import dataclasses
import json
import os
from pathlib import Path

import pytest
from sysfs import FakeSysfs

import capture.camera_checks
from capture.camera.base import Camera, CameraDescription
from capture.camera_checks import check_calibration, check_cameras, check_usb
from capture.clock import SystemClock
from capture.config import Config, PtpConfig
from capture.devices import find_devices
from capture.errors import CameraError
from capture.finding import Finding, Situation
from capture.usb import read_usb
from capture.usb_checks import Asked, WantedCamera, usb_findings

PLACES = ("left/cam0", "left/cam1", "right/cam0", "right/cam1")
SERIALS = ("17491231", "17491232", "17491233", "17491234")
WANTED = [WantedCamera(place, serial) for place, serial in zip(PLACES, SERIALS, strict=True)]
FULL = Asked(2080, 1552, 25.0)  # 323 MB/s of four


@pytest.fixture
def tree(tmp_path: Path) -> FakeSysfs:
    return FakeSysfs(tmp_path)


def plug_all(tree: FakeSysfs, **changes: float) -> None:
    """Four cameras on one controller, each at its own port."""
    bus = tree.controller("0000:00:14.0")
    for port, serial in enumerate(SERIALS, start=1):
        tree.camera(bus, str(port), serial, **(changes if port == 1 else {}))  # type: ignore[arg-type]


def findings(tree: FakeSysfs, asked: Asked = FULL) -> list[Finding]:
    return usb_findings(read_usb(tree.sys, tree.dev), WANTED, asked)


def refused(found: list[Finding]) -> list[Finding]:
    bad = [finding for finding in found if not finding.ok]
    assert all(finding.remedy for finding in bad)
    assert not any(finding.remedy for finding in found if finding.ok)
    return bad


def test_the_tree_is_read_as_the_kernel_writes_it(tree):
    first, second = tree.controller("0000:00:14.0"), tree.controller("0000:03:00.0")
    tree.hub(first, "1", power_ma=100)
    tree.camera(first, "1.3", "17491231")
    tree.camera(second, "2", "17491232", speed=480, power_ma=500)
    devices = {device.name: device for device in read_usb(tree.sys, tree.dev).devices}
    assert set(devices) == {"1-1", "1-1.3", "2-2"}
    camera = devices["1-1.3"]
    assert (camera.controller, camera.bus, camera.port, camera.speed_mbps) == ("0000:00:14.0", 1, "1.3", 5000)
    assert (camera.vision, camera.hub, camera.serial, camera.power_ma) == (True, False, "17491231", 600)
    assert camera.model == "Point Grey Research Flea3 FL3-U3-32S2M"
    assert camera.usable
    assert devices["1-1"].hub
    assert (devices["2-2"].controller, devices["2-2"].speed_mbps) == ("0000:03:00.0", 480)
    assert read_usb(tree.sys, tree.dev).hubs_above(camera) == [devices["1-1"]]


def test_four_cameras_in_order_are_go(tree):
    plug_all(tree)
    found = findings(tree)
    assert refused(found) == []
    assert [finding.name for finding in found] == [
        *(f"usb {place}" for place in PLACES), "usb memory", "usb bandwidth 0000:00:14.0",
    ]  # fmt: skip
    assert "bus 1 port 1, controller 0000:00:14.0, 5000 Mbit/s, 600 mA" in found[0].found
    assert "323 MB/s" in found[-1].found


def test_the_kernels_16_mb_are_refused_with_the_number_to_set(tree):
    plug_all(tree)
    tree.write("sys/module/usbcore/parameters/usbfs_memory_mb", 16)
    (bad,) = refused(findings(tree))
    assert bad.name == "usb memory"
    assert "usbfs_memory_mb is 16" in bad.found
    assert "4 cameras keep 34 MB in flight (8 MiB each)" in bad.found
    assert "echo 1000 > /sys/module/usbcore/parameters/usbfs_memory_mb" in bad.remedy
    assert "usbcore.usbfs_memory_mb=1000" in bad.remedy
    assert bad.numbers["in_flight_mb"] == 34


@pytest.mark.parametrize(("limit", "ok"), [(0, True), (16, False), (32, False), (36, True), (1000, True)])
def test_the_memory_limit(tree, limit, ok):
    """What Aravis keeps in flight, 4 × 8 MiB, and a tenth for what the kernel rounds up; 0 is no limit."""
    plug_all(tree)
    tree.write("sys/module/usbcore/parameters/usbfs_memory_mb", limit)
    assert (refused(findings(tree)) == []) == ok


def test_a_usb_2_cable_is_refused_with_the_speed_it_has(tree):
    plug_all(tree, speed=480)
    (bad,) = refused(findings(tree))
    assert bad.name == "usb left/cam0"
    assert "480 Mbit/s" in bad.found
    assert "5000 Mbit/s are needed" in bad.found
    assert "USB 3 cable" in bad.remedy


def test_a_swapped_serial_is_refused_with_what_is_there_instead(tree):
    bus = tree.controller("0000:00:14.0")
    for port, serial in enumerate((*SERIALS[:3], "99999999"), start=1):
        tree.camera(bus, str(port), serial)
    (bad,) = refused(findings(tree))
    assert bad.name == "usb right/cam1"
    assert "serial 17491234 is not plugged in" in bad.found
    assert "99999999" in bad.found
    assert "calibrate anew" in bad.remedy


def test_a_controller_that_is_asked_too_much_is_refused_with_how_many_are_needed(tree):
    plug_all(tree)
    (bad,) = refused(findings(tree, Asked(2080, 1552, 60.0)))
    assert "775 MB/s" in bad.found
    assert "about 450" in bad.found
    assert "2 controllers" in bad.remedy
    assert "34.8" in bad.remedy  # 450 MB/s over four frames of 3.228 MB


def test_two_controllers_carry_it(tree):
    for number, pci in enumerate(("0000:00:14.0", "0000:03:00.0")):
        bus = tree.controller(pci)
        for port in (1, 2):
            tree.camera(bus, str(port), SERIALS[2 * number + port - 1])
    found = findings(tree, Asked(2080, 1552, 60.0))
    assert refused(found) == []
    assert [finding.numbers["mb_s"] for finding in found if "bandwidth" in finding.name] == pytest.approx(
        [387.4] * 2, abs=0.1
    )


def test_a_device_node_that_may_not_be_opened_names_the_udev_rule(tree, monkeypatch):
    plug_all(tree)
    real = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: not str(path).endswith("001/002") and real(path, mode))
    (bad,) = refused(findings(tree))
    assert bad.name == "usb permission left/cam0"
    assert "bus/usb/001/002" in bad.found
    assert "70-wingshape.rules" in bad.remedy
    assert "plugdev" in bad.remedy


@pytest.mark.parametrize(("attributes", "ok"), [("a0", False), ("e0", True)])
def test_a_hub_without_its_own_supply_cannot_feed_two_cameras(tree, attributes, ok):
    bus = tree.controller("0000:00:14.0")
    tree.hub(bus, "1", attributes=attributes, power_ma=100)
    tree.camera(bus, "1.1", SERIALS[0])
    tree.camera(bus, "1.2", SERIALS[1])
    tree.camera(bus, "2", SERIALS[2])
    tree.camera(bus, "3", SERIALS[3])
    bad = refused(findings(tree))
    assert (bad == []) == ok
    if bad:
        assert "1300 mA of 900 mA" in bad[0].found


def test_no_usb_in_the_kernel_is_not_taken_for_go(tmp_path):
    tree = read_usb(tmp_path / "sys")
    assert (tree.devices, tree.memory_mb) == ((), None)
    assert all(not finding.ok for finding in usb_findings(tree, WANTED, FULL))


def make_config(tmp_path: Path, backend: str = "fake", **camera: object) -> Config:
    return Config.model_validate(
        {
            "trigger": {"port": "/dev/null"},
            "disks": {"left": tmp_path / "a", "right": tmp_path / "b"},
            "camera": {"backend": backend, "width": 64, "height": 48, **camera},
            "cameras": [
                {"side": place[:-5], "name": place[-4:], "address": f"FLIR-{serial}", "serial": serial}
                for place, serial in zip(PLACES, SERIALS, strict=True)
            ],
        }
    )


def test_addresses_and_serials_lead_to_the_devices(tree, tmp_path, monkeypatch):
    plug_all(tree)
    config = make_config(tmp_path, backend="aravis")
    usb = read_usb(tree.sys, tree.dev)
    without = [place.model_copy(update={"serial": None}) for place in config.cameras]
    for cameras in (config.cameras, without):
        found = check_usb(Situation(config.model_copy(update={"cameras": cameras}), SystemClock()), usb)
        assert len(found) == 6
        assert refused(found) == []
    by_network = [place.model_copy(update={"address": "192.168.1.5"}) for place in config.cameras]
    (none,) = check_usb(Situation(config.model_copy(update={"cameras": by_network}), SystemClock()), usb)
    assert none.ok
    assert "nothing to check" in none.found


class StubCamera(Camera):
    """Answers as it is told to."""

    description: CameraDescription | CameraError
    closed = 0

    def open(self) -> CameraDescription:
        if isinstance(self.description, CameraError):
            raise self.description
        return dataclasses.replace(self.description, serial=self.address.removeprefix("FLIR-"))

    def temperature_c(self) -> float | None:
        return 41.0

    def queue(self, slot: int, buffer: memoryview) -> None:
        pass

    def arm(self) -> None:
        pass

    def grab(self, timeout_s: float) -> None:
        pass

    def disarm(self) -> None:
        pass

    def close(self) -> None:
        type(self).closed += 1


DESCRIPTION = CameraDescription(
    "Flea3", "", 2080, 1552, 2000, 0.0, 10_700, 1e9, 64, True, firmware="2.14.3.0", features=(("PixelFormat", "Mono8"),)
)


def opened(tmp_path: Path, monkeypatch, description: CameraDescription | CameraError, config: Config) -> list[Finding]:
    monkeypatch.setattr(StubCamera, "description", description, raising=False)
    monkeypatch.setattr(
        capture.camera_checks, "camera_at", lambda config, place: StubCamera(place.address, config.settings)
    )
    before = StubCamera.closed
    found = check_cameras(Situation(config, SystemClock()))
    assert StubCamera.closed - before == 4
    return found


@pytest.fixture
def fake_backend(rig):
    """Makes the name `fake` known."""


def test_cameras_in_order_are_named_with_firmware_and_temperature(tmp_path, monkeypatch, fake_backend):
    found = opened(tmp_path, monkeypatch, DESCRIPTION, make_config(tmp_path))
    assert refused(found) == []
    assert found[0].found == "Flea3, serial 17491231, firmware 2.14.3.0, 41 °C, 2080×1552, 2000 us, 0 dB"
    assert found[1].found.startswith("exposure 2.0 ms and read-out 16.6 ms: at most 53.7 triggers a second")


def test_a_wrong_pixel_format_is_refused_with_the_format_and_the_remedy(tmp_path, monkeypatch, fake_backend):
    """The backend's words when the camera did not take the format (the contract suite has it refuse)."""
    words = "FLIR-1: PixelFormat Mono8 was asked, the camera has BayerRG8: this camera gives no 8 bit grey images"
    bad = refused(opened(tmp_path, monkeypatch, CameraError(words), make_config(tmp_path)))
    assert len(bad) == 4
    assert bad[0].name == "camera left/cam0"
    assert "the camera has BayerRG8" in bad[0].found
    assert "8 bit grey" in bad[0].remedy


def test_a_camera_that_was_swapped_is_refused_with_both_serials(tmp_path, monkeypatch, fake_backend):
    config = make_config(tmp_path)
    cameras = [place.model_copy(update={"address": "FLIR-99999999"}) for place in config.cameras]
    bad = refused(opened(tmp_path, monkeypatch, DESCRIPTION, config.model_copy(update={"cameras": cameras})))
    assert "serial 99999999 answers at FLIR-99999999, not 17491231" in bad[0].found
    assert "swap the cables" in bad[0].remedy


def test_a_rate_beyond_exposure_and_read_out_is_refused_with_the_highest(tmp_path, monkeypatch, fake_backend):
    config = make_config(tmp_path)
    config = config.model_copy(update={"trigger": config.trigger.model_copy(update={"rate_hz": 60.0})})
    bad = refused(opened(tmp_path, monkeypatch, DESCRIPTION, config))
    assert "53.7 triggers a second, 60 are asked" in bad[0].found
    assert "`trigger.rate_hz` to 53.7" in bad[0].remedy


def test_a_calibration_of_other_cameras_is_refused(tmp_path, fake_backend):
    path = tmp_path / "rig.json"
    sides = {
        side: {"cam0_serial": SERIALS[2 * k], "cam1_serial": SERIALS[2 * k + 1], "row_time_ns": 10_700.0}
        for k, side in enumerate(("left", "right"))
    }
    path.write_text(json.dumps({"format": "wingshape rig", **sides}))
    config = make_config(tmp_path, row_time_us=10.7).model_copy(update={"calibration": path})
    assert refused(check_calibration(Situation(config, SystemClock()))) == []
    exchanged = [*config.cameras[1::-1], *config.cameras[2:]]
    cameras = [
        place.model_copy(update={"serial": other.serial})
        for place, other in zip(config.cameras, exchanged, strict=True)
    ]
    (bad,) = refused(check_calibration(Situation(config.model_copy(update={"cameras": cameras}), SystemClock())))
    assert "left/cam0 is 17491232, was calibrated as 17491231" in bad.found
    slow = config.model_copy(update={"camera": config.camera.model_copy(update={"row_time_us": 20.0})})
    (bad,) = refused(check_calibration(Situation(slow, SystemClock())))
    assert "row_time_us is 20, the left side was calibrated with 10.7" in bad.found
    for text in ("{}", "nonsense"):
        path.write_text(text)
        assert "not a rig file" in refused(check_calibration(Situation(config, SystemClock())))[0].found


def test_devices_lists_what_is_there(tree, tmp_path):
    plug_all(tree)
    for name, kind in (("can0", 280), ("eth0", 1)):
        tree.write(f"sys/class/net/{name}/type", kind)
        tree.write(f"sys/class/net/{name}/operstate", "up")
        tree.write(f"sys/class/net/{name}/statistics/rx_packets", 17)
    found = find_devices(PtpConfig(socket=tmp_path / "no ptp4l"), tree.sys, lambda: ([], ["aravis: not installed"]))
    told = json.loads(json.dumps(found.as_dict()))
    assert [device["serial"] for device in told["usb"]] == list(SERIALS)
    assert told["can"] == [{"name": "can0", "state": "up", "received": 17}]
    assert told["usbfs_memory_mb"] == 1000
    assert told["ptp"].startswith("unknown")
    assert told["problems"] == ["aravis: not installed"]


def test_the_command_works_on_any_machine(wingcap):
    done = wingcap("devices", "--json")
    assert done.returncode == 0, done.stderr
    assert set(json.loads(done.stdout)) == {
        "cameras", "usb", "usbfs_memory_mb", "serial_ports", "can", "ptp", "problems",
    }  # fmt: skip
    assert wingcap("devices").returncode == 0
