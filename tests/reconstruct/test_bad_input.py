"""What cannot be is a clear error in one line, or NaN with a reason: never a plausible wrong number."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import UsageError
from reconstruct.cli import app
from reconstruct.fit import fit_frame
from reconstruct.wing import Wing, example_path, read_wing

XHALE = example_path("xhale.toml").read_text()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("GJ = 59.3 ", "GJ = -59.3 "), "GJ"),
        (("GJ = 59.3 ", "GJ = 0.0 "), "GJ"),
        (("EI_out = 112.0 ", "EI_out = nan "), "EI_out"),
        (("EI_in = 6350.0 ", "EI_in = inf "), "EI_in"),
        (("k34 = 46.3 ", "k34 = 900.0 "), "not positive definite"),
        (("station_m = 2.8, chord_m", "station_m = 3.2, chord_m"), "off the wing"),
        (("station_m = 0.2, chord_m = [0.04", "station_m = 0.2, chord_m = [0.08"), "off the chord"),
        (("station_m = 0.2, chord_m = [0.04", "station_m = nan, chord_m = [0.04"), "station_m"),
        (("load_stations_m = [1.0, 2.0, 3.0]", "load_stations_m = [1.0, 4.0]"), "load_stations_m"),
        (("load_stations_m = [1.0, 2.0, 3.0]", "load_stations_m = []"), "load_stations_m"),
        (("[fit]\n", "[fit]\nprior_weight = 0\n"), 'needs loads = "stations"'),
        (("[fit]\n", '[fit]\nprior_weight = "much"\n'), "prior_weight"),
        (("length_m = 2.0", "length_m = -2.0"), "length_m"),
        (("[fit]\n", "[fit]\nspring = 2\n"), "unknown key"),
    ],
)
def test_a_wing_that_cannot_be(tmp_path: Path, change: tuple[str, str], said: str) -> None:
    assert change[0] in XHALE
    path = tmp_path / "wing.toml"
    path.write_text(XHALE.replace(change[0], change[1], 1))
    with pytest.raises(UsageError) as caught:
        read_wing(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_all_markers_missing(xhale: Wing, value: float) -> None:
    cov = np.tile(1e-6 * np.eye(3), (18, 1, 1))
    fit = fit_frame(xhale.right, np.full((18, 3), value), cov, xhale.fit)
    assert not fit.converged
    assert fit.reason == "0 of 18 markers measured, 3 needed"
    for numbers in (fit.position_m, fit.twist_rad, fit.loads, fit.sigma_position_m, fit.strain, fit.sigma_strain):
        assert np.isnan(numbers).all()


def test_one_nan_is_one_marker_less(xhale: Wing) -> None:
    cov = np.tile(1e-6 * np.eye(3), (18, 1, 1))
    xyz = xhale.right.rest_marker_m.copy()
    xyz[3, 1] = np.nan
    cov[5, 0, 1] = np.nan
    fit = fit_frame(xhale.right, xyz, cov, xhale.fit)
    assert np.flatnonzero(~fit.used).tolist() == [3, 5]
    assert fit.position_m == pytest.approx(xhale.right.rest_position_m, abs=1e-3)


def test_markers_of_another_wing(xhale: Wing) -> None:
    with pytest.raises(ValueError, match="expected 18 markers"):
        fit_frame(xhale.right, np.zeros((12, 3)), np.zeros((12, 3, 3)), xhale.fit)


@pytest.mark.parametrize(
    "arguments",
    [
        ["plan", "--wing", "none.toml"],
        ["static", "--wing", str(example_path("xhale.toml")), "--loads", "none.toml"],
        ["run", "none", "--wing", "none.toml", "-o", "out"],
    ],
)
def test_files_that_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    monkeypatch.chdir(tmp_path)
    result: Any = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, UsageError)
    assert "none" in str(result.exception)


@pytest.mark.parametrize("noise", ["0", "-1", "nan"])
def test_a_noise_that_is_none(noise: str) -> None:
    result: Any = CliRunner().invoke(app, ["plan", "--wing", str(example_path("xhale.toml")), "--noise-mm", noise])
    assert result.exit_code != 0


def test_loads_that_are_no_numbers(tmp_path: Path) -> None:
    (tmp_path / "loads.toml").write_text("[[point]]\nstation_m = 3.0\nforce_n = [0, 0, nan]\n")
    arguments = ["static", "--wing", str(example_path("xhale.toml")), "--loads", str(tmp_path / "loads.toml")]
    result: Any = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, UsageError)
    assert "force_n" in str(result.exception)
