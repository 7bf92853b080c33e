"""What was cut is found at the next start, and left alone."""

import time

from capture.unfinished import AfterPower, find_unfinished, flights_on, report

MAGIC = b"\x89MCAP0\r\n"  # from the format's specification


def flight(disk, name, *, closed: bool, files=("left_0000", "left_0001", "aux_0000")):
    folder = disk / name
    folder.mkdir(parents=True)
    for number, file in enumerate(files):
        last = number == len(files) - 1
        (folder / f"{file}.mcap").write_bytes(MAGIC + b"content" + (MAGIC if closed or not last else b""))
    return folder


def test_only_what_was_not_closed_is_found(tmp_path):
    flight(tmp_path / "left", "good", closed=True)
    cut = flight(tmp_path / "left", "cut", closed=False)
    empty = flight(tmp_path / "right", "empty", closed=True, files=())
    (empty / "left_0000.mcap").write_bytes(b"")
    (found, other) = find_unfinished(flights_on([tmp_path / "left", tmp_path / "right", tmp_path / "missing"]))
    assert (found.folder, found.files, found.size_bytes) == (cut, ("aux_0000.mcap",), len(MAGIC) + 7)
    assert (other.folder, other.size_bytes) == (empty, 0)


def test_the_report_names_a_few_and_says_what_to_do(tmp_path):
    for k in range(7):
        flight(tmp_path, f"cut_{k}", closed=False)
    said = report(find_unfinished(flights_on([tmp_path])))
    assert said.startswith("7 folders hold a recording that was cut")
    assert "cut_4" in said
    assert "cut_5" not in said
    assert "and 2 more" in said
    assert "`wingcap recover`" in said


def test_a_recording_is_told_beside_and_the_new_flight_is_not_meant(tmp_path):
    before = flight(tmp_path, "before", closed=False)
    contents = {path: path.read_bytes() for path in before.iterdir()}
    companion = AfterPower([tmp_path])
    flight(tmp_path, "now", closed=False)  # the one that begins
    companion.start(lambda topic, time_ns, data: None)
    deadline_s = time.monotonic() + 10.0
    while not companion.statuses():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    companion.stop()
    companion.stop()
    (status,) = companion.statuses()
    assert status.level == 1
    assert "1 folders" in status.message
    assert {path: path.read_bytes() for path in before.iterdir()} == contents
