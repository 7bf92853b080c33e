"""Options of `reconstruct run`: what each is called and what its help says."""

from pathlib import Path
from typing import Annotated

import typer

from reconstruct.air_table import NAMES

Wing = Annotated[Path, typer.Option(help="wing.toml: structure, markers, and what the fit may assume.")]
Out = Annotated[Path, typer.Option("--output", "-o", help="Folder for the result; made when it is not there.")]
Flights = Annotated[
    list[Path] | None,
    typer.Argument(help="The folders of a flight, or of several; or a flight's marker table (a .parquet file)."),
]
Rig = Annotated[Path | None, typer.Option(help="rig.json of the flight's cameras; needed for frames.")]
Markers = Annotated[Path | None, typer.Option(help="Start from this marker table instead of frames.")]
Smooth = Annotated[
    float,
    typer.Option(min=0.0, help="Smooth in time, and bridge gaps: seconds over which motion is alike; 0: off."),
]
ReferenceFile = Annotated[
    Path | None,
    typer.Option(
        "--reference",
        help="Count displacements from this, not the unloaded wing: of `wingproc reference`, or a result.",
    ),
]
ReferenceWindow = Annotated[
    str | None, typer.Option(help="Count displacements from the mean of these seconds of this recording, A:B.")
]
Direct = Annotated[
    bool, typer.Option("--direct", help="Fit both cameras' pixels: a light that one camera saw counts too.")
]
RootMotion = Annotated[
    bool,
    typer.Option(help="Take out the cameras' motion against the fuselage, where the rig has lights that show it."),
]
Force = Annotated[
    str | None,
    typer.Option(help=f"Aerodynamic loads too, by these signals of the aircraft's acceleration: {NAMES}."),
]
Csv = Annotated[bool, typer.Option(help="Write the tables as CSV too.")]
Mat = Annotated[bool, typer.Option(help="Write result.mat for MATLAB.")]
Mcap = Annotated[bool, typer.Option(help="Write wing.mcap, the wing in 3-D for Foxglove.")]
Netcdf = Annotated[bool, typer.Option(help="Write result.nc (NetCDF; needs xarray).")]
Report = Annotated[bool, typer.Option(help="Draw the report; `reconstruct report` can do so later.")]
Animation = Annotated[bool, typer.Option(help="Film the wing with the report: wing.mp4, 20 s at most.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if not given.")]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Address of a Dask scheduler whose workers are to work, or local: a cluster here."),
]
Json = Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")]
