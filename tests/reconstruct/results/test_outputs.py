"""What others open a result with: pandas, xarray, SciPy (for MATLAB), the stock MCAP library, Rerun; the library."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from needs import needs_module
from scipy.io import loadmat, netcdf_file

from capture.errors import UsageError
from reconstruct import open_result, reconstruct
from reconstruct.mat_file import write_mat

SETS = 30


@pytest.fixture(scope="module")
def flight(bending_wing: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A marker table in which the left wing lacks a set."""
    folder = tmp_path_factory.mktemp("flight")
    table = bending_wing().marker_table(np.arange(SETS) * 0.04, sigma_m=1e-3)
    trigger = table.column("trigger_index").to_numpy()
    left = np.asarray(table.column("side")) == "left"
    pq.write_table(table.filter(pa.array(~(left & (trigger == trigger[0] + 3 * 36)))), folder / "markers.parquet")
    return folder


@pytest.fixture(scope="module")
def out(flight: Path, wing_file: Path) -> Path:
    """The whole result, every format, by the command."""
    line = [sys.executable, "-c", "from reconstruct.cli import main; main()", flight / "markers.parquet"]
    line += ["--wing", wing_file, "-o", flight / "out", "--netcdf", "--no-report", "--workers", 1]
    done = subprocess.run(list(map(str, line)), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return flight / "out"


def test_pandas_reads_parquet_and_csv_alike(out: Path) -> None:
    for name in ("frames", "shape", "loads", "residuals", "markers"):
        parquet, csv = pd.read_parquet(out / f"{name}.parquet"), pd.read_csv(out / f"{name}.csv")
        assert list(parquet) == list(csv)
        assert len(parquet) == len(csv) > 0
        numbers = parquet.select_dtypes("number").columns
        np.testing.assert_allclose(parquet[numbers], csv[numbers].astype(float), rtol=1e-12)


def test_matlab_file(out: Path) -> None:
    content = loadmat(out / "result.mat", simplify_cells=True)
    frames = pd.read_parquet(out / "frames.parquet")
    right = frames[frames.side == "right"]
    np.testing.assert_array_equal(content["right"]["frames"]["tip_dz_m"], right.tip_dz_m)
    np.testing.assert_array_equal(content["right"]["frames"]["timestamp_ns"], right.timestamp_ns)
    shape = pd.read_parquet(out / "shape.parquet")
    stations = shape.station.nunique()
    z = shape[shape.side == "right"].z_m.to_numpy().reshape(-1, stations)
    np.testing.assert_array_equal(content["right"]["shape"]["z_m"], z)
    flags, words = content["right"]["markers"]["flags"], np.atleast_1d(content["right"]["markers"]["flags_words"])
    markers = pd.read_parquet(out / "markers.parquet")
    said = markers[markers.side == "right"]["flags"].to_numpy().reshape(-1, 18)
    assert flags.shape == said.shape
    assert all(
        (words[code - 1] if code else "") == word for code, word in zip(flags.ravel(), said.ravel(), strict=True)
    )
    assert "--wing" in json.loads(content["wingshape"]["made"])["command"]


def test_matlab_file_of_a_long_flight_is_cut(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Into variables of bounded size, one after the other the same as the whole."""
    folder = shutil.copytree(out, tmp_path / "out")
    whole = loadmat(out / "result.mat", simplify_cells=True)
    monkeypatch.setattr("reconstruct.mat_file.LARGEST_BYTES", 150_000)
    cut = loadmat(write_mat(folder), simplify_cells=True)
    names = [name for name in cut if name.startswith("right")]
    assert names == ["right", *(f"right_{number}" for number in range(2, len(names) + 1))]
    assert len(names) > 2
    for table, column in (("frames", "tip_dz_m"), ("shape", "z_m"), ("markers", "flags"), ("residuals", "used")):
        pieces = [cut[name][table][column] for name in names]
        assert max(piece.shape[0] for piece in pieces) * 15_000 < 300_000
        np.testing.assert_array_equal(np.concatenate(pieces), whole["right"][table][column])


def test_netcdf_file(out: Path) -> None:
    with netcdf_file(out / "result.nc", mmap=False) as file:
        assert set(file.dimensions) >= {"side", "trigger", "station", "load_station"}
        assert file.variables["z_m"].shape[0] == 2
        assert "command" in json.loads(file.wingshape)


def test_the_scene_is_the_shape(out: Path) -> None:
    shape = pd.read_parquet(out / "shape.parquet")
    with (out / "wing.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages())
        assert next(reader.iter_metadata()).name == "wingshape"
    assert {(schema.name, schema.encoding) for schema, _, _ in messages} == {("foxglove.SceneUpdate", "jsonschema")}
    assert {channel.topic for _, channel, _ in messages} == {"/wing/left", "/wing/right"}
    for _, channel, message in messages[::7]:
        (entity,) = json.loads(message.data)["entities"]
        own = shape[(shape.side == channel.topic[6:]) & (shape.timestamp_ns == message.log_time)]
        points = [[point[axis] for axis in "xyz"] for point in entity["lines"][0]["points"]]
        np.testing.assert_allclose(points, own[["x_m", "y_m", "z_m"]], atol=1e-5)
        assert len(entity["spheres"]) == 18


@pytest.mark.slow
def test_rerun_opens_the_scene(out: Path, tmp_path: Path) -> None:
    needs_module("rerun")
    done = subprocess.run(
        [str(Path(sys.executable).with_name("rerun")), "mcap", "convert", str(out / "wing.mcap"),
         "-o", str(tmp_path / "wing.rrd")],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "wing.rrd").stat().st_size > 1000


class TestLibrary:
    def test_the_same_as_the_command(self, flight: Path, out: Path, wing_file: Path, tmp_path: Path) -> None:
        result = reconstruct(flight / "markers.parquet", wing=wing_file, out=tmp_path / "r", workers=1)
        assert result.to_arrow("shape").equals(pq.read_table(out / "shape.parquet"))
        assert result.summary["sets"] == 2 * SETS

    def test_pandas_and_xarray(self, out: Path) -> None:
        result = open_result(out)
        frames = result.to_pandas()
        assert str(frames.time.dtype).startswith("datetime64")
        dataset = result.to_xarray()
        assert dict(dataset.sizes)["side"] == 2
        right = frames[frames.side == "right"]
        np.testing.assert_array_equal(dataset.tip_dz_m.sel(side="right").dropna("trigger"), right.tip_dz_m)
        assert dataset.z_m.dims == ("side", "trigger", "station")

    def test_what_is_not_there_is_said(self, out: Path, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match=r"summary\.json"):
            open_result(tmp_path)
        with pytest.raises(UsageError, match="no table of a result"):
            open_result(out).to_arrow("colours")
