"""A USB3 Vision camera on a real kernel's USB: our emulator on vhci_hcd. For the guest of the VM suite."""

import time
from pathlib import Path

from camera_harness import Harness
from needs import needs_library

from capture.camera.aravis_library import LIBRARY
from capture.camera.base import CameraSettings
from capture.clock import SystemClock
from hw_sim.u3v import U3vPlug
from hw_sim.u3v_camera import Kind, own_exposure_us, own_gain_db

BUFFER_FRAMES = 4
_ENUMERATED_S = 20.0


class UsbHarness(Harness):
    """Every fault happens on the wire; kernel, udev, libusb and Aravis are the real ones."""

    backend = "aravis"
    refused = (
        ({"gain_db": 99.0}, r"gain 99 dB was asked, .* 0 to 24; set `camera.gain_db`"),
        ({"exposure_us": 5}, r"exposure time 5 us was asked, .* 20 to 3.19e\+07; set `camera.exposure_us`"),
        ({"width": 1000}, r"Width 1000 was asked, the camera has 992"),
        ({"width": 4160}, r"Width 4160 was asked, .* 16 to 2080; set `camera.width`"),
        ({"trigger_line": "Line9"}, r"TriggerSource Line9 was asked, .* set `camera.trigger_line`"),
        ({"shutter_mode": "Global"}, r"SensorShutterMode Global was asked, .* set `camera.shutter_mode`"),
    )
    chunk_bytes = 4 * 8 + 3 * 8  # four ends of 8 bytes, three values of 8
    frame_within_s = 10.0
    loss_within_s = 20.0
    back_within_s = 30.0

    def __enter__(self) -> "UsbHarness":
        needs_library(LIBRARY)
        self._clock = SystemClock()
        self._device = U3vPlug(0, self._clock, Kind(BUFFER_FRAMES))
        self._index = 0
        self.address = self._device.device_id
        self.settings = CameraSettings(416, 312, 2000, 0.0, shutter_mode="Rolling")
        self.plug()
        return self

    def __exit__(self, *exception: object) -> None:
        self._device.unplug()

    def facts(self, index: int) -> tuple[int, float, int]:
        asked = self.settings
        return round(own_exposure_us(asked.exposure_us, index)), own_gain_db(asked.gain_db, index), index + 1

    def trigger(self) -> None:
        camera = self._device.camera
        if camera is not None:
            camera.edge(self._index, self._clock.utc_ns())
        self._index += 1

    def drop(self) -> None:
        assert self._device.camera is not None
        self._device.camera.lose(self._index)

    def truncate(self) -> None:
        assert self._device.camera is not None
        self._device.camera.cut_short(self._index)

    def unplug(self) -> None:
        self._device.unplug()

    def plug(self) -> None:
        self._device.plug_in()
        deadline_s = time.monotonic() + _ENUMERATED_S
        while not self._enumerated():
            assert time.monotonic() < deadline_s, "the kernel does not see the camera"
            time.sleep(0.05)

    def _enumerated(self) -> bool:
        for path in Path("/sys/bus/usb/devices").glob("*/serial"):
            try:
                if path.read_text().strip() == self._device.serial:
                    return True
            except OSError:  # going away just now
                continue
        return False
