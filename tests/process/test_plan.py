"""What a plan promises, against closed forms and against what a rendered calibration then has."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from capture.errors import UsageError
from process.board import Board
from process.calibrate import calibration_covariance_m2
from process.camera_model import MarkerLayout
from process.cli import app
from process.plan import Mount, calibrated, ideal_pair, predict

LAYOUT = MarkerLayout((0.5, 1.5, 2.8), (0.04, -0.10), 0.004)


def mount(focal_mm: float) -> Mount:
    return Mount(focal_mm, 2.5, (2080, 1552), 0.2794, (0.03, -0.2, 0.08), (0.0, 0.99, 0.14))


def test_noise_follows_the_textbook():
    """Range error Z² σ √2 / (B f), across it Z σ / (√2 f) or so: along the wing 2 Z / B times as much."""
    ahead = MarkerLayout(LAYOUT.pairs_station_m, (-0.02, -0.04), 0.004)  # near the axis: x is across the view
    prediction = predict(mount(3.5), ideal_pair(mount(3.5)), ahead, 0.0, 0.003)
    assert prediction.in_view.all()
    assert prediction.field_of_view_deg[0] == pytest.approx(2 * np.degrees(np.arctan(1040 / 1400)))
    distance_m = prediction.places_m[-1, 1] + 0.2
    ratio = prediction.noise_mm[-1, 1] / prediction.noise_mm[-1, 0]
    assert ratio == pytest.approx(2 * distance_m / 0.2794, rel=0.1)
    assert np.isnan(prediction.calibration_mm).all()  # no calibration was planned


def test_a_longer_lens_sees_less_and_measures_better():
    wide, long = (predict(mount(f), ideal_pair(mount(f)), LAYOUT, 0.0, 0.003) for f in (3.5, 10.0))
    assert wide.in_view.all()
    assert not long.in_view[:2].any()
    assert np.isnan(long.noise_mm[~long.in_view]).all()
    assert np.all(long.noise_mm[-1] < 0.5 * wide.noise_mm[-1])


def test_the_planned_calibration_is_like_a_rendered_one():
    """15 rendered views at F = 6.75 mm were calibrated to sigmas of 0.076, 0.032, 0.111 mm at 2 m; views differ."""
    planned = mount(6.75)
    pair = calibrated(ideal_pair(planned), Board(10, 7, 0.030), 15)
    covariance = calibration_covariance_m2(pair, np.array([[0.14, 0.0, 2.0]]))[0]
    np.testing.assert_allclose(1000 * np.sqrt(np.diag(covariance)), [0.076, 0.032, 0.111], rtol=0.6)


def test_the_command():
    options = ["plan", "--focal-mm", "3.5", "--pairs-m", "0.5,1.5,2.8", "--views", "8"]
    done = CliRunner().invoke(app, [*options, "--json"], catch_exceptions=False)
    (found,) = json.loads(done.stdout)["mounts"]
    assert found["markers_in_view"] == 6
    assert all(0.01 < sigma < 5.0 for sigma in found["markers"][5]["calibration_sigma_mm"])
    assert "6 of 6 markers in view" in CliRunner().invoke(app, options, catch_exceptions=False).stdout


@pytest.mark.parametrize(
    "wrong", [["--pairs-m", "1,a"], ["--pairs-m", "2,1"], ["--position-m", "1,2"], ["--size-px", "9"]]
)
def test_wrong_options_are_refused(wrong):
    with pytest.raises(UsageError, match=wrong[0]):
        CliRunner().invoke(app, ["plan", *wrong], catch_exceptions=False)
