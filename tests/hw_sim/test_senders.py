"""The simulated aircraft's other data, decoded by the libraries that know the formats, against the state it is in."""

import time
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from needs import needs_module

from capture.clock import SystemClock
from capture.errors import SimulationError, UsageError
from hw_sim.aircraft import AIRSPEED_MPS, Aircraft
from hw_sim.autopilot import Autopilot
from hw_sim.can_node import CanNode, dbc_text
from hw_sim.wing_motion import WingMotion
from hw_sim.world import World

WORLD = World.make(1, scale=8)


class Stopped(SystemClock):
    """A clock that the test sets."""

    now_ns = 0

    def utc_ns(self) -> int:
        return self.now_ns


def test_the_load_factor_goes_with_the_wings_bending():
    times_ns = WORLD.epoch_ns + np.arange(0, 60_000_000_000, 20_000_000, dtype=np.int64)
    state = Aircraft(WORLD).at(times_ns)
    tips = [
        WingMotion(WORLD, side, np.array([WORLD.wing.half_span_m])).points(times_ns[:, None])[:, 0, 2]
        for side in ("left", "right")
    ]
    # The tip also follows the second bending and the twist, by a few millimetres of its 30 cm.
    assert np.corrcoef(np.mean(tips, axis=0), state.load_factor)[0, 1] > 0.995
    assert 0.9 < state.load_factor.mean() < 1.1
    assert state.load_factor.max() - state.load_factor.min() > 0.3
    assert abs(state.airspeed_mps.mean() - AIRSPEED_MPS) < 0.5


def test_frames_decode_by_the_dbc_to_the_state(tmp_path):
    node = CanNode(Aircraft(WORLD), f"slcan:{tmp_path / 'can'}", SystemClock())
    node.start()
    database = cantools.database.load_string(dbc_text(), "dbc")
    begin_s = time.monotonic()
    decoded: dict[str, list[tuple[float, float]]] = {}
    with can.Bus(interface="slcan", channel=str(tmp_path / "can"), bitrate=500000, sleep_after_open=0.0) as bus:
        while time.monotonic() - begin_s < 1.0:
            message = bus.recv(0.1)
            assert message is not None
            for name, value in database.decode_message(message.arbitration_id, message.data).items():
                decoded.setdefault(name, []).append((message.timestamp, value))
    node.close()
    assert node.error is None
    assert not (tmp_path / "can").exists()
    steps = np.diff([value for _, value in decoded["inertial_counter"]]) % 256
    assert set(steps) == {1}
    for name, attribute, sign, resolution in (
        ("load_factor", "load_factor", 1, 0.001), ("airspeed", "airspeed_mps", 1, 0.01),
        ("altitude", "altitude_m", 1, 0.1), ("roll", "roll_rad", 1, 1e-4), ("pitch", "pitch_rad", 1, 1e-4),
        ("elevator", "elevator_deg", 1, 0.01), ("aileron_right", "aileron_deg", 1, 0.01),
        ("aileron_left", "aileron_deg", -1, 0.01),
    ):  # fmt: skip
        times_s, values = np.array(decoded[name]).T
        truth = sign * getattr(Aircraft(WORLD).at(np.round(times_s * 1e9).astype(np.int64)), attribute)
        # half a step of the number, and what changes while a frame waits for a busy computer: at most 20 /s in 20 ms
        assert np.median(np.abs(values - truth)) < 0.5 * resolution + 0.02 * max(np.ptp(truth), resolution), name


def test_mavlink_decodes_by_pymavlink_to_the_state():
    needs_module("pymavlink")
    from pymavlink.dialects.v20 import common

    clock = Stopped()
    clock.now_ns = WORLD.epoch_ns + 5_000_000_000
    autopilot = Autopilot(Aircraft(WORLD), "127.0.0.1:9", clock)
    decoder = common.MAVLink(None)
    time_ns = clock.now_ns + 1_234_000_000
    attitude, hud = (message for packet in autopilot.messages(time_ns) for message in decoder.parse_buffer(packet))
    truth = Aircraft(WORLD).at(time_ns)
    assert (attitude.get_type(), hud.get_type()) == ("ATTITUDE", "VFR_HUD")
    assert (attitude.get_seq(), hud.get_seq()) == (0, 1)
    assert attitude.time_boot_ms == 1234
    assert (attitude.roll, attitude.pitch) == pytest.approx((truth.roll_rad, truth.pitch_rad), abs=1e-6)
    assert (hud.airspeed, hud.alt) == pytest.approx((truth.airspeed_mps, truth.altitude_m), abs=1e-4)
    autopilot.close()


def test_places_that_cannot_be():
    aircraft, clock = Aircraft(WORLD), SystemClock()
    with pytest.raises(UsageError, match="INTERFACE:CHANNEL"):
        CanNode(aircraft, "vcan0", clock)
    with pytest.raises(SimulationError, match="cannot be put there"):
        CanNode(aircraft, "slcan:/proc/can", clock)
    with pytest.raises(SimulationError, match="cannot be opened"):
        CanNode(aircraft, "socketcan:no such bus", clock)
    with pytest.raises(UsageError, match="HOST:PORT"):
        Autopilot(aircraft, "127.0.0.1", clock)


def test_the_shipped_dbc_is_the_file_in_the_package():
    assert dbc_text() == (Path(__file__).parents[2] / "hw_sim/xhale.dbc").read_text()
