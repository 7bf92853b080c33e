"""The kernel's USB tree (sysfs) to a description: what hangs where, at which speed, with which power and permission.

Read from files that everybody may read, so that a device that may not be opened is described all the same.
https://www.kernel.org/doc/Documentation/ABI/testing/sysfs-bus-usb
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path

SYSFS = Path("/sys")
DEV = Path("/dev")
_DEVICE = re.compile(r"\d+-\d+(\.\d+)*")  # bus-port.port…; root hubs are usbN, interfaces have a colon
_VISION_CONTROL = ("ef", "05", "00")  # class, subclass and protocol: USB3 Vision 1.0.1, table 3-2
_HUB_CLASS = "09"
_SELF_POWERED = 0x40  # in bmAttributes: USB 3.1, table 9-22


@dataclass(frozen=True)
class UsbDevice:
    """One device that is plugged in."""

    name: str  # the kernel's: bus, and ports from the root down, 2-1.3
    bus: int
    controller: str  # where the bus's controller is, such as PCI 0000:00:14.0
    speed_mbps: float  # as negotiated
    vendor_id: str  # four hex digits
    product_id: str
    model: str  # maker and product, as the device says
    serial: str
    power_ma: int  # that it may draw from the bus
    self_powered: bool
    hub: bool
    vision: bool  # a USB3 Vision camera
    node: Path  # what a program opens
    usable: bool  # this user may open it

    @property
    def port(self) -> str:
        """On its bus: 1.3 is the third port of the hub at the first."""
        return self.name.partition("-")[2]

    def as_dict(self) -> dict[str, object]:
        """For ``--json``."""
        return {**vars(self), "node": str(self.node), "port": self.port}


@dataclass(frozen=True)
class UsbTree:
    """All devices, and the memory that the kernel gives to programs that read from them."""

    devices: tuple[UsbDevice, ...] = ()
    memory_mb: int | None = None  # usbfs_memory_mb; 0: no limit; None: no USB in this kernel

    def camera(self, serial: str) -> UsbDevice | None:
        """The device with this serial number."""
        return next((device for device in self.devices if device.serial == serial and not device.hub), None)

    def hubs_above(self, device: UsbDevice) -> list[UsbDevice]:
        """The hubs between a device and its bus's root, outermost last."""
        return [hub for hub in self.devices if hub.hub and device.name.startswith(hub.name + ".")]


def read_usb(sysfs: Path = SYSFS, dev: Path = DEV) -> UsbTree:
    """What is plugged in now."""
    folder = sysfs / "bus/usb/devices"
    devices = []
    for place in sorted(folder.iterdir()) if folder.is_dir() else ():
        if _DEVICE.fullmatch(place.name):
            device = _read_device(place, dev)
            if device is not None:
                devices.append(device)
    memory = _text(sysfs / "module/usbcore/parameters/usbfs_memory_mb")
    return UsbTree(tuple(devices), int(memory) if memory.isdigit() else None)


def _read_device(place: Path, dev: Path) -> UsbDevice | None:
    """The device of a folder; None when it has just been unplugged."""
    try:
        bus, address = int(_text(place / "busnum")), int(_text(place / "devnum"))
        speed_mbps = float(_text(place / "speed"))
    except ValueError:
        return None
    node = dev / f"bus/usb/{bus:03d}/{address:03d}"
    power = re.match(r"\d+", _text(place / "bMaxPower"))
    words = (_text(place / "manufacturer"), _text(place / "product"))
    attributes = _text(place / "bmAttributes")
    return UsbDevice(
        name=place.name,
        bus=bus,
        controller=_controller(place, bus),
        speed_mbps=speed_mbps,
        vendor_id=_text(place / "idVendor"),
        product_id=_text(place / "idProduct"),
        model=" ".join(filter(None, words)),
        serial=_text(place / "serial"),
        power_ma=int(power.group()) if power else 0,
        self_powered=bool(int(attributes, 16) & _SELF_POWERED) if attributes else False,
        hub=_text(place / "bDeviceClass") == _HUB_CLASS,
        vision=any(_is_vision(interface) for interface in place.glob(f"{place.name}:*")),
        node=node,
        usable=os.access(node, os.R_OK | os.W_OK),
    )


def _controller(place: Path, bus: int) -> str:
    """The device that the bus's root hub belongs to: the folder above ``usbN``."""
    for parent in place.resolve().parents:
        if parent.name == f"usb{bus}":
            return parent.parent.name
    return "unknown"


def _is_vision(interface: Path) -> bool:
    parts = ("bInterfaceClass", "bInterfaceSubClass", "bInterfaceProtocol")
    return tuple(_text(interface / part) for part in parts) == _VISION_CONTROL


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
