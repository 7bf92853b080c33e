"""What is connected to this computer that a recording could use: cameras, USB, serial ports, CAN; the PTP state."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from serial.tools import list_ports

from capture.camera.discovery import FoundCamera, find_cameras
from capture.config import PtpConfig
from capture.errors import CaptureError
from capture.ptp import read_ptp
from capture.usb import SYSFS, UsbTree, read_usb

_ARPHRD_CAN = "280"  # linux/if_arp.h


@dataclass(frozen=True)
class CanInterface:
    """A CAN network interface."""

    name: str
    state: str  # up, down, unknown (vcan)
    received: int  # frames since it was made


@dataclass(frozen=True)
class SerialPort:
    """A serial port with a device behind it."""

    path: str
    description: str
    serial: str


@dataclass(frozen=True)
class Devices:
    """Everything that was found, and why some of it could not be looked for."""

    cameras: tuple[FoundCamera, ...]
    usb: UsbTree
    serial_ports: tuple[SerialPort, ...]
    can: tuple[CanInterface, ...]
    ptp: str
    problems: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "cameras": [vars(camera) for camera in self.cameras],
            "usb": [device.as_dict() for device in self.usb.devices],
            "usbfs_memory_mb": self.usb.memory_mb,
            "serial_ports": [vars(port) for port in self.serial_ports],
            "can": [vars(interface) for interface in self.can],
            "ptp": self.ptp,
            "problems": list(self.problems),
        }


def find_devices(
    ptp: PtpConfig,
    sysfs: Path = SYSFS,
    cameras: Callable[[], tuple[list[FoundCamera], list[str]]] = find_cameras,
) -> Devices:
    """Look everywhere. What cannot be looked at stands in ``problems``."""
    found, problems = cameras()
    return Devices(
        tuple(found), read_usb(sysfs), _serial_ports(), _can_interfaces(sysfs / "class/net"), _ptp(ptp), tuple(problems)
    )


def _serial_ports() -> tuple[SerialPort, ...]:
    ports = [
        SerialPort(port.device, port.description or "", port.serial_number or "") for port in list_ports.comports()
    ]
    by_id = {str(link.resolve()): str(link) for link in Path("/dev/serial/by-id").glob("*")}  # survives replugging
    return tuple(
        SerialPort(by_id.get(port.path, port.path), port.description, port.serial)
        for port in sorted(ports, key=lambda port: port.path)
    )


def _can_interfaces(folder: Path) -> tuple[CanInterface, ...]:
    interfaces = []
    for place in sorted(folder.iterdir()) if folder.is_dir() else ():
        try:
            if (place / "type").read_text().strip() == _ARPHRD_CAN:
                state = (place / "operstate").read_text().strip()
                received = int((place / "statistics/rx_packets").read_text())
                interfaces.append(CanInterface(place.name, state, received))
        except (OSError, ValueError):
            continue  # it has just gone
    return tuple(interfaces)


def _ptp(config: PtpConfig) -> str:
    try:
        status = read_ptp(config)
    except CaptureError as error:
        return f"unknown ({error})"
    return f"{status.port_state.name}, offset {status.offset_ns / 1e3:.1f} us"
