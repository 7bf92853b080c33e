"""``wingcap devices``: what is connected, as tables or JSON."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from capture.config import PtpConfig, load_config
from capture.console import note, say, say_json
from capture.devices import Devices, find_devices


def devices(
    config: Annotated[
        Path | None, typer.Option("--config", help="the recorder's TOML file, for where ptp4l is to be asked")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """List cameras, USB devices with bus, port and speed, serial ports, CAN interfaces, and the clock's PTP state."""
    ptp = load_config(config).config.ptp if config is not None else None
    found = find_devices(ptp or PtpConfig())
    if json:
        say_json(found.as_dict())
        return
    _print(found)
    for problem in found.problems:
        note(f"warning: {problem}")


def _print(found: Devices) -> None:
    cameras = [(one.backend, one.address, one.model, one.serial, one.link) for one in found.cameras]
    _table("cameras", ("backend", "address", "model", "serial", "link"), cameras)
    usb = [
        (
            one.controller,
            f"{one.bus}",
            one.port,
            f"{one.speed_mbps:g}",
            f"{one.power_ma}",
            "hub" if one.hub else "camera" if one.vision else "",
            one.model,
            one.serial,
            "yes" if one.usable else "no",
        )
        for one in found.usb.devices
    ]
    columns = ("controller", "bus", "port", "Mbit/s", "mA", "kind", "model", "serial", "may be opened")
    _table("USB", columns, usb)
    limit = found.usb.memory_mb
    say(f"usbfs_memory_mb: {'no USB in this kernel' if limit is None else limit or 'no limit'}")
    ports = [(one.path, one.description, one.serial) for one in found.serial_ports]
    _table("serial ports", ("path", "device", "serial"), ports)
    _table("CAN", ("interface", "state", "received"), [(one.name, one.state, str(one.received)) for one in found.can])
    say(f"PTP: {found.ptp}")


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    if not rows:
        say(f"{title}: none")
        return
    table = Table(*columns, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    Console().print(table)
