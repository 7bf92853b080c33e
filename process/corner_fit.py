"""The neighbourhood of a checkerboard corner to the corner's maximum-likelihood place."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


def refine_edges(image: Image, corners: Array, directions_rad: Array, radius: float) -> Array:
    """Corners (N, 2), px, where the grey values fit best to two blurred edges that cross; NaN where the fit fails.

    ``corners`` (N, 2) start within half of ``radius`` (px) of the truth; ``directions_rad`` (N, 2) are about the
    directions of the two edges. No other edge may pass within ``radius`` of a corner.

    Model: I = a + g·d + b · erf(n1·d / (√2 s)) · erf(n2·d / (√2 s)), d from the corner, n1 and n2 the edges' unit
    normals: with equal pixel noise, its least-squares fit is the maximum-likelihood corner.
    """
    reach = int(np.ceil(radius))
    offsets = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    offsets = offsets[np.hypot(*offsets.T) <= radius]
    centre = np.rint(corners).astype(int)
    pixels = centre[:, None, :] + offsets
    inside = np.all((pixels >= 0) & (pixels < [image.shape[1], image.shape[0]]), axis=(1, 2))
    pixels[~inside] = offsets + reach  # any valid place: the result is dropped
    grey = image[pixels[..., 1], pixels[..., 0]].astype(np.float64)
    place = _fit_edges(grey, offsets.astype(np.float64), corners - centre, directions_rad)
    place[~inside | (np.hypot(*(place + centre - corners).T) > 0.5 * radius)] = np.nan
    return np.asarray(place + centre)


def _fit_edges(grey: Array, offsets: Array, start: Array, directions: Array) -> Array:
    """Corners (N, 2), from the window's centre, by Levenberg-Marquardt on all N windows at once."""
    parameters = _edge_start(grey, offsets, start, directions)
    damping = np.full(len(grey), 1e-3)
    model, slope = _edge_model(parameters, offsets)
    cost = np.sum((model - grey) ** 2, axis=1)
    for _ in range(30):
        normal = np.einsum("npi,npj->nij", slope, slope)
        diagonal = np.einsum("nii->ni", normal)
        normal[:, np.arange(9), np.arange(9)] += damping[:, None] * diagonal + 1e-9
        step = np.linalg.solve(normal, np.einsum("npi,np->ni", slope, grey - model)[..., None])[..., 0]
        trial = parameters + step
        trial[:, 4] = np.clip(trial[:, 4], 0.2, 6.0)
        trial_model, trial_slope = _edge_model(trial, offsets)
        trial_cost = np.sum((trial_model - grey) ** 2, axis=1)
        better = trial_cost < cost
        damping = np.clip(np.where(better, 0.2 * damping, 5.0 * damping), 1e-9, 1e6)
        parameters[better], model[better], slope[better] = trial[better], trial_model[better], trial_slope[better]
        cost = np.minimum(cost, trial_cost)
        if np.abs(step[:, :2]).max() < 1e-5:
            break
    return parameters[:, :2].copy()


def _edge_start(grey: Array, offsets: Array, start: Array, directions: Array) -> Array:
    """Start values (N, 9): corner (2), angles of both normals, blur, mean, contrast, brightness slope (2)."""
    mean = grey.mean(axis=1)
    half = 0.5 * (np.percentile(grey, 95, axis=1) - np.percentile(grey, 5, axis=1))
    d = offsets - start[:, None, :]
    first, second = (np.einsum("npk,nk->np", d, _unit(directions[:, i] + np.pi / 2)) for i in (0, 1))
    sign = np.sign(np.einsum("np,np->n", np.sign(first * second), grey - mean[:, None]))
    return np.column_stack([start, directions + np.pi / 2, np.ones(len(grey)), mean, sign * half, 0 * start])


def _edge_model(parameters: Array, offsets: Array) -> tuple[Array, Array]:
    """Grey values (N, P) of the model, and their derivatives (N, P, 9)."""
    d = offsets - parameters[:, None, :2]
    blur, mean, contrast = (parameters[:, i, None] for i in (4, 5, 6))
    slope = np.empty((*d.shape[:2], 9))
    edges, densities, normals, tangents = [], [], [], []
    for angle in (parameters[:, 2], parameters[:, 3]):
        normal, tangent = _unit(angle), _unit(angle + np.pi / 2)
        distance = np.einsum("npk,nk->np", d, normal) / blur
        edges.append(erf(distance / np.sqrt(2.0)))
        densities.append(np.sqrt(2.0 / np.pi) * np.exp(-0.5 * distance**2) / blur)
        normals.append(distance)
        tangents.append(np.einsum("npk,nk->np", d, tangent))
    along = [contrast * densities[0] * edges[1], contrast * densities[1] * edges[0]]  # of I by each edge's n·d
    tilt = parameters[:, None, 7:9]
    for axis in (0, 1):
        by_place = sum(a * _unit(parameters[:, 2 + i])[:, axis, None] for i, a in enumerate(along))
        slope[..., axis] = -by_place - tilt[..., axis]
    slope[..., 2] = along[0] * tangents[0]
    slope[..., 3] = along[1] * tangents[1]
    slope[..., 4] = -(along[0] * normals[0] + along[1] * normals[1])
    slope[..., 5] = 1.0
    slope[..., 6] = edges[0] * edges[1]
    slope[..., 7:9] = d
    model = mean + contrast * slope[..., 6] + np.einsum("npk,nk->np", d, parameters[:, 7:9])
    return model, slope


def _unit(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
