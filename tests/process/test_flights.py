"""Which folders are one flight: as they lie on the aircraft's disks, after an export, damaged, and by others."""

from pathlib import Path

import pytest
from mcap.writer import Writer

from process.flights import find_flights


def record(folder: Path, flight: str = "", flight_id: str = "", side: str = "left") -> Path:
    """A folder with the first file of a recording; of another recorder without a name."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{side}_0000.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        if flight:
            writer.add_metadata("wingshape", {"flight": flight, "flight_id": flight_id or f"{flight}-1a"})
        writer.finish()
    return folder


@pytest.fixture
def disks(tmp_path: Path) -> tuple[Path, Path]:
    """Two flights on the aircraft's two disks."""
    for flight in ("F1", "F2"):
        for side in ("left", "right"):
            record(tmp_path / f"ssd_{side}" / flight, flight, side=side)
    return tmp_path / "ssd_left", tmp_path / "ssd_right"


def found(*paths: Path) -> dict[str, list[Path]]:
    return {flight.name: list(flight.paths) for flight in find_flights(paths)}


def test_folders_of_one_flight_are_one_however_they_lie(disks, tmp_path):
    left, right = disks
    assert found(left / "F1", right / "F1") == {"F1": [left / "F1", right / "F1"]}
    renamed = (left / "F1").rename(tmp_path / "monday")
    assert found(renamed, right / "F1") == {"F1": [renamed, right / "F1"]}


@pytest.mark.parametrize("whole", [True, False])
def test_several_flights(disks, whole):
    left, right = disks
    paths = (left, right) if whole else (left / "F1", right / "F1", left / "F2", right / "F2")
    assert found(*paths) == {name: [left / name, right / name] for name in ("F1", "F2")}


@pytest.mark.parametrize("whole", [True, False])
def test_as_exported(tmp_path, whole):
    for flight in ("F1", "F2"):
        for side in ("left", "right"):
            record(tmp_path / flight / f"ssd_{side}", flight, side=side)
    paths = (tmp_path,) if whole else (tmp_path / "F1", tmp_path / "F2")
    expected = {name: [tmp_path / name / f"ssd_{side}" for side in ("left", "right")] for name in ("F1", "F2")}
    assert found(*paths) == expected


def test_what_a_damaged_file_does_not_tell_its_folders_name_does(disks):
    left, right = disks
    (left / "F2/left_0000.mcap").write_bytes(bytes(1000))
    assert found(*disks) == {name: [left / name, right / name] for name in ("F1", "F2")}
    (right / "F2/left_0000.mcap").unlink(missing_ok=True)
    (right / "F2/right_0000.mcap").write_bytes(b"nothing")
    assert found(*disks) == {name: [left / name, right / name] for name in ("F1", "F2")}


def test_a_path_without_a_recording_is_a_flight_that_will_fail(disks, tmp_path):
    (tmp_path / "notes").mkdir()
    assert list(found(*disks, tmp_path / "notes")) == ["F1", "F2", "notes"]
    assert found(tmp_path / "notes") == {"notes": [tmp_path / "notes"]}


def test_flights_of_one_name_are_told_apart(tmp_path):
    """A clock that was never set gives the same names after every start."""
    record(tmp_path / "monday/F1", "F1", "F1-1a")
    record(tmp_path / "tuesday/F1", "F1", "F1-2b")
    assert found(tmp_path / "monday", tmp_path / "tuesday") == {
        "F1": [tmp_path / "monday/F1"],
        "F1-2b": [tmp_path / "tuesday/F1"],
    }


def test_another_recorders_folders_are_one_flight(tmp_path):
    paths = (record(tmp_path / "a"), record(tmp_path / "b", side="right"))
    assert found(*paths) == {"a": list(paths)}


def test_a_recorded_name_cannot_lead_out_of_the_folder(tmp_path):
    record(tmp_path / "a", "../../etc/x", "1")
    record(tmp_path / "b", "..", "2")
    assert all("/" not in name and not name.startswith(".") for name in found(tmp_path / "a", tmp_path / "b"))
