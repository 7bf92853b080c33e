"""What cameras each backend can find, with the address that the configuration would name them by."""

from dataclasses import dataclass
from pathlib import Path

from capture.camera.aravis_library import load_library
from capture.errors import CameraError

VIDEO = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class FoundCamera:
    """One camera that answers."""

    backend: str
    address: str
    model: str
    serial: str
    link: str  # USB3Vision, GigEVision at 192.168.1.5, …


def find_cameras(video: Path = VIDEO) -> tuple[list[FoundCamera], list[str]]:
    """Cameras of all backends, and why one of these could not look. Takes a second: GigE Vision cameras are called."""
    problems: list[str] = []
    try:
        cameras = _find_aravis()
    except CameraError as error:
        cameras = []
        problems.append(f"aravis: {error}")
    return [*cameras, *_find_v4l2(video)], problems


def _find_aravis() -> list[FoundCamera]:
    library = load_library()
    library.call("arv_update_device_list")
    found = []
    for number in range(library.call("arv_get_n_devices")):
        names = ("id", "vendor", "model", "serial_nbr", "address", "protocol")
        told = {name: library.call(f"arv_get_device_{name}", number) for name in names}
        words = {name: (text or b"").decode(errors="replace") for name, text in told.items()}
        link = words["protocol"] + (f" at {words['address']}" if words["protocol"] == "GigEVision" else "")
        model = f"{words['vendor']} {words['model']}".strip()
        found.append(FoundCamera("aravis", words["id"], model, words["serial_nbr"], link))
    return found


def _find_v4l2(video: Path) -> list[FoundCamera]:
    found = []
    for place in sorted(video.iterdir()) if video.is_dir() else ():
        try:
            model = (place / "name").read_text(encoding="utf-8").strip()
        except OSError:
            continue
        found.append(FoundCamera("v4l2", f"/dev/{place.name}", model, "", "video4linux"))
    return found
