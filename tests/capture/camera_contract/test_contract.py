"""What every camera backend promises the recorder (capture/camera/base.py), on each one's real software stack."""

import gc
import itertools
import re
import time

import pytest

from capture.camera import make_camera
from capture.camera.base import FrameStatus
from capture.errors import CameraError, CameraLost

SLOTS = 8
PERIOD_S = 0.05


def test_an_open_camera_says_what_it_is(bench):
    asked, camera = bench.harness.settings, bench.open()
    assert (camera.width, camera.height) == (asked.width, asked.height)
    assert camera.exposure_us == pytest.approx(asked.exposure_us, rel=0.02, abs=20)
    assert camera.gain_db == pytest.approx(asked.gain_db, abs=0.1)
    assert camera.model
    assert camera.serial
    assert camera.tick_hz > 0
    assert 8 <= camera.frame_id_bits <= 64
    temperature_c = bench.camera.temperature_c()
    assert temperature_c is None or -40 < temperature_c < 120


def test_frames_land_whole_in_the_buffers_given_and_nowhere_else(bench):
    camera = bench.start()
    grabs = []
    for _ in range(SLOTS):
        grabs.append(bench.frame(camera))
        time.sleep(PERIOD_S)
    assert sorted(grab.slot for grab in grabs) == list(range(SLOTS))
    for grab in grabs:
        assert (grab.status, grab.detail) == (FrameStatus.COMPLETE, "")
        assert bench.intact(grab.slot)
        assert set(bench.pixels(grab.slot)) != {0xA5}
        assert abs(time.time_ns() - grab.receive_ns) < 60e9


def test_each_frame_has_its_own_exposure_gain_and_count_where_the_camera_tells_them(bench):
    camera = bench.start()
    for index in range(SLOTS):
        grab = bench.frame(camera)
        told = bench.harness.facts(index)
        said = (grab.exposure_us, pytest.approx(grab.gain_db, nan_ok=True), grab.counter)
        assert said == (told or (camera.exposure_us, camera.gain_db, None))
        time.sleep(PERIOD_S)


def test_counter_and_clock_go_on_with_every_frame(bench):
    camera = bench.start()
    grabs = []
    for _ in range(5):
        grabs.append(bench.frame(camera))
        time.sleep(PERIOD_S)
    steps = [(b.frame_id - a.frame_id) % (1 << camera.frame_id_bits) for a, b in itertools.pairwise(grabs)]
    assert steps == [1] * 4
    ticks = [(b.device_ticks - a.device_ticks) / camera.tick_hz for a, b in itertools.pairwise(grabs)]
    assert all(0.5 * min(PERIOD_S, 1 / 60) < step for step in ticks)


def test_without_a_trigger_nothing_comes_and_a_camera_that_runs_free_says_so(bench):
    camera = bench.start()
    begin_s = time.monotonic()
    grab = bench.camera.grab(0.3)
    if camera.hardware_trigger:
        assert grab is None
        assert 0.25 < time.monotonic() - begin_s < 2.0
        bench.frame(camera)
    else:
        assert grab is not None, "it says that it runs free, but it does not"


def test_frames_without_a_buffer_are_lost_and_a_camera_that_counts_shows_it(bench):
    camera = bench.start(slots=2)
    grabs = []
    for _ in range(5):
        bench.expose(camera)
        time.sleep(PERIOD_S if camera.hardware_trigger else 2 * PERIOD_S)
    while (grab := bench.camera.grab(0.3)) is not None:
        grabs.append(grab)
    assert len(grabs) <= 2
    for grab in grabs:
        bench.camera.queue(grab.slot, bench.buffer(grab.slot))
    last = bench.frame(camera)
    step = (last.frame_id - grabs[-1].frame_id) % (1 << camera.frame_id_bits)
    assert step > 1 if camera.frame_counter else step == 1


def test_after_disarm_the_memory_is_ours_and_the_camera_can_be_armed_again(bench):
    camera = bench.start()
    bench.frame(camera)
    bench.camera.disarm()
    bench.camera.disarm()
    for slot in range(SLOTS):
        bench.wipe(slot)
    bench.expose(camera)
    time.sleep(4 * PERIOD_S)
    assert all(set(bench.ring.slot(slot)) == {0xA5} for slot in range(SLOTS))
    for slot in range(SLOTS):
        bench.camera.queue(slot, bench.buffer(slot))
    bench.camera.arm()
    for _ in range(3):
        assert bench.frame(camera).status is FrameStatus.COMPLETE


def test_a_closed_camera_can_be_opened_again(bench):
    first = bench.start()
    bench.frame(first)
    bench.camera.close()
    bench.camera.close()
    second = bench.start()
    assert second == first
    assert bench.frame(second).status is FrameStatus.COMPLETE


def test_memory_can_go_once_the_camera_is_closed(bench):
    camera = bench.start()
    bench.expose(camera)
    bench.camera.close()
    bench.ring = None
    gc.collect()
    bench.harness.trigger() if camera.hardware_trigger else time.sleep(PERIOD_S)
    time.sleep(PERIOD_S)


def test_a_camera_in_use_is_refused(bench):
    bench.start()
    second = bench.make()
    if bench.harness.exclusive:
        with pytest.raises(CameraError, match=re.escape(bench.harness.address.split("#")[-1])):
            second.open()
    else:
        second.open()
    second.close()


def test_where_no_camera_is_the_message_says_so(bench):
    address = bench.harness.missing_address
    with pytest.raises(CameraError, match=r"\w") as raised:
        make_camera(bench.harness.backend, address, bench.harness.settings).open()
    assert str(raised.value).startswith(address)


def test_wrong_settings_are_refused_with_number_and_remedy(bench):
    for changes, message in bench.harness.refused:
        camera = bench.make(**changes)
        with pytest.raises(CameraError, match=message):
            camera.open()
        camera.close()
    bench.frame(bench.start())  # and the camera is none the worse for it


def test_a_frame_lost_on_its_way_leaves_a_gap(bench):
    camera = bench.start()
    if "drop" not in bench.harness.faults:
        assert not camera.frame_counter, "its losses cannot be shown here, so it must not claim to count them"
        return
    first = bench.frame(camera)
    bench.harness.drop()
    if not camera.hardware_trigger:
        ids = [first.frame_id, *bench.ids_of(SLOTS)]
        assert max(b - a for a, b in itertools.pairwise(ids)) > 1
        return
    bench.expose(camera)
    assert bench.camera.grab(0.5) is None
    following = bench.frame(camera)
    assert (following.frame_id - first.frame_id) % (1 << camera.frame_id_bits) == 2


def test_a_frame_delivered_in_part_is_never_called_complete(bench):
    camera = bench.start()
    if "truncate" not in bench.harness.faults:
        assert bench.frame(camera).status is FrameStatus.COMPLETE
        return
    first = bench.frame(camera)
    bench.harness.truncate()
    bench.expose(camera)
    torn = bench.camera.grab(1.0)
    assert torn is None or (torn.status is FrameStatus.INCOMPLETE and torn.detail)
    if torn is not None:
        bench.camera.queue(torn.slot, bench.buffer(torn.slot))
    following = bench.frame(camera)
    assert following.status is FrameStatus.COMPLETE
    assert (following.frame_id - first.frame_id) % (1 << camera.frame_id_bits) == 2


def test_a_pulled_plug_is_told_and_the_camera_comes_back(bench):
    camera = bench.start()
    assert camera.tells_unplug == ("unplug" in bench.harness.faults)
    if not camera.tells_unplug:
        return
    bench.frame(camera)
    bench.harness.unplug()
    with pytest.raises(CameraLost, match=r"check|running"):
        bench.grab_until_lost()
    bench.camera.queue(0, bench.buffer(0))
    bench.camera.disarm()
    bench.camera.close()
    with pytest.raises(CameraError):
        bench.camera.open()
    bench.harness.plug()
    assert bench.start().serial == camera.serial
    for _ in range(3):
        assert bench.frame(camera).status is FrameStatus.COMPLETE
