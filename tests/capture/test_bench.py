"""The benchmark's books, not its speed: rows add up, bad options are refused, the model shows what the paper saw."""

import json

import pytest

from capture.bench import BoundedDisk, bench_cases, bench_target, run_case
from capture.bench_rig import BenchCase
from capture.errors import UsageError


@pytest.mark.parametrize("mode", ["monolithic", "ring", "threaded"])
def test_a_row_accounts_for_every_frame(tmp_path, mode):
    case = BenchCase(mode, 64, 48, 100.0, 30)
    row = run_case(case, tmp_path / "bench", BoundedDisk(), lambda done: None)
    assert row.frames == 120
    assert 0 <= row.dropped <= 120
    assert row.dropped_percent == pytest.approx(100 * row.dropped / 120)
    assert row.offered_mb_s == pytest.approx(4 * 64 * 48 * 100 / 1e6)
    assert len(row.latencies_ms) == 120 - row.dropped
    assert row.write_ms["p50"] <= row.write_ms["p99"] <= row.write_ms["max"]


def test_cases_from_words():
    assert [(c.mode, c.width, c.height, c.frames) for c in bench_cases("threaded", "paper", 25, 0)] == [
        ("threaded", 2080, 1552, 500),
        ("threaded", 1920, 1080, 500),
    ]
    for mode, size in (("fast", "64x48"), ("all", "64"), ("all", "axb"), ("all", "1x1")):
        with pytest.raises(UsageError, match="--"):
            bench_cases(mode, size, 25, 10)
    with pytest.raises(UsageError, match="no such folder"), bench_target("/no/such/folder"):
        pass


def test_the_command_prints_json_and_a_plot(tmp_path, wingcap):
    words = ("bench", "--target", tmp_path, "--size", "64x48", "--frames", 20, "--rate", 100, "--ceiling")
    answer = wingcap(*words, "--mode", "threaded", "--json", "--plot", tmp_path / "bench.png")
    found = json.loads(answer.stdout)
    assert [row["mode"] for row in found["rows"]] == ["threaded"]
    assert {"mb_s", "raw_direct_mb_s", "ratio"} <= set(found["ceiling"])
    assert len(found["ceiling"]["pairs"]) >= 9
    assert (tmp_path / "bench.png").stat().st_size > 1000
    assert list(tmp_path.iterdir()) == [tmp_path / "bench.png"]


@pytest.mark.slow
def test_on_a_disk_with_stalls_the_papers_way_drops_frames_and_ours_does_not(wingcap):
    """Stalls and images are those of a flight; the modelled disk costs no CPU, so this holds on a slow machine too."""
    answer = wingcap("bench", "--target", "model", "--frames", 300, "--json", timeout=300)
    dropped = {row["mode"]: row["dropped"] for row in json.loads(answer.stdout)["rows"]}
    assert dropped["monolithic"] > 0
    assert dropped["threaded"] == 0
