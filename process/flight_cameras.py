"""A recording's provenance to which camera stood where, held against the rig: swapped cameras are not measured with."""

import json
from collections.abc import Sequence
from pathlib import Path

from capture.errors import ProcessError
from process.camera_model import Rig
from process.provenance import recorded_provenance


def recorded_serials(files: Sequence[Path]) -> dict[str, str]:
    """Serial number by place, such as ``left/cam0``, as the recorder noted them; empty where it did not."""
    serials: dict[str, str] = {}
    for path in files:
        for place, serial in _serials_of(path).items():
            serials.setdefault(place, serial)
    return serials


def check_cameras(files: Sequence[Path], rig: Rig) -> None:
    """ProcessError, naming all of them, if cameras of the recording are not those that the rig has in their places.

    A place whose serial number the recording or the rig does not know passes.
    """
    recorded = recorded_serials(files)
    expected = {
        f"{name}/{camera}": serial
        for name in ("left", "right")
        for camera, serial in zip(
            ("cam0", "cam1"), (rig.side(name).cam0_serial, rig.side(name).cam1_serial), strict=True
        )
    }
    places = {serial: place for place, serial in expected.items()}
    wrong = []
    for place, serial in sorted(recorded.items()):
        known = expected.get(place, "")
        if serial and known and serial != known:
            where = f", the rig's {places[serial]}" if serial in places else ", which the rig does not know"
            wrong.append(f"{place} is {serial}{where}, not {known}")
    if wrong:
        raise ProcessError(
            f"{files[0].parent}: the cameras are not where the rig has them: {'; '.join(wrong)}; use this flight's rig "
            "file, or survey the rig again with the cameras as they are"
        )


def _serials_of(path: Path) -> dict[str, str]:
    try:
        value = json.loads(recorded_provenance(path).get("serials", "{}"))
        return {str(place): str(serial) for place, serial in value.items()}
    except (ValueError, AttributeError):
        return {}
