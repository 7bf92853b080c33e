"""The recorder end to end on a rig of fakes: what was shown is in the files, what was lost is booked, byte for byte."""

import errno
import queue
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from capture.clock import SystemClock
from capture.config import DiskConfig, load_config
from capture.daemon import Recording, RecordingResult
from capture.disk import SystemDisk
from capture.errors import CameraError, TriggerBoardError, UsageError
from capture.grabber import Grabber
from capture.ledger import Ledger
from capture.recorder import AUX_QUEUE, FrameItem, Recorder
from capture.recover import recover_flight
from capture.ring import PAGE, Ring
from capture.segment import SmallMessage
from capture.stop_rule import StopRule
from capture.trigger import TriggerBoard
from capture.verify import inspect

TRIGGERS = 25


def record(config: Path, triggers: int = TRIGGERS) -> RecordingResult:
    return Recording(load_config(config), SystemClock(), SystemDisk(), lambda _: None).run(
        StopRule(threading.Event(), triggers)
    )


def frames_of(folder: Path) -> dict[tuple[str, int], bytes]:
    """Pixels by camera and trigger, through the stock readers."""
    frames = {}
    for path in sorted(folder.glob("*_*.mcap")):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, message, image in reader.iter_decoded_messages():
                if channel.topic.endswith("image_raw"):
                    assert (image.height, image.width, image.encoding) == (48, 64, "mono8")
                    frames[image.header.frame_id, message.sequence] = bytes(image.data)
    return frames


def messages_of(path: Path, topic: str) -> list:
    """Decoded messages of a small topic."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [message for _, _, _, message in reader.iter_decoded_messages(topics=[topic])]


def test_every_frame_shown_is_recorded_with_its_own_content(write_config, rig, tmp_path, pixels_of):
    result = record(write_config())
    assert (result.triggers, result.recorded, result.lost, result.failures) == (TRIGGERS, 4 * TRIGGERS, 0, [])
    frames = frames_of(tmp_path / "ssd_left/test") | frames_of(tmp_path / "ssd_right/test")
    assert len(frames) == 4 * TRIGGERS
    for (camera, index), pixels in frames.items():
        assert pixels == pixels_of(camera, index).tobytes()
    report = inspect([tmp_path])
    assert report.problems == []
    assert (report.triggers, report.recorded, report.lost) == (TRIGGERS, 4 * TRIGGERS, 0)


def test_faults_are_booked_at_their_stage_and_the_certificate_holds(write_config, rig, tmp_path, pixels_of):
    rig.missed = {("left_cam0", 0), ("left_cam0", 5), ("left_cam0", 6), ("left_cam1", 24)}
    rig.undelivered = {("left_cam1", 7), ("left_cam1", 8)}
    rig.incomplete = {("right_cam0", 9)}
    rig.repeated = {("right_cam1", 10)}
    result = record(write_config(rate_hz=50))
    lost = {"/".join(place): account.lost for place, account in result.accounts.items()}
    assert lost == {
        "left/cam0": {"camera": 3},
        "left/cam1": {"usb": 2, "camera": 1},
        "right/cam0": {"usb": 1},
        "right/cam1": {},
    }
    assert all(account.balanced for account in result.accounts.values())
    report = inspect([tmp_path])
    assert report.problems == []
    assert {
        (name, index) for name, camera in report.cameras.items() for index in camera.lost_indices
    } == {
        ("left/cam0", 0), ("left/cam0", 5), ("left/cam0", 6), ("left/cam1", 24), ("left/cam1", 7), ("left/cam1", 8),
        ("right/cam0", 9),
    }  # fmt: skip
    for (camera, index), pixels in frames_of(tmp_path / "ssd_left/test").items():
        assert pixels == pixels_of(camera, index).tobytes()


def test_losses_of_one_side_are_on_the_other_disk_too(write_config, rig, tmp_path):
    rig.missed = {("left_cam0", 3)}
    record(write_config())
    report = inspect([tmp_path / "ssd_right"])
    assert set(report.cameras["left/cam0"].lost_indices) == {3}


def test_an_unplugged_camera_leaves_the_others_without_a_gap(write_config, rig, tmp_path):
    rig.unplugged_at = {"right_cam1": 10}
    result = record(write_config())
    accounts = {"/".join(place): (account.recorded, account.lost_total) for place, account in result.accounts.items()}
    assert accounts.pop("right/cam1") == (10, TRIGGERS - 10)
    assert set(accounts.values()) == {(TRIGGERS, 0)}
    assert "right/cam1: unplugged: check its cable; its last frame was of trigger 9" in result.failures[0]
    report = inspect([tmp_path])
    assert report.problems == []
    assert set(report.cameras["right/cam1"].lost_indices) == set(range(10, TRIGGERS))


def test_a_driver_that_refuses_a_buffer_is_begun_with_anew(write_config, rig, tmp_path, pixels_of, monkeypatch):
    real, calls = Grabber._queue, []

    def queue_slot(self, slot):
        if self.place != ("right", "cam1"):
            return real(self, slot)
        calls.append(slot)
        if len(calls) == 60:
            camera = rig.cameras["right_cam1"]
            camera._armed, camera._buffers, camera._done = False, queue.SimpleQueue(), queue.SimpleQueue()
            raise CameraError("the driver refuses a buffer")
        return real(self, slot)

    monkeypatch.setattr(Grabber, "_queue", queue_slot)
    result = record(write_config(), triggers=150)
    assert result.failures == []
    accounts = {"/".join(place): account for place, account in result.accounts.items()}
    came_back = accounts.pop("right/cam1")
    assert came_back.recorded > 60
    assert set(came_back.lost) <= {"camera", "usb"}  # no frame at hand was lost for it
    assert all(account.lost_total == 0 for account in accounts.values())
    report = inspect([tmp_path])
    assert report.problems == []
    assert "refuses a buffer" in {loss.cause for loss in report.cameras["right/cam1"].lost_indices.values()}.pop()
    frames = frames_of(tmp_path / "ssd_right/test")
    assert all(pixels == pixels_of(camera, index).tobytes() for (camera, index), pixels in frames.items())


def test_small_messages_of_a_disk_that_hangs_leave_the_frames_their_room(tmp_path):
    ledger = Ledger([("left", "cam0")], 0, lambda: 0, lambda loss: None)
    parts = ("left", tmp_path, ["cam0"], (48, 64), DiskConfig(left=tmp_path, right=tmp_path / "b", reserve_mb=0))
    recorder = Recorder(*parts, SystemDisk(), {}, ledger, SystemClock(), queue_bound=20)
    ring = Ring(20, PAGE, lock_memory=False)
    message = SmallMessage(1, 0, 0, 0, b"")
    for _ in range(AUX_QUEUE + 50):
        recorder.put_aux((message,))
    for slot in range(20):
        recorder.put(FrameItem(("left", "cam0"), slot, ring, slot, None))
    assert recorder.aux_dropped == 50
    assert recorder.step(wait_s=0.0)
    recorder.put_aux((message,))
    assert recorder.aux_dropped == 50
    recorder.close([], {})


def test_a_camera_that_comes_back_is_tied_to_its_triggers_again(write_config, rig, tmp_path, pixels_of):
    rig.unplugged_at, rig.replugged_at = {"right_cam1": 10}, {"right_cam1": 70}
    result = record(write_config(), triggers=200)
    accounts = {"/".join(place): account for place, account in result.accounts.items()}
    back = accounts.pop("right/cam1")
    assert back.lost.keys() == {"camera"}
    assert 60 <= back.lost_total <= 150  # looked for every half second, which is 50 triggers
    assert {(account.recorded, account.lost_total) for account in accounts.values()} == {(200, 0)}
    assert result.failures == []
    (absence,) = result.absences["right", "cam1"]
    assert absence.end_ns - absence.begin_ns > 0.55e9
    report = inspect([tmp_path])
    assert report.problems == []
    lost = set(report.cameras["right/cam1"].lost_indices)
    assert lost == set(range(10, 10 + len(lost)))
    for (camera, index), pixels in frames_of(tmp_path / "ssd_right/test").items():
        assert pixels == pixels_of(camera, index).tobytes()
    marks = messages_of(tmp_path / "ssd_left/test/aux_0000.mcap", "/gate")
    begin, end = (mark for mark in marks if mark.name == "camera right/cam1")
    assert (begin.begin_ns, begin.end_ns) == (end.begin_ns, 0)
    assert (end.begin_ns, end.end_ns) == pytest.approx((absence.begin_ns, absence.end_ns), rel=0, abs=1e8)
    losses = messages_of(tmp_path / "ssd_left/test/aux_0000.mcap", "/loss")
    assert all("its last frame was of trigger 9" in loss.cause for loss in losses)


@pytest.mark.parametrize("silent", ["left_cam0", "left_cam1"])
def test_a_silent_camera_does_not_take_its_partner_s_room(write_config, rig, tmp_path, silent):
    """Its trigger cable is broken, say: it is there, and gives nothing."""
    rig.missed = {(silent, index) for index in range(5, 300)}
    result = record(write_config(), triggers=300)
    lost = {"/".join(place): account.lost for place, account in result.accounts.items()}
    assert lost.pop(silent.replace("_", "/")) == {"camera": 295}
    assert set(map(str, lost.values())) == {"{}"}
    assert inspect([tmp_path]).problems == []


def test_a_camera_that_is_gone_for_long_does_not_starve_the_other_of_its_side(write_config, rig, tmp_path):
    """Slots that were promised to it are free again: more triggers follow than the ring has slots."""
    rig.unplugged_at = {"right_cam1": 10}
    rig.missed = {("left_cam0", index) for index in range(10, 200)}
    result = record(write_config(rate_hz=100), triggers=200)
    recorded = {"/".join(place): account.recorded for place, account in result.accounts.items()}
    assert recorded == {"left/cam0": 10, "left/cam1": 200, "right/cam0": 200, "right/cam1": 10}


def test_silent_and_garbled_pulses_do_not_move_the_numbering(write_config, rig, tmp_path, pixels_of):
    rig.silent_pulses = {6}
    rig.garbled_pulses = {12}
    result = record(write_config(rate_hz=50))
    assert (result.recorded, result.lost) == (4 * TRIGGERS, 0)
    for (camera, index), pixels in frames_of(tmp_path / "ssd_left/test").items():
        assert pixels == pixels_of(camera, index).tobytes()
    report = inspect([tmp_path])
    assert report.problems == []
    assert report.notes == ["2 triggers were not reported by the board: their times are interpolated"]


def test_segments_rotate_without_a_lost_frame(write_config, rig, tmp_path):
    result = record(write_config(disks="segment_mb = 0.1"))
    assert result.lost == 0
    assert len(list((tmp_path / "ssd_left/test").glob("left_*.mcap"))) > 3
    assert inspect([tmp_path]).problems == []


def test_a_full_disk_ends_its_side_only(write_config, rig, tmp_path, monkeypatch):
    real = __import__("os").statvfs

    def statvfs(path):
        found = real(path)
        if "ssd_left" not in str(path):
            return found
        return type("Space", (), {"f_bavail": 0, "f_frsize": found.f_frsize})

    monkeypatch.setattr("capture.disk.os.statvfs", statvfs)
    result = record(write_config())
    lost = {"/".join(place): account.lost for place, account in result.accounts.items()}
    assert lost["left/cam0"] == {"disk": TRIGGERS}
    assert lost["right/cam0"] == lost["right/cam1"] == {}
    assert "free" in result.failures[0]


def test_the_other_disk_takes_over_where_configured(write_config, rig, tmp_path, monkeypatch, pixels_of):
    real, writes = SystemDisk.create, []

    def create(self, path, mode, preallocate_bytes):
        file = real(self, path, mode, preallocate_bytes)
        if path.name == "left_0000.mcap":
            write = file.write

            def failing(data):
                writes.append(1)
                if len(writes) > 12:
                    raise OSError(errno.EIO, "Input/output error")
                return write(data)

            file.write = failing
        return file

    monkeypatch.setattr(SystemDisk, "create", create)
    result = record(write_config(disks="takeover = true"))
    assert (result.recorded, result.lost) == (4 * TRIGGERS, 0)
    assert "Input/output error" in result.failures[0]
    assert (tmp_path / "ssd_right/test/left_0001.mcap").exists()
    monkeypatch.undo()
    recover_flight([tmp_path / "ssd_left", tmp_path / "ssd_right"], tmp_path / "copy")
    assert inspect([tmp_path / "copy"]).recorded == 4 * TRIGGERS
    frames = frames_of(tmp_path / "copy/0_test") | frames_of(tmp_path / "copy/1_test")
    assert all(pixels == pixels_of(camera, index).tobytes() for (camera, index), pixels in frames.items())


def test_a_disk_that_stalls_for_two_seconds_loses_nothing(write_config, rig, tmp_path, monkeypatch):
    real, stalled = SystemDisk.create, []

    def create(self, path, mode, preallocate_bytes):
        file = real(self, path, mode, preallocate_bytes)
        write = file.write

        def stalling(data):
            if path.name == "left_0000.mcap" and len(data) > 4096 and len(stalled) == 9:
                time.sleep(2.0)
            stalled.append(path.name) if path.name == "left_0000.mcap" else None
            return write(data)

        file.write = stalling
        return file

    monkeypatch.setattr(SystemDisk, "create", create)
    config = write_config(rate_hz=25)
    config.write_text(config.read_text().replace("stall_s = 0.5", "stall_s = 2.0"))
    result = record(config, triggers=75)
    assert (result.recorded, result.lost) == (300, 0)
    assert max(result.ring_high_water.values()) > 45
    assert inspect([tmp_path]).problems == []


@pytest.mark.parametrize("write", ["auto", "buffered"])
def test_rosbags_opens_the_flight_folder(write_config, rig, tmp_path, pixels_of, write):
    record(write_config(disks=f'write = "{write}"'), triggers=5)
    with AnyReader([tmp_path / "ssd_right/test"]) as reader:
        topics = {connection.topic for connection in reader.connections}
        assert {"/right/cam0/image_raw", "/right/cam1/frame", "/trigger", "/diagnostics"} <= topics
        images = [connection for connection in reader.connections if connection.topic == "/right/cam0/image_raw"]
        seen = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections=images)]
    assert len(seen) == 5
    for index, image in enumerate(seen):
        assert np.array_equal(image.data, pixels_of("right_cam0", index))


def test_a_flight_is_never_written_over(write_config, rig):
    config = write_config()
    record(config, triggers=3)
    with pytest.raises(UsageError, match="exists already"):
        record(config, triggers=3)


def test_a_swapped_camera_is_refused(write_config, rig):
    config = write_config()
    config.write_text(config.read_text().replace('address = "left_cam0"', 'address = "left_cam0"\nserial = "other"'))
    with pytest.raises(CameraError, match="left/cam0: serial serial-left_cam0 answers"):
        record(config)


def test_a_missing_board_is_one_line(write_config, rig):
    config = write_config()
    config.write_text(config.read_text().replace(rig.port, "/dev/no-such-port"))
    with pytest.raises(TriggerBoardError, match="/dev/no-such-port"):
        record(config)


def test_pulses_of_the_recording_before_are_not_ours(write_config, rig, tmp_path):
    """A board that still runs for a recorder that was killed, far ahead in its index."""
    rig.board.next_index = 5000
    rig.pulse_before_stop = True
    result = record(write_config())
    assert (result.triggers, result.recorded, result.lost, result.failures) == (TRIGGERS, 4 * TRIGGERS, 0, [])
    assert inspect([tmp_path]).problems == []


def test_a_last_pulse_that_is_not_reported_does_not_keep_us_waiting(write_config, rig, tmp_path):
    rig.silent_pulses = {TRIGGERS - 1}
    result = record(write_config())
    assert (result.triggers, result.recorded, result.lost, result.failures) == (TRIGGERS, 4 * TRIGGERS, 0, [])
    assert len(inspect([tmp_path]).notes) == 1


def test_a_board_that_stops_by_itself_is_said_and_everything_is_closed(write_config, rig, tmp_path):
    threading.Timer(1.5, lambda: setattr(rig.board, "running", False)).start()
    result = record(write_config(), triggers=1000)
    assert "stopped by itself" in result.failures[0]
    assert result.lost == 0
    assert inspect([tmp_path]).problems == []


def test_the_board_serves_one_recorder_at_a_time(rig):
    first = TriggerBoard(rig.port, SystemClock(), lambda pulse, trigger: None)
    try:
        with pytest.raises(TriggerBoardError, match="no other recorder"):
            TriggerBoard(rig.port, SystemClock(), lambda pulse, trigger: None)
    finally:
        first.close()


def test_whatever_goes_wrong_in_flight_the_files_are_closed(write_config, rig, tmp_path):
    calls = []

    def progress(text: str) -> None:
        calls.append(text)
        if len(calls) == 3:
            raise RuntimeError("a bug")

    config = load_config(write_config())
    result = Recording(config, SystemClock(), SystemDisk(), progress).run(StopRule(threading.Event(), 1000))
    assert "a bug" in result.failures[0]
    assert result.recorded > 0
    assert inspect([tmp_path]).problems == []


def test_every_segment_and_its_recovered_copy_carry_the_calibration(write_config, rig, tmp_path):
    (tmp_path / "rig.json").write_text('{"format": "any"}')
    path = write_config(disks="segment_mb = 0.1", top='calibration = "rig.json"')
    loaded = load_config(path)
    (tmp_path / "rig.json").unlink()  # what happens to the file in flight does not matter
    result = Recording(loaded, SystemClock(), SystemDisk(), lambda _: None).run(StopRule(threading.Event(), TRIGGERS))
    assert (result.recorded, result.failures) == (4 * TRIGGERS, [])
    recover_flight([tmp_path / "ssd_left", tmp_path / "ssd_right"], tmp_path / "copy")
    segments = [*tmp_path.glob("ssd_*/test/*_0*.mcap"), *tmp_path.glob("copy/*/*_0*.mcap")]
    assert len(segments) > 10
    for segment in segments:
        if segment.name.startswith("aux"):
            continue
        with segment.open("rb") as file:
            (attachment,) = make_reader(file).iter_attachments()
        assert (attachment.name, attachment.data) == ("rig.json", b'{"format": "any"}')
