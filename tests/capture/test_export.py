"""A copy is whole and checked by another program, an interrupted one goes on, and the source is never touched."""

import hashlib
import json
import os
import subprocess

import pytest

from capture.errors import CaptureError, DiskError, RecordingError, UsageError
from capture.export import export_flight
from capture.lock import sole_recorder


@pytest.fixture
def flight(tmp_path):
    """Two disks with a flight's folders on them; bytes from the system, since the copy must not care."""
    folders = []
    for side in ("left", "right"):
        folder = tmp_path / f"ssd_{side}" / "flight_7"
        folder.mkdir(parents=True)
        for name, size in ((f"{side}_0000.mcap", 20_000_000), (f"{side}_0001.mcap", 1), ("aux_0000.mcap", 0)):
            (folder / name).write_bytes(os.urandom(size))
        (folder / "metadata.yaml").write_text("rosbag2\n")
        folders.append(folder)
    (tmp_path / "out").mkdir()
    return folders


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_copy_is_the_flight_and_sha256sum_agrees(flight, tmp_path):
    before = [contents(folder) for folder in flight]
    stamps = [path.stat().st_mtime_ns for folder in flight for path in sorted(folder.iterdir())]
    done = []
    result = export_flight(flight, tmp_path / "out", done.append)
    out = tmp_path / "out/flight_7"
    assert [contents(out / f"ssd_{side}") for side in ("left", "right")] == before
    assert (result.files, result.kept, result.bytes) == (8, 0, 2 * (20_000_001 + 8))
    assert sum(done) == 2 * result.bytes  # written, and read back
    command = ["sha256sum", "--check", "--strict", "SHA256SUMS"]
    checked = subprocess.run(command, cwd=out, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout.count(": OK") == 8
    assert [contents(folder) for folder in flight] == before
    assert [path.stat().st_mtime_ns for folder in flight for path in sorted(folder.iterdir())] == stamps
    again = export_flight(flight, tmp_path / "out")
    assert (again.files, again.kept) == (0, 8)


@pytest.mark.parametrize("spoil", ["cut", "other bytes", "too long"])
def test_an_interrupted_copy_goes_on(flight, tmp_path, spoil):
    source = flight[0] / "left_0000.mcap"
    part = tmp_path / "out/flight_7/ssd_left/left_0000.mcap.part"
    part.parent.mkdir(parents=True)
    data = source.read_bytes()
    begun = {"cut": data[:9_000_000], "other bytes": os.urandom(9_000_000), "too long": data + b"more"}[spoil]
    part.write_bytes(begun)
    export_flight(flight, tmp_path / "out")
    assert (tmp_path / "out/flight_7/ssd_left/left_0000.mcap").read_bytes() == data
    assert not list((tmp_path / "out").rglob("*.part"))


def test_a_source_that_was_recovered_since_is_copied_again(flight, tmp_path):
    export_flight(flight, tmp_path / "out")
    (flight[0] / "left_0001.mcap").write_bytes(b"!")
    assert export_flight(flight, tmp_path / "out").files == 1
    assert (tmp_path / "out/flight_7/ssd_left/left_0001.mcap").read_bytes() == b"!"


def test_a_disk_that_lies_is_found_out(flight, tmp_path, monkeypatch):
    """What is read back differs from what was written."""
    import capture.export

    monkeypatch.setattr(capture.export, "_digest", lambda file, progress: hashlib.sha256(b"rot").hexdigest())
    with pytest.raises(DiskError, match="does not read back as it was written"):
        export_flight(flight, tmp_path / "out")
    assert not (tmp_path / "out/flight_7/SHA256SUMS").exists()
    assert not list((tmp_path / "out").rglob("*.mcap"))


def test_refusals(flight, tmp_path, monkeypatch):
    other = tmp_path / "ssd_left/flight_8"
    other.mkdir()
    (other / "left_0000.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match="different flights"):
        export_flight([*flight, other], tmp_path / "out")
    with pytest.raises(UsageError, match="no such folder"):
        export_flight(flight, tmp_path / "nowhere")
    with pytest.raises(UsageError, match="within the flight"):
        export_flight(flight, flight[0])
    with pytest.raises(UsageError, match="is the flight itself"):
        export_flight(flight, flight[0].parent)
    with sole_recorder([flight[1].parent]), pytest.raises(CaptureError, match="must not be slowed down"):
        export_flight(flight, tmp_path / "out")
    monkeypatch.setattr("capture.export.shutil.disk_usage", lambda path: type("Usage", (), {"free": 1000}))
    with pytest.raises(DiskError, match=r"needs 0\.11 GB, 0\.00 GB are free"):
        export_flight(flight, tmp_path / "out")


def test_the_command(flight, tmp_path, wingcap):
    done = wingcap("export", *flight, "--out", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["files_copied"] == 8
    again = wingcap("export", *flight, "--out", tmp_path / "out")
    assert "8 files were there already" in again.stdout
