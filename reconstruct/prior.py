"""A wing and its fit settings into what the fit believes of the strains before it sees a marker (eqs. 21 to 23).

Loads everywhere: strains are those of random smooth loads along the span, of loads at the tip, of the wing's masses
under random acceleration, and a rough remainder. How large they are is chosen by the data (eq. 25).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from reconstruct.rotation import Array, Index, cross
from reconstruct.wing import HalfWing
from reconstruct.wing_file import FitSettings

FREE, TWIST, OUT, IN = 0, 1, 2, 3
GROUPS = 4
STATED = np.ones(GROUPS)  # the scale of every group's variance as the wing file states it
STATIONS_GROUP = np.array([OUT, OUT, OUT, TWIST, TWIST, TWIST])  # of force and moment components at a station
_PULL = np.array([np.inf, 2.0, 8.0, 2.0])  # numbers' worth of belief in the stated scale, by group
_LEAST = np.array([1.0, 0.35, 1.0, 0.05])  # scale: loads are rougher than any smooth few say, when these are small
_SMALLEST_MODE = 1e-5  # of the largest mode's variance
_LOAD_REACH = {TWIST: 0.15, OUT: 1.0, IN: 4 / 3}  # correlation lengths of distributed loads, of the settings' one
_AT_TIP = 0.15  # share of loads at the tip in the sigma,
_ROUGH = {TWIST: 0.3, OUT: 0.1, IN: 0.05}  # and of what no smooth load explains
_ACCELERATION_G = ((2, 1.5), (0, 0.3))  # body axis, sigma: of the masses, weight included
_G_M_S2 = 9.80665


@dataclass(frozen=True, eq=False)
class StrainPrior:
    """Independent modes of unit variance: strains are modes @ theta."""

    modes: Array  # (4N, m)
    group: Index  # (m,) FREE, TWIST, OUT or IN


@lru_cache(maxsize=16)
def strain_prior(half: HalfWing, settings: FitSettings) -> StrainPrior:
    """The prior of loads at every node, stated by the strains they cause (eqs. 21 to 23)."""
    s = half.node_s_m / half.node_s_m[-1]
    middle = (s[:-1] + s[1:]) / 2
    stiffness = half.beam.stiffness
    twist, out = np.radians([settings.twist_sigma_deg, settings.bend_out_sigma_deg])
    if settings.bend_in_sigma_deg is None:
        into = out * np.sqrt(np.median(stiffness[:, 2, 2] / stiffness[:, 3, 3]))
    else:
        into = np.radians(settings.bend_in_sigma_deg)
    angle = {TWIST: twist, OUT: out, IN: into}
    covariances = [(0, FREE, settings.extension_sigma**2 * _matern(middle, settings.correlation))]
    for strain, size in angle.items():
        smooth, rough = _bending_covariances(half, strain, s, settings.correlation)
        variance = (size / half.node_s_m[-1]) ** 2
        covariances += [(strain, strain, variance * smooth), (strain, FREE, variance * rough)]
    strains, groups = [], []
    for strain, group, covariance in covariances:
        size, shapes = np.linalg.eigh(covariance)
        kept = size > _SMALLEST_MODE * size[-1]
        modes = np.zeros((len(middle), 4, int(kept.sum())))
        modes[:, strain] = shapes[:, kept] * np.sqrt(size[kept])
        strains.append(modes.reshape(4 * len(middle), -1))
        groups.append(np.full(int(kept.sum()), group))
    if half.mass_kg.size:
        strains.append(_of_masses(half))
        groups.append(np.zeros(len(_ACCELERATION_G), dtype=int))
    return StrainPrior(np.hstack(strains), np.concatenate(groups))


def rescaled(scale: Array, group: Index, theta: Array, information: Array, weight: Literal["data"] | float) -> Array:
    """The groups' variances, in units of the stated ones, under which the data are likeliest (eq. 25): (4,).

    Args:
        scale: (4,) those that ``theta`` was found under.
        group: (m,) of each unknown.
        theta: (m,) or (frames, m) the unknowns found, in units of the scaled sigmas.
        information: (m,) or (frames, m) the share of each unknown told by the data, one minus its posterior variance.
        weight: "data", or the prior's weight as given.
    """
    if weight != "data":
        return STATED / weight if weight > 0 else STATED
    found = np.zeros(GROUPS)
    told = np.zeros(GROUPS)
    np.add.at(found, np.broadcast_to(group, theta.shape), theta**2)
    np.add.at(told, np.broadcast_to(group, theta.shape), information)
    pull = _PULL[1:]
    likeliest = np.concatenate([[1.0], (found[1:] * scale[1:] + pull) / (told[1:] + pull)])
    bounded: Array = np.maximum(likeliest, _LEAST)
    return bounded


def _bending_covariances(half: HalfWing, strain: int, s: Array, correlation: float) -> tuple[Array, Array]:
    """(N, N) of one strain, elements' middles, under random loads, and of the remainder: the tip's angle is one."""
    middle, width = (s[:-1] + s[1:]) / 2, np.diff(s)
    outboard = middle[None, :] - middle[:, None]
    if strain == TWIST:
        from_loads = (outboard > 0) * width + np.diag(width / 2)
        from_tip = np.ones(len(middle))
    else:
        from_loads = np.maximum(outboard, 0.0) * width
        from_tip = 1 - middle
    flexibility = 1 / half.beam.stiffness[:, strain, strain]

    def even(moment: Array) -> Array:
        covariance = moment * np.outer(flexibility, flexibility)
        return covariance / (width @ covariance @ width)

    taper = 1 - 0.9 * middle
    smooth = from_loads @ _matern(middle, _LOAD_REACH[strain] * correlation) @ from_loads.T
    rough = np.outer(taper, taper) * _matern(middle, correlation)
    loads = (1 - _AT_TIP**2) * even(smooth) + _AT_TIP**2 * even(np.outer(from_tip, from_tip))
    return loads, _ROUGH[strain] ** 2 * even(rough)


def _matern(x: Array, reach: float) -> Array:
    """Matérn 5/2 correlation between the places ``x``."""
    a = np.sqrt(5) * np.abs(x[:, None] - x[None, :]) / reach
    correlation: Array = (1 + a + a**2 / 3) * np.exp(-a)
    return correlation


def _of_masses(half: HalfWing) -> Array:
    """(4N, 2) strains when the masses of the unloaded wing are accelerated by one sigma."""
    rest, arm = half.beam.rest, half.mass_offset_m
    place = rest.position_m[half.mass_node] + (rest.R_body_section[half.mass_node] @ arm[:, :, None])[:, :, 0]
    columns = []
    for axis, sigma in _ACCELERATION_G:
        force = np.zeros((len(place), 3))
        force[:, axis] = half.mass_kg * _G_M_S2 * sigma
        outboard = half.mass_node[None, :] > np.arange(half.beam.elements)[:, None]
        middle = (rest.position_m[1:] + rest.position_m[:-1]) / 2
        total = outboard @ force
        moment = outboard @ cross(place, force) - cross(middle, total)
        turned = rest.R_start.transpose(0, 2, 1) @ np.stack([total, moment], axis=2)
        acting = np.concatenate([turned[:, :1, 0], turned[:, :, 1]], axis=1)
        columns.append(np.linalg.solve(half.beam.stiffness, acting[:, :, None]).ravel())
    return np.stack(columns, axis=1)
