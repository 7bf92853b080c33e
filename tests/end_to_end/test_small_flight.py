"""The whole chain on a small flight, by the commands a user types, and what those commands say when given bad input."""

import csv
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from capture.record import Frame
from capture.scan import scan
from hw_sim.demo import executable

SCALE, SECONDS, RATE_HZ = 4, 3, 25
TRIGGERS = SECONDS * RATE_HZ
OUTERMOST = 17
FLIGHT = ("ssd_left/demo", "ssd_right/demo")


def run(folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    command = [executable(str(words[0])), *map(str, words[1:])]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)


def columns(path: Path) -> list[tuple[str, pa.ChunkedArray]]:
    table = pq.read_table(path)
    return list(zip(table.column_names, table.columns, strict=True))


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstration's folder, at a quarter of the size."""
    folder = tmp_path_factory.mktemp("demo")
    answer = run(folder.parent, "wingsim", "demo", "-o", folder, "--seconds", SECONDS, "--scale", SCALE)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    assert str(folder / "result/report.html") in answer.stdout
    return folder


def test_the_summary_is_what_was_measured(demo):
    summary = json.loads((demo / "summary.json").read_text())
    assert summary["triggers"] == TRIGGERS
    assert summary["frames_recorded"] + summary["frames_lost"] == 4 * TRIGGERS
    # A quarter of the resolution: markers to about 1 mm RMS; a beam through 18 of them is several times better.
    assert 0 < summary["marker_rms_mm"] < 2.5
    assert 0 < summary["shape_rms_mm"] < 1.0
    assert 0 < summary["tip_error_mm"] < 2.5
    assert 0 < summary["twist_rms_deg"] < 0.3
    assert summary["wall_s"] > SECONDS


def test_the_errors_are_those_of_the_tables(demo):
    """Marker error by hand: the truth's own table, interpolated linearly (it is dense), against the measured one."""
    result = {name: column.to_numpy() for name, column in columns(demo / "result/markers.parquet")}
    truth = {name: column.to_numpy() for name, column in columns(demo / "truth/markers.parquet")}
    squares = []
    for side in ("left", "right"):
        for marker in range(18):
            mine = (result["side"] == side) & (result["marker"] == marker) & np.isfinite(result["x_m"])
            known = (truth["side"] == side) & (truth["marker"] == marker)
            start_ns = truth["timestamp_ns"][known][0]
            at, times = result["timestamp_ns"][mine] - start_ns, truth["timestamp_ns"][known] - start_ns
            errors = [result[x][mine] - np.interp(at, times, truth[x][known]) for x in ("x_m", "y_m", "z_m")]
            squares.append(np.sum(np.square(errors), axis=0))
    rms_mm = 1e3 * np.sqrt(np.mean(np.concatenate(squares)))
    assert rms_mm == pytest.approx(json.loads((demo / "summary.json").read_text())["marker_rms_mm"], rel=0.03)


def test_every_frames_instant_is_that_of_its_edge(demo):
    """The simulated cameras' clocks start anywhere and drift; the edges' true times are in the truth."""
    with (demo / "truth/triggers.csv").open(encoding="utf-8") as file:
        edges = {int(row["index"]): int(row["actual_ns"]) for row in csv.DictReader(file)}
    frames = []
    for folder in FLIGHT:
        for path in sorted((demo / folder).glob("*.mcap")):
            frames += [Frame.decode(m.data) for m in scan(path)[1] if m.topic.endswith("/frame")]
    errors = np.array([abs(frame.exposure_start_ns - edges[frame.trigger_index]) for frame in frames])
    assert len(frames) > 3.5 * TRIGGERS
    assert np.quantile(errors, 0.95) < 50_000
    assert all(error < 5 * frame.time_sigma_ns for error, frame in zip(errors, frames, strict=True))


def test_load_factor_and_controls_stand_beside_the_tip(demo):
    """Each against the truth at the sets' own instants.

    The load factor changes by at most 3 a second (a gust of 0.4 at 1.1 Hz): 10 ms of latency, on a busy computer, are
    0.03.
    """
    frames = {name: column.to_numpy() for name, column in columns(demo / "result/frames.parquet")}
    truth = {name: column.to_numpy() for name, column in columns(demo / "truth/aircraft.parquet")}
    markers = {name: column.to_numpy() for name, column in columns(demo / "truth/markers.parquet")}
    start_ns = truth["timestamp_ns"][0]
    at_s, times_s = ((times - start_ns) * 1e-9 for times in (frames["timestamp_ns"], truth["timestamp_ns"]))
    for signal, true, within in (
        ("load_factor", "load_factor", 0.03), ("airspeed", "airspeed_mps", 0.1), ("elevator", "elevator_deg", 0.5),
        ("elevator_analog_deg", "elevator_deg", 0.1), ("attitude_roll", "roll_rad", 0.05),
    ):  # fmt: skip
        known = np.isfinite(frames[signal])
        assert known.mean() > 0.9, signal  # the autopilot and the bus start when they start
        errors = frames[signal][known] - np.interp(at_s[known], times_s, truth[true])
        assert np.sqrt(np.mean(errors**2)) < within, signal
        assert np.nanmax(frames[f"{signal}_gap_s"]) <= 0.5
    known = np.isfinite(frames["load_factor"]) & np.isfinite(frames["tip_dz_m"])
    for side in ("left", "right"):
        mine = known & (frames["side"] == side)
        lights = (markers["side"] == side) & (markers["marker"] == OUTERMOST)
        true_m = np.interp(at_s[mine], (markers["timestamp_ns"][lights] - start_ns) * 1e-9, markers["z_m"][lights])
        # how well the two go together is the flight's own: the wing lags its load, and gusts come when they come
        load_factor = frames["load_factor"][mine]
        true, found = (np.corrcoef(z_m, load_factor)[0, 1] for z_m in (true_m, frames["tip_dz_m"][mine]))
        assert true > 0.7
        assert found == pytest.approx(true, abs=0.03)
    assert (demo / "result/figures/signals.png").exists()
    assert np.isfinite(frames["time_sigma_ns"]).all()


def test_nothing_that_measures_needs_the_truth(demo, tmp_path):
    """The same markers and shapes with the truth out of the way."""
    hidden = tmp_path / "truth"
    shutil.move(demo / "truth", hidden)
    try:
        again = tmp_path / "markers.parquet"
        assert run(demo, "wingproc", "markers", *FLIGHT, "--rig", "ground/rig.json", "-o", again).returncode == 0
        answer = run(
            demo, "reconstruct", "run", "--markers", again, "--rig", "ground/rig.json", "--wing", "ground/wing.toml",
            "-o", tmp_path / "result",
        )  # fmt: skip
        assert answer.returncode == 0, answer.stderr
    finally:
        shutil.move(hidden, demo / "truth")
    assert pq.read_table(again).equals(pq.read_table(demo / "markers.parquet"))
    assert pq.read_table(tmp_path / "result/shape.parquet").equals(pq.read_table(demo / "result/shape.parquet"))
    compared = run(demo, "reconstruct", "compare", tmp_path / "result", "truth", "--json")
    assert json.loads(compared.stdout)["shape_rms_mm"] == pytest.approx(
        json.loads((demo / "summary.json").read_text())["shape_rms_mm"]
    )


def test_a_flight_straight_to_shapes_is_the_same(demo, tmp_path):
    answer = run(
        demo, "reconstruct", *FLIGHT, "--rig", "ground/rig.json", "--wing", "ground/wing.toml", "-o", tmp_path / "r"
    )
    assert answer.returncode == 0, answer.stderr
    assert pq.read_table(tmp_path / "r/shape.parquet").equals(pq.read_table(demo / "result/shape.parquet"))


def test_verify_certifies_the_flight(demo):
    answer = run(demo, "wingcap", "verify", *FLIGHT)
    assert answer.returncode == 0
    assert f"WHOLE: {TRIGGERS} triggers × 4 cameras" in answer.stdout


def test_stock_readers_open_the_flight(demo):
    with (demo / FLIGHT[0] / "left_0000.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        images = [image for _, _, _, image in reader.iter_decoded_messages(topics=["/left/cam0/image_raw"])]
    assert {(image.width, image.height) for image in images} == {(2080 // SCALE, 1552 // SCALE)}
    with AnyReader([demo / folder for folder in FLIGHT]) as bag:
        connections = [c for c in bag.connections if c.topic.endswith("/image_raw")]
        assert len(connections) == 4
        for connection, _, raw in bag.messages(connections=connections):
            image = bag.deserialize(raw, connection.msgtype)
            assert image.data.size == image.height * image.width


BAD_INPUT = [
    (2, "colour", "wingcap record --config bad_config.toml"),
    (2, "ground/none.json", "wingcap record --config no_calibration.toml"),
    (2, "none.toml", "wingcap record --config none.toml"),
    (1, "empty", "wingcap verify empty"),
    (1, "empty", "wingcap info empty"),
    (1, "cut", "wingcap verify cut ssd_right/demo"),
    (1, "none.json", "wingproc markers ssd_left/demo --rig none.json -o x.parquet"),
    (1, "empty", "wingproc markers empty --rig ground/rig.json -o x.parquet"),
    (1, "none.json", "wingproc rig ground/left.json none.json --survey ground/survey.toml -o x.json"),
    (2, "empty", "wingproc calibrate --cam0 empty --cam1 empty --board 10x7 --square-mm 30 -o x.json"),
    (2, "none.toml", "reconstruct run --markers markers.parquet --rig ground/rig.json --wing none.toml -o x"),
    (1, "empty", "reconstruct empty --rig ground/rig.json --wing ground/wing.toml -o x"),
    (2, "none.parquet", "reconstruct run --markers none.parquet --wing ground/wing.toml -o x"),
    (2, "bad_wing.toml", "reconstruct run --markers markers.parquet --wing bad_wing.toml -o x"),
    (2, "none.toml", "wingsim rig --world none.toml --socket s --trigger-port t --truth x"),
    (2, "ground", "wingsim demo -o ground"),
]


@pytest.fixture(scope="module")
def spoilt(demo: Path) -> Path:
    """Bad input beside the good."""
    config = (demo / "wingcap.toml").read_text()
    (demo / "bad_config.toml").write_text(config.replace("[disks]", "[disks]\ncolour = 1"))
    (demo / "no_calibration.toml").write_text(config.replace("ground/rig.json", "ground/none.json"))
    (demo / "bad_wing.toml").write_text((demo / "ground/wing.toml").read_text().replace("GJ = 59.3", "GJ = -59.3"))
    (demo / "empty").mkdir()
    shutil.copytree(demo / FLIGHT[0], demo / "cut")
    os.truncate(demo / "cut/left_0000.mcap", 2_000_000)
    return demo


@pytest.mark.parametrize(("code", "names", "command"), BAD_INPUT, ids=[row[2] for row in BAD_INPUT])
def test_bad_input_is_one_line_with_a_name_and_an_exit_code(spoilt, code, names, command):
    answer = run(spoilt, *command.split())
    assert "Traceback" not in answer.stderr
    *_, last = answer.stderr.strip().splitlines()
    assert last.startswith("error: ")
    assert names in last
    assert answer.returncode == code


def test_a_truncated_recording_still_gives_its_frames(spoilt, tmp_path):
    answer = run(spoilt, "wingproc", "markers", "cut", "--rig", "ground/rig.json", "-o", tmp_path / "m.parquet")
    assert answer.returncode == 0, answer.stderr
    assert "cut" in answer.stdout + answer.stderr
    table = pq.read_table(tmp_path / "m.parquet")
    assert 0 < table.num_rows < 18 * TRIGGERS
