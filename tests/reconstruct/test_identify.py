"""What markers tell before anything is measured, against fits of many draws."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from reconstruct.cli import app
from reconstruct.fit import fit_frame
from reconstruct.identify import identify
from reconstruct.plan import plan_table
from reconstruct.wing import build_wing, example_path
from reconstruct.wing_file import WingFile


def described(spacing_m: float | None = None, stations: tuple[float, ...] | None = None) -> WingFile:
    content = tomllib.loads(example_path("xhale.toml").read_text())
    if spacing_m is not None:
        for pair in content["markers"]["pairs"]:
            pair["chord_m"] = [-0.03 + spacing_m / 2, -0.03 - spacing_m / 2]
    if stations is not None:
        content["fit"]["load_stations_m"] = list(stations)
    return WingFile.model_validate(content)


def identified(file: WingFile, sigma_m: float):
    wing = build_wing(file)
    return identify(wing.right, wing.fit, np.tile(sigma_m**2 * np.eye(3), (18, 1, 1)))


def test_the_stated_sigmas_are_those_of_the_fit() -> None:
    wing = build_wing(described())
    cov = np.tile(1e-3**2 * np.eye(3), (18, 1, 1))
    fit = fit_frame(wing.right, wing.right.rest_marker_m, cov, wing.fit.model_copy(update={"prior_weight": 1.0}))
    found = identified(described(), 1e-3)
    assert found.tip_twist_sigma_deg == pytest.approx(np.degrees(fit.sigma_twist_rad[-1]), rel=0.01)
    assert found.tip_sigma_mm == pytest.approx(1e3 * np.linalg.norm(fit.sigma_position_m[-1]), rel=0.01)
    assert found.numbers_told == pytest.approx(54 - fit.dof, abs=0.05)


def test_lights_10_mm_apart_do_not_measure_twist() -> None:
    """A pair gives σ√2/10 mm: 24° at 3 mm, against 1.7° for lights 140 mm apart; the prior has 3°."""
    close, wide = identified(described(0.010), 3e-3), identified(described(0.140), 3e-3)
    assert not close.twist_is_measured
    assert close.told_twist < 0.1
    assert "Twist is predicted from stiffness" in close.warnings[0]
    assert wide.twist_is_measured
    assert wide.warnings == []
    assert close.tip_twist_sigma_deg > 2 * wide.tip_twist_sigma_deg


def test_more_stations_than_markers_tell() -> None:
    condition = [
        identified(described(stations=tuple(3.0 * (i + 1) / k for i in range(k))), 3e-3).condition for k in (1, 2, 3)
    ]
    assert condition[0] < 1e4 < condition[1] < condition[2]
    six = identified(described(stations=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0)), 3e-3)
    assert six.condition == np.inf
    assert "6 load stations are too many" in six.warnings[-1]


def test_more_and_wider_pairs_never_hurt() -> None:
    rows = plan_table(described(), 3e-3)["rows"]
    for ending, key in ((" pairs", "shape_sigma_mm"), (" apart", "twist_sigma_deg")):
        errors = [row[key] for row in rows if row["layout"].endswith(ending)]
        assert len(errors) >= 5
        assert errors == sorted(errors, reverse=True)


def test_the_command(tmp_path: Path) -> None:
    arguments = [
        "plan",
        "--wing",
        str(example_path("pazy.toml")),
        "--noise-mm",
        "0.5",
        "--plot",
        str(tmp_path / "p.png"),
    ]
    printed = CliRunner().invoke(app, arguments)
    assert printed.exit_code == 0, printed.output
    assert "assumed" in printed.output
    assert (tmp_path / "p.png").stat().st_size > 5000
    rows = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).output)["rows"]
    assert {"layout", "shape_sigma_mm", "twist_is_measured", "condition"} <= set(rows[0])
