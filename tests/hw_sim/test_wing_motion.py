"""The wing in motion keeps its length, its frames and the definitions of docs/ARCHITECTURE.md."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw_sim.wing_motion import LedMotion, WingMotion, amplitudes, incidence_rad, twist_rad
from hw_sim.world import Motion, Sine, World, rotation

SIDES = ("left", "right")
TIMES = np.array([0, 137, 2_460, 7_003, 86_400_123]) * 1_000_000


@pytest.mark.parametrize("side", SIDES)
def test_arc_length_is_kept(world: World, side: str) -> None:
    # The sum of chords falls short of the arc by Σ κ² ds³ / 24: with κ < 0.5 /m and ds = 0.25 mm, under 1e-8 of it.
    stations = np.linspace(0.0, 3.0, 12001)
    for time_ns in world.epoch_ns + TIMES:
        points = WingMotion(world, side, stations).points(np.array([time_ns]))
        lengths = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))
        assert lengths == pytest.approx(stations[1:], abs=3e-8)


@pytest.mark.parametrize("side", SIDES)
def test_quadrature_is_exact(world: World, side: str) -> None:
    # Against the same integral cut into 30 pieces: the axis point at s is the sum of what the pieces add.
    tip = WingMotion(world, side, np.array([3.0])).points(world.epoch_ns + TIMES[:, None])
    pieces = WingMotion(world, side, np.linspace(0.0, 3.0, 31)).points(world.epoch_ns + TIMES[:, None])
    assert np.abs(tip[:, 0] - pieces[:, -1]).max() < 1e-12
    inner = WingMotion(world, side, np.array([2.0, 2.0 + 1e-9])).points(world.epoch_ns + TIMES[:, None])
    assert np.abs(inner[:, 1] - inner[:, 0]).max() < 1.1e-9


@pytest.mark.parametrize("side", SIDES)
def test_frames_are_orthonormal_and_e1_is_the_tangent(world: World, side: str) -> None:
    stations = np.array([0.1, 0.7, 1.5, 1.9, 2.3, 2.9])
    step = 1e-4
    times = world.epoch_ns + TIMES[:, None]
    frames = WingMotion(world, side, stations).state(times).frames
    assert frames.swapaxes(-1, -2) @ frames == pytest.approx(np.broadcast_to(np.eye(3), frames.shape), abs=1e-14)
    assert np.linalg.det(frames) == pytest.approx(1.0)
    ahead = WingMotion(world, side, stations + step).points(times)
    behind = WingMotion(world, side, stations - step).points(times)
    assert (ahead - behind) / (2 * step) == pytest.approx(frames[..., 0], abs=1e-8)  # error κ'' step² / 6
    assert (frames[..., 2, 2] > 0).all()  # e3 is the upper side
    assert (frames[..., 0, 1] * (1 if side == "right" else -1) < 0).all()  # e2 forward on the right, aft on the left


@pytest.mark.parametrize("side", SIDES)
def test_root_is_clamped(world: World, side: str) -> None:
    state = WingMotion(world, side, np.array([0.0])).state(world.epoch_ns + TIMES[:, None])
    assert np.abs(state.points_m).max() == 0.0
    assert twist_rad(world, state.frames, side) == pytest.approx(0.0, abs=1e-15)


def _still(world: World, **means: float) -> World:
    gust = dataclasses.replace(
        world.motion.gust, bending_symmetric_rad=0.0, bending_antisymmetric_rad=0.0, bending2_rad=0.0, twist_rad=0.0
    )
    values = {"bending_mean_rad": 0.0, "twist_mean_rad": 0.0, "inplane_mean_rad": 0.0, **means}
    return dataclasses.replace(world, motion=Motion(sines=(), gust=gust, **values))


@pytest.mark.parametrize("side", SIDES)
def test_unloaded_wing_has_its_jig_shape(world: World, side: str) -> None:
    rest = _still(world)
    state = WingMotion(rest, side, np.array([1.0, 2.0, 3.0])).state(np.array([world.epoch_ns]))
    out, dihedral = (1 if side == "right" else -1), math.radians(10)
    assert state.points_m[1] == pytest.approx([0, 2 * out, 0])
    assert state.points_m[2] == pytest.approx([0, out * (2 + math.cos(dihedral)), math.sin(dihedral)])
    assert np.degrees(incidence_rad(state.frames, side)) == pytest.approx(5.0)
    assert twist_rad(rest, state.frames, side) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("side", SIDES)
def test_twist_is_nose_up_and_bending_up_on_both_sides(world: World, side: str) -> None:
    twisted = WingMotion(_still(world, twist_mean_rad=0.05), side, np.array([1.9])).state(np.array([world.epoch_ns]))
    # Without bending, twist is the closed form's angle: 1.5 x − 0.5 x³ of the amplitude.
    assert twist_rad(world, twisted.frames, side)[0] == pytest.approx(0.05 * (1.5 * 1.9 / 3 - 0.5 * (1.9 / 3) ** 3))
    forward = twisted.frames[0, :, 1] * (1 if side == "right" else -1)
    assert forward[0] < 0 < forward[2]
    bent = WingMotion(_still(world, bending_mean_rad=0.1), side, np.array([2.0])).points(np.array([world.epoch_ns]))
    assert bent[0, 2] > 0.05
    swept = WingMotion(_still(world, inplane_mean_rad=0.01), side, np.array([2.0])).points(np.array([world.epoch_ns]))
    assert swept[0, 0] < -0.005  # positive is forward


@given(
    bending=st.floats(-1.0, 1.0),
    sweep=st.floats(-0.3, 0.3),
    incidence=st.floats(-0.5, 0.5),
    side=st.sampled_from(SIDES),
)
def test_incidence_does_not_depend_on_bending_or_sweep(
    bending: float, sweep: float, incidence: float, side: str
) -> None:
    # By definition: frames Rx(θ) · Rz(ψ) · R_root · rot_e1(±α) have incidence α, whatever θ and ψ.
    out = 1 if side == "right" else -1
    root = np.column_stack([[0, out, 0], [-out, 0, 0], [0, 0, 1]])
    turns = [rotation(np.array(v)) for v in ([bending, 0.0, 0.0], [0.0, 0.0, sweep], [out * incidence, 0.0, 0.0])]
    frame = turns[0] @ turns[1] @ root @ turns[2]
    assert incidence_rad(frame, side) == pytest.approx(incidence, abs=1e-12)


@pytest.mark.parametrize("side", SIDES)
def test_bending_lifts_square_to_the_chord(world: World, side: str) -> None:
    bent = WingMotion(_still(world, bending_mean_rad=0.2), side, np.array([1.9])).state(np.array([world.epoch_ns]))
    root_chord = np.array([-math.cos(math.radians(5)), 0.0, math.sin(math.radians(5))])
    assert bent.points_m[0] @ root_chord == pytest.approx(0.0, abs=1e-12)
    assert bent.frames[0, :, 1] * (1 if side == "right" else -1) == pytest.approx(root_chord)


def test_symmetric_motion_is_a_mirror_image(world: World) -> None:
    sine = Sine("bending1", 1.0, 0.02, 0.0, 0.4)
    mirrored = dataclasses.replace(_still(world, twist_mean_rad=0.03, inplane_mean_rad=0.01))
    mirrored = dataclasses.replace(mirrored, motion=dataclasses.replace(mirrored.motion, sines=(sine,)))
    times = np.repeat(world.epoch_ns + TIMES[:, None], 18, axis=1)
    right, _ = LedMotion(mirrored, "right").centres(times)
    left, _ = LedMotion(mirrored, "left").centres(times)
    assert left * [1, -1, 1] == pytest.approx(right, abs=1e-15)


def test_lights_are_off_their_places_as_stated_and_stay_where_they_are(world: World) -> None:
    placed = dataclasses.replace(world, leds=dataclasses.replace(world.leds, placement_sigma_m=2e-4))
    times = np.repeat(world.epoch_ns + TIMES[:, None], 18, axis=1)
    off = []
    for side in SIDES:
        drawn, frames = LedMotion(world, side).centres(times)
        found, _ = LedMotion(placed, side).centres(times)
        off.append(np.einsum("tnba,tnb->tna", frames, found - drawn))
    assert np.ptp(off, axis=1) == pytest.approx(0.0, abs=1e-12)
    first = np.array(off)[:, 0]
    # 108 draws: their spread is known to 7 %
    assert np.sqrt(np.mean(first**2)) == pytest.approx(2e-4, rel=0.2)
    assert not np.allclose(first[0], first[1])


@pytest.mark.parametrize("side", SIDES)
def test_motion_is_that_of_a_flexible_wing_and_not_of_rubber(world: World, side: str) -> None:
    times = world.epoch_ns + np.arange(0, 30_000, 5)[:, None] * 1_000_000
    rest = WingMotion(_still(world), side, np.array([3.0])).points(np.array([0]))
    tip = WingMotion(world, side, np.array([3.0])).points(times)[:, 0]
    up = tip[:, 2] - rest[0, 2]
    assert 0.2 < up.min() < 0.4 < up.max() < 0.7
    speed = np.linalg.norm(np.diff(tip, axis=0), axis=1) / 5e-3
    assert 0.8 < speed.max() < 1.6
    stations = np.linspace(0.0, 3.0, 61)
    frames = WingMotion(world, side, stations).state(times[::50]).frames
    turn = frames[:, :-1].swapaxes(-1, -2) @ frames[:, 1:]
    smooth = np.arange(60) != 40  # the piece that begins at the dihedral break
    torsion, out_of_plane, in_plane = (turn[:, smooth, i, j] / 0.05 for i, j in ((2, 1), (2, 0), (1, 0)))
    assert np.abs(torsion * 59.3).max() < 6.0  # N m: what X-HALE's spar could carry
    assert np.abs(out_of_plane * 112.0).max() < 45.0
    assert np.abs(in_plane * 6350.0).max() < 120.0


def test_amplitudes_start_a_gust_smoothly(world: World) -> None:
    period_ns = round(world.motion.gust.period_s * 1e9)
    around = world.epoch_ns + 3 * period_ns + np.array([-1000, 1000])
    before, after = amplitudes(world, 1.0, around)
    assert np.abs(after - before).max() < 1e-5  # the tail of one gust has died away before the next
