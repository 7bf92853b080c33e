"""Options of the commands that put recorded signals at the frames' instants."""

from pathlib import Path
from typing import Annotated

import typer

DbcOption = Annotated[
    list[Path] | None, typer.Option(help="DBC file that names the signals in the recorded CAN frames; can be repeated.")
]
MaxGapOption = Annotated[
    float, typer.Option(min=0.0, help="Longest gap between samples, in seconds, that signals are interpolated over.")
]
