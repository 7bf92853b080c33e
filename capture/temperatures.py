"""The host's temperature sensors, as the kernel shows them, to degrees Celsius by name."""

import contextlib
from pathlib import Path

_SYS = Path("/sys/class")


def host_temperatures_c(sys_class: Path = _SYS) -> dict[str, float]:
    """Thermal zones (processor, board) and hwmon sensors (SSDs); empty where there are none.

    A sensor that cannot be read, or reads nonsense, is left out.
    """
    found: dict[str, float] = {}
    sensors = [(zone / "type", zone / "temp") for zone in sorted(sys_class.glob("thermal/thermal_zone*"))]
    sensors += [(chip / "name", chip / "temp1_input") for chip in sorted(sys_class.glob("hwmon/hwmon*"))]
    for name_file, value_file in sensors:
        with contextlib.suppress(OSError, ValueError):
            name, value_c = name_file.read_text().strip(), int(value_file.read_text()) / 1000.0
            if -60.0 < value_c < 200.0:
                found[_unused(name, found)] = value_c
    return found


def _unused(name: str, names: dict[str, float]) -> str:
    """``nvme``, then ``nvme 2`` …"""
    number = 1
    while (candidate := name if number == 1 else f"{name} {number}") in names:
        number += 1
    return candidate
