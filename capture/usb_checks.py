"""A USB tree and what is asked of it to findings: links, power, permissions, memory, bandwidth, with their numbers."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from capture.finding import Finding
from capture.usb import UsbDevice, UsbTree

SUPER_SPEED_MBPS = 5000.0
CONTROLLER_MB_S = 450.0  # what one 5 Gbit/s controller carries of image data; its ports share it
BUS_POWER_MA = 900  # of a USB 3 port: USB 3.1, table 11-2
IN_FLIGHT_MIB = 8
"""What Aravis keeps submitted to the kernel for each camera (arvuvstream.c: ARV_UV_STREAM_MAXIMUM_SUBMIT_TOTAL)"""
USBFS_MB = 1000  # what cameras' makers ask for, and systemd/wingshape.modprobe sets: far from any limit
_NOW = "/sys/module/usbcore/parameters/usbfs_memory_mb"
_ALWAYS = "usbcore.usbfs_memory_mb"


@dataclass(frozen=True)
class WantedCamera:
    """A camera that the configuration names."""

    place: str  # left/cam0
    serial: str


@dataclass(frozen=True)
class Asked:
    """What all cameras together shall do."""

    width: int
    height: int
    rate_hz: float

    @property
    def camera_mb_s(self) -> float:
        """Of one camera."""
        return self.width * self.height * self.rate_hz / 1e6


def usb_findings(tree: UsbTree, cameras: Sequence[WantedCamera], asked: Asked) -> list[Finding]:
    """For each camera its link and permission; for all of them power, memory and bandwidth."""
    findings: list[Finding] = []
    there: dict[str, UsbDevice] = {}
    for camera in cameras:
        device = tree.camera(camera.serial)
        if device is None:
            findings.append(_missing(tree, camera))
            continue
        there[camera.place] = device
        findings += [_link(camera, device), *_permission(camera, device)]
    if there:
        findings += [*_power(tree, there), _memory(tree, len(cameras)), *_bandwidth(there, asked)]
    return findings


def _missing(tree: UsbTree, camera: WantedCamera) -> Finding:
    others = [f"{device.serial} ({device.model})" for device in tree.devices if device.vision]
    seen = f"cameras there: {', '.join(others)}" if others else "there is no USB3 Vision camera"
    found = f"serial {camera.serial} is not plugged in; {seen}"
    remedy = "plug it in and give it power, or correct `serial` if a camera was exchanged (then calibrate anew)"
    return Finding(f"usb {camera.place}", False, found, remedy, {"serial": camera.serial})


def _link(camera: WantedCamera, device: UsbDevice) -> Finding:
    where = f"{device.model} {device.serial} at bus {device.bus} port {device.port}, controller {device.controller}"
    found = f"{where}, {device.speed_mbps:g} Mbit/s, {device.power_ma} mA"
    if device.speed_mbps >= SUPER_SPEED_MBPS:
        return Finding(f"usb {camera.place}", True, found, numbers=device.as_dict())
    found += f": a USB {'2' if device.speed_mbps > 12 else '1'} link, {SUPER_SPEED_MBPS:g} Mbit/s are needed"
    remedy = "use a USB 3 cable (nine wires) and a USB 3 port, push the plugs home, and look at the connector's pins"
    return Finding(f"usb {camera.place}", False, found, remedy, device.as_dict())


def _permission(camera: WantedCamera, device: UsbDevice) -> list[Finding]:
    if device.usable:
        return []
    found = f"{device.node} may not be opened by this user"
    remedy = (
        "install systemd/70-wingshape.rules in /etc/udev/rules.d, `udevadm control --reload; udevadm trigger`, and add "
        "the user to the group plugdev"
    )
    return [Finding(f"usb permission {camera.place}", False, found, remedy, {"node": str(device.node)})]


def _power(tree: UsbTree, there: dict[str, UsbDevice]) -> list[Finding]:
    """Hubs that live on one port's power and hand it on."""
    fed: defaultdict[str, list[UsbDevice]] = defaultdict(list)
    hubs = {hub.name: hub for hub in tree.devices if hub.hub}
    for device in there.values():
        for hub in tree.hubs_above(device):
            if not hub.self_powered and not device.self_powered:
                fed[hub.name].append(device)
    findings = []
    for name, devices in sorted(fed.items()):
        need_ma = hubs[name].power_ma + sum(device.power_ma for device in devices)
        found = f"hub {name} has no supply of its own; it and {len(devices)} cameras may draw {need_ma} mA"
        numbers = {"hub": name, "need_ma": need_ma, "limit_ma": BUS_POWER_MA}
        ok = need_ma <= BUS_POWER_MA
        remedy = "" if ok else "give the hub its own supply, or the cameras ports of their own"
        findings.append(Finding("usb power", ok, f"{found} of {BUS_POWER_MA} mA", remedy, numbers))
    return findings


def _memory(tree: UsbTree, cameras: int) -> Finding:
    need_mb = -(-cameras * IN_FLIGHT_MIB * 2**20 // 10**6)
    limit = tree.memory_mb
    numbers = {"usbfs_memory_mb": limit, "in_flight_mb": need_mb, "cameras": cameras}
    asked = f"{cameras} cameras keep {need_mb} MB in flight ({IN_FLIGHT_MIB} MiB each)"
    if limit is None:
        return Finding("usb memory", False, f"{_NOW} cannot be read", "use a kernel with USB (usbcore)", numbers)
    if limit == 0:
        return Finding("usb memory", True, f"usbfs_memory_mb is 0, no limit; {asked}", numbers=numbers)
    # The kernel counts in MiB, and what it rounds up for each transfer, too.
    ok = limit * 2**20 >= 1.1 * cameras * IN_FLIGHT_MIB * 2**20
    found = f"usbfs_memory_mb is {limit}, {asked}"
    remedy = (
        f"`echo {USBFS_MB} > {_NOW}` as root for now; for good `{_ALWAYS}={USBFS_MB}` on the kernel's command line "
        "(GRUB_CMDLINE_LINUX in /etc/default/grub, then update-grub)"
    )
    return Finding("usb memory", ok, found, "" if ok else remedy, numbers)


def _bandwidth(there: dict[str, UsbDevice], asked: Asked) -> list[Finding]:
    controllers: defaultdict[str, list[str]] = defaultdict(list)
    for place, device in there.items():
        controllers[device.controller].append(place)
    findings = []
    for controller, places in sorted(controllers.items()):
        total = len(places) * asked.camera_mb_s
        ok = total <= CONTROLLER_MB_S
        found = (
            f"{', '.join(places)}: {asked.width}×{asked.height} at {asked.rate_hz:g} Hz ask {total:.0f} MB/s of "
            f"controller {controller}, which carries about {CONTROLLER_MB_S:.0f}"
        )
        most = CONTROLLER_MB_S * 1e6 / (len(places) * asked.width * asked.height)
        needed = -(-total // CONTROLLER_MB_S)
        remedy = f"spread the cameras over {needed:.0f} controllers, or lower `trigger.rate_hz` to {most:.1f}"
        numbers = {"controller": controller, "mb_s": total, "limit_mb_s": CONTROLLER_MB_S, "rate_limit_hz": most}
        findings.append(Finding(f"usb bandwidth {controller}", ok, found, "" if ok else remedy, numbers))
    return findings
