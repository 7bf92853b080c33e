"""Guests that several tests look at: each is booted once, and its output kept."""

import json
from pathlib import Path

import pytest
from vm import START_UDEV, WINGCAP, WINGSIM, VmRun, run_in_vm

CAMERAS = (("left", "cam0"), ("left", "cam1"), ("right", "cam0"), ("right", "cam1"))
CAN_SENDER = """
import itertools, time
import can
with can.Bus(interface="socketcan", channel="vcan0") as bus:
    for number in itertools.count():
        bus.send(can.Message(arbitration_id=0x123, data=number.to_bytes(8, "little"), is_extended_id=False))
        time.sleep(0.02)
"""


@pytest.fixture(scope="session")
def usb_flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[VmRun, dict]:
    """A recording of four USB3 Vision cameras to which things happen; what the recorder said of it.

    At 4 Hz: first frames that all come more than a period late belong, for all the recorder knows, to the next trigger.
    """
    faults = ("1:truncate@8", "1:truncate@9", "3:lose@12", "0:unplug@16", "0:plug@24", "2:hold@30-35")
    cameras = "".join(
        f'[[cameras]]\nside = "{side}"\nname = "{name}"\nserial = "1749{number:04d}"\n'
        f'address = "Point Grey Research-0A1B{number:08X}-1749{number:04d}"\n'
        for number, (side, name) in enumerate(CAMERAS)
    )
    config = (
        'flight = "usb"\n[trigger]\nport = "trigger"\nrate_hz = 4\n'
        '[disks]\nleft = "left"\nright = "right"\nreserve_mb = 1\n'
        f'[camera]\nbackend = "aravis"\nwidth = 208\nheight = 156\nexposure_us = 2000\n{cameras}'
        '[[can]]\nname = "bus"\ninterface = "socketcan"\nchannel = "vcan0"\n'
    )
    rig = " ".join(f"--fault {fault}" for fault in faults)
    script = f"""{START_UDEV}
cat > wingcap.toml <<'END'
{config}
END
mkdir left right
{WINGSIM} usb-rig --trigger-port trigger --buffer-frames 4 --response-ms 3000 {rig} > rig 2>&1 & rig=$!
until grep -q ready rig; do kill -0 $rig; sleep 0.2; done
until [ $(cat /sys/bus/usb/devices/*/serial | grep -c ^1749) = 4 ]; do kill -0 $rig; sleep 0.2; done
udevadm settle
ip link add dev vcan0 type vcan; ip link set up vcan0
python - <<'END' & sender=$!
{CAN_SENDER}
END
{WINGCAP} record --config wingcap.toml --triggers 100 --json > /artifacts/record.json || echo record: $?
kill $sender; wait $sender || true
kill $rig; wait $rig || true
cp rig /artifacts/rig
cp -r left /artifacts/left; cp -r right /artifacts/right
"""
    run = run_in_vm(script, tmp_path_factory.mktemp("usb"), ["vhci-hcd", "vcan"], timeout_s=200)
    return run, json.loads((run.artifacts / "record.json").read_text())


@pytest.fixture(scope="session")
def usb_folders(usb_flight: tuple[VmRun, dict]) -> list[Path]:
    """The flight's folder on each disk."""
    return [usb_flight[0].artifacts / side / "usb" for side in ("left", "right")]
