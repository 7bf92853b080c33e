"""V4L2 through a real kernel into a certified recording: vivid drops buffers, and each is a loss in the books."""

import itertools

import pytest
from mcap.reader import make_reader
from vm import run_in_vm

from capture.record import Frame
from capture.verify import inspect

pytestmark = pytest.mark.slow
RATE_HZ, PERIODS, DROPPED_PERCENT = 10, 150, 20
PLACE = "left/cam0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What was recorded of vivid, which runs free; the clock stands in for the trigger board."""
    address = f"/dev/video0?exposure=fixed&fps={RATE_HZ}&percentage_of_dropped_buffers={DROPPED_PERCENT}"
    script = f"""
modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=0x0
until [ -e /dev/video0 ]; do sleep 0.1; done
python - <<'END'
from pathlib import Path
from capture.camera.base import CameraSettings
from free_run import record_free_running
settings = CameraSettings(320, 180, 2000, 0.0)
record_free_running("v4l2", {{("left", "cam0"): "{address}"}}, settings, {RATE_HZ}, {PERIODS}, Path("vivid"))
END
cp -r vivid /artifacts/vivid
"""
    return run_in_vm(script, tmp_path_factory.mktemp("vivid"), timeout_s=150).artifacts / "vivid"


def test_dropped_buffers_are_losses_with_a_stage(folder):
    report = inspect([folder])
    assert report.problems == []
    camera = report.cameras[PLACE]
    assert camera.recorded + len(camera.lost_indices) == PERIODS
    ids = {}
    for path in folder.glob("left/left_*.mcap"):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                if channel.topic.endswith("/frame"):
                    ids[message.sequence] = Frame.decode(message.data).device_frame_id
    assert len({frame_id - index for index, frame_id in ids.items()}) == 1, "the driver's count and ours go together"
    gaps = [i for a, b in itertools.pairwise(sorted(ids)) for i in range(a + 1, b)]
    assert {i for i, loss in camera.lost_indices.items() if loss.stage == "usb"} == set(gaps)
    # Each is dropped with this probability, three standard deviations of a binomial's share; on a busy machine the
    # guest's driver is late, and drops some of its own: they are in its count, and so in the gaps above.
    share, sigma = len(gaps) / PERIODS, (0.2 * 0.8 / PERIODS) ** 0.5
    assert -3 * sigma < share - DROPPED_PERCENT / 100 < 6 * sigma
