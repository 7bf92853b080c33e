"""The error trees: one root for the distribution, one branch a package.

WingshapeError            exit code 1; the message says what happened, to what, and what to do
├── UsageError            exit code 2: the user asked for something that cannot be (also a ValueError)
├── CaptureError
│   ├── ConfigError       (also a UsageError)
│   ├── CameraError
│   │   └── CameraLost    the device is gone; its triggers are booked as lost until it is back
│   ├── TriggerBoardError
│   ├── PtpError
│   ├── LinkError         a CAN bus, the autopilot: what is recorded beside the cameras (also a ConnectionError)
│   ├── DiskError
│   └── RecordingError    a recording that cannot be read or is not whole
├── ProcessError          (process)
├── ReconstructError      (reconstruct)
└── SimulationError       (hw_sim)
"""


class WingshapeError(Exception):
    """Something a user can act on. ``str(error)`` is the one line they are shown."""

    exit_code = 1


class UsageError(WingshapeError, ValueError):
    """The input or an option is wrong; nothing was done."""

    exit_code = 2


class CaptureError(WingshapeError):
    """Something failed on the recording side."""


class ConfigError(CaptureError, UsageError):
    """A configuration file that cannot be used."""

    exit_code = 2


class CameraError(CaptureError):
    """A camera did not do what it was asked to."""


class CameraLost(CameraError, ConnectionError):
    """The camera is gone: unplugged, powered off, or its link is broken."""


class TriggerBoardError(CaptureError):
    """The trigger board is silent, refuses a command or talks nonsense."""


class LinkError(CaptureError, ConnectionError):
    """What is recorded beside the cameras is missing or gone: a CAN bus, the autopilot."""


class PtpError(CaptureError):
    """ptp4l does not answer, or not with what is needed."""


class DiskError(CaptureError, OSError):
    """A disk refused a write: full, failing or gone."""


class RecordingError(CaptureError):
    """A recording that cannot be read, or is not whole."""


class ProcessError(WingshapeError):
    """Calibration, detection, matching or triangulation cannot go on."""


class ReconstructError(WingshapeError):
    """A wing file, marker table or fit cannot be used."""


class SimulationError(WingshapeError):
    """The simulated rig cannot do what it was asked to."""
