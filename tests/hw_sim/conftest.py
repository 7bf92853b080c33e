"""Worlds for the tests of the simulation."""

import dataclasses

import pytest

from hw_sim.world import World


@pytest.fixture(scope="session")
def world() -> World:
    """The default world at full size."""
    return World.make(seed=3)


@pytest.fixture(scope="session")
def small() -> World:
    """A quarter of the size, for whatever runs in real time."""
    return World.make(seed=3, scale=4)


@pytest.fixture(scope="session")
def bare(world: World) -> World:
    """Full size with a wing that mirrors next to nothing: spots stand alone."""
    scene = dataclasses.replace(world.scene, finish="matt")
    leds = dataclasses.replace(world.leds, height_m=0.2)  # the mirror image is far from its light
    return dataclasses.replace(world, scene=scene, leds=leds)
