"""On the ground: from markers to the shape, twist and loads of a geometrically nonlinear beam.

In a notebook::

    from reconstruct import open_result, reconstruct

    result = reconstruct(["/mnt/ssd_left/F1", "/mnt/ssd_right/F1"], rig="rig.json", wing="wing.toml", out="result")
    result.to_pandas("frames").plot(x="time", y="tip_dz_m")
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from reconstruct.dense import ResultFolder

__all__ = ["open_result", "reconstruct"]


def reconstruct(
    flight: "Sequence[Path | str]",
    *,
    wing: Path | str,
    out: Path | str,
    rig: Path | str | None = None,
    reference_window: str | None = None,
    smooth_s: float = 0.0,
    workers: int | None = None,
    scheduler: str | None = None,
) -> "ResultFolder":
    """What ``reconstruct run`` does, without the report and the other formats; returns the result.

    In a script, call it below ``if __name__ == "__main__":``, since its worker processes load the script.

    Args:
        flight: the flight's folders, or one marker table (``.parquet``).
        wing: wing.toml.
        out: folder for the result.
        rig: rig.json; needed for frames.
        reference_window: ``A:B`` in seconds of this recording, at rest, which displacements are counted from.
        smooth_s: correlation time of smoothing; 0: every set by itself.
        workers: processes; None: one a core.
        scheduler: a Dask scheduler's address, or ``local``.

    Raises:
        WingshapeError: as ``capture.errors`` says; the message says what to do.
    """
    from capture.errors import UsageError
    from process.flights import find_flights
    from process.reference import parse_window
    from reconstruct.dense import ResultFolder
    from reconstruct.run import Job, run_job

    paths = [Path(path) for path in ([flight] if isinstance(flight, (str, Path)) else flight)]
    table = paths[0] if len(paths) == 1 and paths[0].suffix == ".parquet" else None
    names = [] if table else [one.name for one in find_flights(paths)]
    if len(names) > 1:
        raise UsageError(f"these are different flights ({', '.join(names)}): reconstruct one at a time")
    job = Job(
        flights=() if table else tuple(paths),
        rig=None if rig is None else Path(rig),
        markers=table,
        wing=Path(wing),
        out=Path(out),
        csv=False,
        workers=workers,
        command="reconstruct.reconstruct",
        smooth_s=smooth_s,
        reference=None if reference_window is None else parse_window(reference_window, "reference_window"),
        also=(),
        report=False,
        scheduler=scheduler,
    )
    run_job(job)
    return ResultFolder(job.out)


def open_result(folder: Path | str) -> "ResultFolder":
    """The result that an earlier run left in a folder. Raises UsageError when there is none."""
    from reconstruct.dense import ResultFolder

    result = ResultFolder(Path(folder))
    result.summary  # noqa: B018  # raises when there is none
    return result
