"""A real kernel's CAN bus (vcan) heard to the last frame; its USB cameras as `devices` and `preflight` see them."""

import json
from pathlib import Path

import pytest
from vm import CHECKOUT, START_UDEV, WINGCAP, WINGSIM, run_in_vm

pytestmark = pytest.mark.slow
PLACES = (("left", "cam0"), ("left", "cam1"))
CAMERAS = "".join(
    f'[[cameras]]\nside = "{side}"\nname = "{name}"\nserial = "1749{number:04d}"\n'
    f'address = "Point Grey Research-0A1B{number:08X}-1749{number:04d}"\n'
    for number, (side, name) in enumerate(PLACES)
)
CONFIG = f"""
[trigger]
port = "trigger"
rate_hz = 4
[ptp]
role = "none"
[disks]
left = "left"
right = "right"
reserve_mb = 1
[camera]
backend = "aravis"
width = 208
height = 156
{CAMERAS}
"""


@pytest.fixture(scope="module")
def guest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What both parts left behind. Preflight meets the kernel's own 16 MB of usbfs memory, and a swapped camera."""
    script = f"""
python {CHECKOUT}/tests/support/socketcan_bus.py /artifacts/can.json
{START_UDEV}
cat > wingcap.toml <<'END'
{CONFIG}
END
mkdir left right
{WINGSIM} usb-rig --cameras 2 --trigger-port trigger --response-ms 3000 > rig 2>&1 & rig=$!
until grep -q ready rig; do kill -0 $rig; sleep 0.2; done
until [ $(cat /sys/bus/usb/devices/*/serial | grep -c ^1749) = 2 ]; do kill -0 $rig; sleep 0.2; done
udevadm settle
ip link set vcan0 up
{WINGCAP} devices --json > /artifacts/devices.json
echo 16 > /sys/module/usbcore/parameters/usbfs_memory_mb
sed -i 's/serial = "17490001"/serial = "17499999"/' wingcap.toml
{WINGCAP} preflight --config wingcap.toml --json > /artifacts/preflight.json || echo refused
kill $rig; wait $rig || true
"""
    return run_in_vm(
        script, tmp_path_factory.mktemp("can_and_usb"), ["can-raw", "vcan", "vhci-hcd"], timeout_s=220
    ).artifacts


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def findings(path: Path) -> dict[str, dict]:
    return {finding["name"]: finding for finding in read(path)["findings"]}


def test_every_frame_of_the_aircraft_is_heard_in_order(guest):
    told = read(guest / "can.json")
    assert told["heard"] == told["sent"] >= 300
    assert set(told["by_identifier"]) == {"256", "257", "258"}
    assert told["counter_steps"] == [1]
    assert told["stamps_grow"]


def test_stamps_are_the_kernels_in_utc(guest):
    """None is from the future, and a slow guest reads none of them a second late (then ours would be taken)."""
    told = read(guest / "can.json")
    assert 0 <= told["earliest_after_stamp_s"] < told["latest_after_stamp_s"] < 1.0


def test_a_flood_is_heard_or_counted_as_lost(guest):
    flood = read(guest / "can.json")["flood"]
    assert flood["heard"] + sum(flood["lost"].values()) == flood["sent"]
    assert set(flood["lost"]) <= {"socket full"}


def test_a_bus_taken_down_is_an_outage_and_comes_back(guest):
    account = read(guest / "can.json")["account"]
    assert account["can.bus.outages_in_all"] == "2"  # before it was made, and while it was down
    assert all(begin_ns < end_ns for begin_ns, end_ns in json.loads(account["can.bus.outages"]))


def test_devices_are_described_as_the_kernel_has_them(guest):
    told = read(guest / "devices.json")
    cameras = {device["serial"]: device for device in told["usb"] if device["vision"]}
    assert set(cameras) == {"17490000", "17490001"}
    assert all(device["speed_mbps"] >= 5000 and device["usable"] for device in cameras.values())
    assert all(device["controller"].startswith("vhci_hcd") for device in cameras.values())
    assert {camera["serial"] for camera in told["cameras"] if camera["link"] == "USB3Vision"} == set(cameras)
    assert [interface["name"] for interface in told["can"]] == ["vcan0"]
    assert told["usbfs_memory_mb"] == 1000


def test_preflight_refuses_16_mb_and_a_swapped_serial(guest):
    found = findings(guest / "preflight.json")
    assert not read(guest / "preflight.json")["go"]
    assert not found["usb memory"]["ok"]
    assert "usbfs_memory_mb is 16, 2 cameras keep 17 MB in flight" in found["usb memory"]["found"]
    assert not found["usb left/cam1"]["ok"]
    assert "serial 17499999 is not plugged in" in found["usb left/cam1"]["found"]
    assert not found["camera left/cam1"]["ok"]
    assert "serial 17490001 answers" in found["camera left/cam1"]["found"]
    assert found["usb left/cam0"]["ok"]
    assert found["camera left/cam0"]["ok"]
    assert found["usb bandwidth vhci_hcd.0"]["ok"]
