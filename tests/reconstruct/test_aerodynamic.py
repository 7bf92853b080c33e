"""Aerodynamic loads of a wing whose motion is known in closed form: net loads made from them by Newton's law."""

import numpy as np
import pytest

from reconstruct.aerodynamic import STANDARD_GRAVITY_M_S2, aerodynamic, upwards
from reconstruct.beam import shape_of
from reconstruct.wing import example_path, read_wing

RATE_HZ, SETS = 25.0, 100
FREQUENCY_HZ, AMPLITUDE_M = 1.5, 0.15
AIR_N = np.array([0.4, 0.0, 21.0])
AIR_AT_M = np.array([0.05, 1.4, 0.1])


class Flight:
    """A half wing that flaps as s², on a body under a load factor and rolling; the air's load is constant."""

    def __init__(self, roll_rad_s: float) -> None:
        self.half = read_wing(example_path("xhale.toml")).right
        self.time_s = np.arange(SETS) / RATE_HZ
        s = self.half.node_s_m / self.half.node_s_m[-1]
        phase = 2 * np.pi * FREQUENCY_HZ * self.time_s
        up = np.outer(np.sin(phase), AMPLITUDE_M * s**2)
        self.position_m = np.repeat(self.half.rest_position_m[None], SETS, axis=0)
        self.position_m[:, :, 2] += up
        self.load_factor = 1.0 + 0.5 * np.sin(0.7 * phase)
        self.rates = np.zeros((SETS, 3))
        self.rates[:, 0] = roll_rad_s
        sections = shape_of(self.half.beam, np.zeros((self.half.beam.elements, 4))).R_body_section
        node, omega = self.half.mass_node, 2 * np.pi * FREQUENCY_HZ
        place = self.position_m[:, node] + (sections[node] @ self.half.mass_offset_m[:, :, None])[:, :, 0]
        # roll about the x axis by hand: centripetal towards the axis, Coriolis of what moves up
        acceleration = upwards(self.load_factor)[:, None, :] + np.zeros_like(place)
        acceleration[:, :, 2] += -(omega**2) * up[:, node]
        acceleration[:, :, 1:] += -(roll_rad_s**2) * place[:, :, 1:]
        speed = omega * np.outer(np.cos(phase), AMPLITUDE_M * s**2)[:, node]
        acceleration[:, :, 1] += -2 * roll_rad_s * speed
        inertia = -self.half.mass_kg[:, None] * acceleration
        root = self.half.rest_position_m[0]
        force = AIR_N + inertia.sum(axis=1)
        moment = np.cross(AIR_AT_M, AIR_N) + np.cross(place - root, inertia).sum(axis=1)
        self.net = np.concatenate([force, moment], axis=1)

    def found(self, noise_m: float = 0.0, sigma_m: float = 1e-4):
        rng = np.random.default_rng(2)
        noise = noise_m * rng.normal(size=(SETS, 1, 3)) * (self.half.node_s_m / self.half.node_s_m[-1])[None, :, None]
        sigma = np.full(self.position_m.shape, sigma_m)
        none = np.zeros((SETS, 6))
        specific = upwards(self.load_factor)
        return aerodynamic(self.half, self.time_s, self.position_m + noise, sigma, self.net, none, specific, self.rates)


@pytest.mark.parametrize("roll_rad_s", [0.0, 0.6])
def test_the_air_is_what_is_left(roll_rad_s):
    flight = Flight(roll_rad_s)
    found = flight.found()
    inside = slice(4, -4)
    # inertia swings by 18 N; the polynomial through nine sets follows 1.5 Hz to half a percent
    swing = np.ptp(flight.net[:, 2])
    assert swing > 10
    assert np.abs(found.force_n[inside] - AIR_N).max() < 0.005 * swing
    assert np.abs(found.moment_nm[inside] - np.cross(AIR_AT_M, AIR_N)).max() < 0.01 * np.ptp(flight.net[:, 3])
    assert np.isnan(found.force_n[0]).all()  # too few neighbours


def test_its_sigma_holds():
    flight = Flight(0.0)
    noise_m = 2e-4
    exact, noisy = flight.found(), flight.found(noise_m, noise_m)
    off = (noisy.force_n - exact.force_n)[4:-4, 2] / noisy.sigma[4:-4, 2]
    # noise that grows towards the tip: the stated one is as large everywhere
    assert 0.1 < np.sqrt(np.mean(off**2)) < 1.0


def test_gaps_are_not_bridged():
    flight = Flight(0.0)
    flight.position_m[50:56] = np.nan
    found = flight.found()
    assert np.isnan(found.force_n[48:58]).all()
    assert np.isfinite(found.force_n[10:40]).all()


def test_at_rest_on_a_stand_the_air_does_nothing():
    flight = Flight(0.0)
    flight.position_m[:] = flight.half.rest_position_m
    weight = -STANDARD_GRAVITY_M_S2 * np.sum(flight.half.mass_kg)
    flight.load_factor = np.ones(SETS)
    flight.net = np.tile([0, 0, weight, 0, 0, 0], (SETS, 1))
    assert np.abs(flight.found().force_n[10:-10]).max() < 1e-9
