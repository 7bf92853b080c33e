"""Aravis' cameras without hardware: the one inside the library."""

from camera_harness import Harness
from needs import needs_library

from capture.camera.aravis_library import LIBRARY
from capture.camera.base import CameraSettings


class AravisFakeHarness(Harness):
    """Runs free at 25 Hz, in this process: no trigger line, no plug, and it loses nothing but what has no buffer."""

    backend = "aravis"
    faults = frozenset()
    exclusive = False
    refused = (
        ({"gain_db": 99.0}, r"gain 99 dB was asked, .* 0 to 10; set `camera.gain_db`"),
        ({"exposure_us": 2}, r"exposure time 2 us was asked, .* 10 to 1e\+07; set `camera.exposure_us`"),
        ({"black_level": 3.0}, "no black level: remove `camera.black_level`"),
        ({"shutter_mode": "Global"}, "no shutter mode: remove `camera.shutter_mode`"),
    )

    def __enter__(self) -> "AravisFakeHarness":
        needs_library(LIBRARY)
        self.address = "fake:CONTRACT"
        self.settings = CameraSettings(640, 480, 2000, 0.0)
        return self

    def __exit__(self, *exception: object) -> None: ...
