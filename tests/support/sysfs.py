"""A USB tree as files, laid out as the kernel does, for the tests of what reads it."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class FakeSysfs:
    """Controllers, hubs and devices under ``root``; device nodes under ``root/dev``."""

    root: Path
    memory_mb: int = 1000
    _buses: dict[str, int] = field(default_factory=dict)
    _addresses: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.write("sys/module/usbcore/parameters/usbfs_memory_mb", self.memory_mb)
        (self.root / "sys/bus/usb/devices").mkdir(parents=True)

    @property
    def sys(self) -> Path:
        return self.root / "sys"

    @property
    def dev(self) -> Path:
        return self.root / "dev"

    def write(self, path: str, text: object) -> None:
        place = self.root / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(f"{text}\n")

    def controller(self, pci: str) -> int:
        """A controller with one bus; the bus's number."""
        bus = len(self._buses) + 1
        self._buses[pci] = bus
        self._device(f"usb{bus}", f"sys/devices/pci0000:00/{pci}/usb{bus}", bus, 10000, "09", "", "xHCI", 0, "e0")
        return bus

    def hub(self, bus: int, port: str, attributes: str = "e0", power_ma: int = 0) -> None:
        self._plug(bus, port, 5000, "09", "", "hub", power_ma, attributes)

    def camera(self, bus: int, port: str, serial: str, speed: float = 5000, power_ma: int = 600) -> str:
        """A Flea3; its device node."""
        place = self._plug(bus, port, speed, "ef", serial, "Flea3 FL3-U3-32S2M", power_ma, "80")
        for part, value in (("bInterfaceClass", "ef"), ("bInterfaceSubClass", "05"), ("bInterfaceProtocol", "00")):
            self.write(f"{place}/{bus}-{port}:1.0/{part}", value)
        return f"dev/bus/usb/{bus:03d}/{self._addresses[bus]:03d}"

    def _plug(
        self, bus: int, port: str, speed: float, device_class: str, serial: str, product: str, power: int, bits: str
    ) -> str:
        pci = next(name for name, number in self._buses.items() if number == bus)
        parents = [f"{bus}-{'.'.join(port.split('.')[: k + 1])}" for k in range(port.count(".") + 1)]
        place = f"sys/devices/pci0000:00/{pci}/usb{bus}/{'/'.join(parents)}"
        self._device(f"{bus}-{port}", place, bus, speed, device_class, serial, product, power, bits)
        return place

    def _device(
        self, name: str, place: str, bus: int, speed: float, kind: str, serial: str, product: str, power: int, bits: str
    ) -> None:
        self._addresses[bus] = self._addresses.get(bus, 0) + 1
        values = {
            "busnum": bus,
            "devnum": self._addresses[bus],
            "speed": f"{speed:g}",
            "idVendor": "1e10",
            "idProduct": "3300",
            "manufacturer": "Point Grey Research",
            "product": product,
            "bMaxPower": f"{power}mA",
            "bmAttributes": bits,
            "bDeviceClass": kind,
            **({"serial": serial} if serial else {}),
        }
        for key, value in values.items():
            self.write(f"{place}/{key}", value)
        node = self.root / f"dev/bus/usb/{bus:03d}/{self._addresses[bus]:03d}"
        node.parent.mkdir(parents=True, exist_ok=True)
        node.touch()
        (self.root / "sys/bus/usb/devices" / name).symlink_to(self.root / place)
