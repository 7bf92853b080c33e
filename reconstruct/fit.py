"""Instants' marker positions into the loads, shape and twist of the half wing that explain them (paper, eq. 7).

Equation numbers are those of docs/explanation/beam.md. The loads found are net: air, inertia and weight together.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from reconstruct.iteration import FEWEST_MARKERS, Ends, Measure, Problem, iterate, linearise, objections
from reconstruct.posterior import Fit, State, fit_of, information_of, nothing_of, state_of, with_rows
from reconstruct.prior import FREE, STATED, STATIONS_GROUP, rescaled, strain_prior
from reconstruct.rotation import Array, Index, Mask
from reconstruct.wing import HalfWing
from reconstruct.wing_file import FitSettings

__all__ = ["Fit", "Unscaled", "common_scale", "fit_each", "fit_frame", "fit_from", "marker_places", "marker_problem"]
__all__ += ["pose", "scale_of", "scaled", "with_residuals"]

SETS_AT_ONCE = 50  # that are fitted together, for memory's sake
_SCALE_ROUNDS = 6  # of choosing the prior's scale
_SCALE_SETS = 60  # of a flight, to choose it from
_SAME_SCALE = 0.05  # relative


@dataclass(frozen=True, eq=False)
class Unscaled:
    """The problem of one instant, or of F, before the data have chosen how large its prior is."""

    problem: Problem
    group: Index  # (u,) of each unknown

    def __len__(self) -> int:
        """F."""
        return len(self.problem.seen)

    def __getitem__(self, rows: Index | slice) -> "Unscaled":
        """Some of F instants."""
        return replace(self, problem=self.problem[rows])


@dataclass(frozen=True, eq=False)
class Places:
    """Measured places: see ``iteration.Measure``."""

    xyz_m: Array  # (…, M, 3); any number where not seen
    whiten: Array  # (…, M, 3, 3) the inverse root of their covariance; zero where not seen

    def __call__(self, point: Array) -> tuple[Array, Array]:
        """What stands between them and ``point`` (…, M, 3)."""
        return (self.whiten @ (point - self.xyz_m)[..., None])[..., 0], self.whiten

    def __getitem__(self, rows: Index) -> "Places":
        """Some of the instants."""
        return Places(self.xyz_m[rows], self.whiten[rows])


def fit_frame(
    half: HalfWing,
    marker_xyz_m: Array,
    marker_cov_m2: Array,
    settings: FitSettings,
    start: Fit | None = None,
    prior_scale: Array | None = None,
) -> Fit:
    """Fit net loads, and with them the shape, to one instant's markers (eqs. 16 to 26).

    Args:
        half: the half wing.
        marker_xyz_m: (M, 3) body frame, in the order of ``half.marker_ids``; NaN rows for markers not measured.
        marker_cov_m2: (M, 3, 3); a marker whose covariance is NaN or not positive definite counts as not measured.
        settings: load stations, prior and marker model, from the wing file.
        start: the fit of a neighbouring instant. One that did not converge is ignored, and when the iteration does not
            settle from it, it begins again from the unloaded wing: divergence cannot travel from frame to frame.
        prior_scale: (4,) as another fit, or all fits of a flight, chose it; None: chosen by this instant's markers.

    Returns:
        the fit; with NaN and a reason when fewer than three markers were measured, the iteration does not settle, or
        less than half of the markers agree with it.
    """
    if marker_xyz_m.ndim != 2:
        raise ValueError(f"expected one instant's markers, got shape {marker_xyz_m.shape}")
    posed = marker_problem(half, marker_xyz_m[None], marker_cov_m2[None], settings)
    return with_residuals(half, fit_each(posed, settings, prior_scale, start)[0], marker_xyz_m)


def fit_each(posed: Unscaled, settings: FitSettings, prior_scale: Array | None = None, start: Fit | None = None) -> Fit:
    """The fits of F instants; ``residual_m`` is left to the caller, who knows what was measured.

    Up to SETS_AT_ONCE are fitted together, from the unloaded wing, so that none has a part in another's fit. Where
    loads act at stations only, they are fitted in turn, each from the last one's fit.

    Args:
        posed: what they are to explain.
        settings: from the wing file.
        prior_scale: (4,) for all; None: chosen by all of them together.
        start: fits that they begin from, one each or one for all; those that did not converge are ignored, and who
            does not settle from one begins again from the unloaded wing.
    """
    if prior_scale is None and settings.prior_weight != "data":
        prior_scale = scale_of(posed, settings)
    elif prior_scale is None:
        prior_scale, fitted = _chosen(posed, settings, start)
        if len(fitted) == len(posed):
            return fitted
    together = SETS_AT_ONCE if settings.loads == "everywhere" else 1
    fits: list[Fit] = []
    for first in range(0, len(posed), together):
        some = slice(first, first + together)
        before = fits[-1] if fits and together == 1 and start is None else start
        given = before if before is None or np.ndim(before.converged) == 0 or len(before) == 1 else before[some]
        fits.append(_fit_together(posed[some], settings, prior_scale, given))
    return fits[0] if len(fits) == 1 else Fit.join(fits)


def with_residuals(half: HalfWing, fit: Fit, marker_xyz_m: Array) -> Fit:
    """The fit, of one instant or F, with measured minus fitted places of the markers (…, M, 3) that were measured."""
    measured = (fit.used | fit.outlier)[..., None]
    return replace(fit, residual_m=np.where(measured, marker_xyz_m - marker_places(half, fit), np.nan))


def fit_from(
    posed: Unscaled, settings: FitSettings, single: Fit, theta: Array, covariance: Array, prior_scale: Array
) -> Fit:
    """The fits of F instants at unknowns (F, u) with covariances (F, u, u) that were found from more than their own.

    ``single`` are the instants' own fits, whose verdicts on the markers stay; where there was none, no marker is in
    use. Loads must act everywhere.
    """
    problem = scaled(posed, prior_scale)
    assert problem.modes is not None
    linear = linearise(problem, (theta @ problem.modes.T).reshape(len(theta), -1, 4), theta)
    weight = single.used.astype(np.float64)
    factor: Array = (
        np.linalg.cholesky(covariance + 1e-12 * np.eye(theta.shape[1])).transpose(0, 2, 1).astype(np.float64)
    )
    state = State(theta, linear, weight, single.iterations, factor, information_of(linear, weight))
    found = fit_of(problem, state, np.array(settings.load_stations_m), prior_scale)
    own = single.converged
    return replace(
        found,
        outlier=np.where(own[:, None], found.outlier, single.outlier),
        distance=np.where(own[:, None], found.distance, single.distance),
        chi2=np.where(own, found.chi2, np.nan),
        dof=np.where(own, found.dof, np.nan),
    )


def marker_problem(
    half: HalfWing, marker_xyz_m: Array, marker_cov_m2: Array, settings: FitSettings, shared: Array | None = None
) -> Unscaled:
    """The problem of markers at known places (…, M, 3), with covariances (…, M, 3, 3); NaN where not measured.

    ``shared`` (…, M, 3, P) is how errors that all of them share move them (eq. 32); loads must then act everywhere.
    """
    markers = len(half.marker_ids)
    if marker_xyz_m.shape[-2:] != (markers, 3) or marker_cov_m2.shape[-3:] != (markers, 3, 3):
        raise ValueError(f"expected {markers} markers, got shapes {marker_xyz_m.shape} and {marker_cov_m2.shape}")
    seen: Mask = np.isfinite(np.concatenate([marker_xyz_m[..., None], marker_cov_m2], axis=-1)).all(axis=(-1, -2))
    safe = np.where(seen[..., None, None], marker_cov_m2, np.eye(3))
    seen = np.logical_and(seen, np.linalg.eigvalsh(safe)[..., 0] > 0)
    full = np.where(seen[..., None, None], safe, np.eye(3)) + settings.marker_model_sigma_m**2 * np.eye(3)
    whiten = np.linalg.inv(np.linalg.cholesky(full)) * seen[..., None, None]
    xyz = np.where(seen[..., None], marker_xyz_m, 0.0)
    return pose(half, settings, Places(xyz, whiten), seen, 3.0 * seen.astype(np.float64), shared)


def common_scale(half: HalfWing, marker_xyz_m: Array, marker_cov_m2: Array, settings: FitSettings) -> Array:
    """``scale_of`` sets of markers (F, M, 3) with covariances (F, M, 3, 3)."""
    return scale_of(marker_problem(half, marker_xyz_m, marker_cov_m2, settings), settings)


def scale_of(posed: Unscaled, settings: FitSettings) -> Array:
    """The prior's scale (4,) that many instants together make likeliest (eq. 25), if the data are to choose it.

    At most sixty are used, spread evenly. All instants share it: what one set's markers tell of how much the wing
    twists at all is little.
    """
    if settings.prior_weight != "data":
        return rescaled(STATED, posed.group, np.zeros(1), np.zeros(1), settings.prior_weight)
    if not len(posed):
        return STATED
    return _chosen(posed, settings, None)[0]


def _chosen(posed: Unscaled, settings: FitSettings, start: Fit | None) -> tuple[Array, Fit]:
    """``scale_of`` where the data choose it, and the fits of the instants that it was chosen from."""
    enough = np.flatnonzero(posed.problem.seen.sum(axis=1) >= FEWEST_MARKERS)
    if not enough.size:
        return STATED, fit_each(posed, settings, STATED, start)
    some = posed[enough[np.unique(np.linspace(0, enough.size - 1, _SCALE_SETS).round().astype(int))]]
    scale = STATED if start is None or not np.all(start.converged) else start.prior_scale
    iterations = np.zeros(len(some), dtype=int)
    for left in reversed(range(_SCALE_ROUNDS)):
        fits = fit_each(some, settings, scale, start)
        iterations += fits.iterations
        good = fits.converged
        if not left or not good.any():
            break
        better = rescaled(scale, posed.group, fits.unknowns[good], fits.told[good], "data")
        if np.abs(np.log(better / scale)).max() < _SAME_SCALE:
            break
        start, scale = fits, better
    return scale, replace(fits, iterations=iterations)


def marker_places(half: HalfWing, fit: Fit) -> Array:
    """(…, M, 3) where the fit has the markers, body frame."""
    node = half.marker_node
    offset = (fit.R_body_section[..., node, :, :] @ half.marker_offset_m[:, :, None])[..., 0]
    places: Array = fit.position_m[..., node, :] + offset
    return places


def pose(
    half: HalfWing,
    settings: FitSettings,
    measure: Measure,
    seen: Mask,
    coordinates: Array,
    shared: Array | None = None,
) -> Unscaled:
    """The problem of finding the half wing that ``measure`` was taken of (eq. 16), at one instant or F.

    Args:
        half: the half wing.
        settings: from the wing file.
        measure: how far any markers are from those measured.
        seen: (…, M) which were.
        coordinates: (…, M) numbers measured of each.
        shared: (…, M, 3, P) how unit errors that all markers share move them.
    """
    stations = settings.load_stations_m
    sigma = np.tile(np.repeat([settings.force_sigma_n, settings.moment_sigma_nm], 3), len(stations))
    group = _group(half, settings)
    if shared is not None:
        group = np.concatenate([group, np.full(shared.shape[-1], FREE)])
    prior = np.ones(len(group))
    modes = None
    if settings.loads == "everywhere":
        modes = strain_prior(half, settings).modes
    else:
        prior[: len(sigma)] = settings.prior_weight != 0
    problem = Problem(
        half=half,
        load_nodes=np.array([half.node_at(station) for station in stations]),
        modes=modes,
        load_sigma=sigma,
        load_scale=np.ones(len(sigma)),
        prior=prior,
        measure=measure,
        seen=seen,
        coordinates=coordinates,
        outlier_sigma=settings.outlier_sigma,
        shared=shared,
    )
    return Unscaled(problem, group)


def scaled(posed: Unscaled, scale: Array) -> Problem:
    """The problem with its prior's groups as large as ``scale`` (4,) says."""
    root = np.sqrt(scale[posed.group])
    problem = posed.problem
    if problem.modes is not None:
        return replace(problem, modes=problem.modes * root[: problem.modes.shape[1]])
    return replace(problem, load_scale=root[: len(problem.load_sigma)])


def _fit_together(posed: Unscaled, settings: FitSettings, scale: Array, start: Fit | None) -> Fit:
    problem, stations = scaled(posed, scale), np.array(settings.load_stations_m)
    count, markers = problem.seen.sum(axis=1), problem.seen.shape[1]
    enough = np.flatnonzero(count >= FEWEST_MARKERS)
    ends = _ends(posed[enough], problem[enough], settings, *_begin(problem, scale, posed.group, start, enough))
    against = objections(problem[enough], ends)
    good = np.flatnonzero(against == "")
    rows = enough[good]
    fitted = fit_of(problem[rows], state_of(problem[rows], ends[good]), stations, scale) if rows.size else None
    if fitted is not None and rows.size == len(posed):
        return fitted
    reasons = np.array([f"{n} of {markers} markers measured, {FEWEST_MARKERS} needed" for n in count], dtype=object)
    reasons[enough] = against
    nothing = nothing_of(problem.half, problem.unknowns, stations, scale, reasons)
    nothing.iterations[enough] = ends.iterations
    return nothing if fitted is None else with_rows(nothing, rows, fitted)


def _begin(problem: Problem, scale: Array, group: Index, start: Fit | None, rows: Index) -> tuple[Array, Array]:
    """Strains and unknowns that the iteration of some instants begins from: those of ``start`` that can be used."""
    count = len(problem.seen)
    strain, theta = np.zeros((count, problem.half.beam.elements, 4)), np.zeros((count, problem.unknowns))
    if start is not None and start.unknowns.shape[-1] == problem.unknowns:
        usable = np.broadcast_to(start.converged, count)
        strain[usable] = np.broadcast_to(start.strain, strain.shape)[usable]
        theta[usable] = np.broadcast_to(start.unknowns * np.sqrt(start.prior_scale / scale)[group], theta.shape)[usable]
    return strain[rows], theta[rows]


def _ends(posed: Unscaled, problem: Problem, settings: FitSettings, strain: Array, theta: Array) -> Ends:
    """Where the iteration ends; those that end at no shape begin again from the unloaded wing."""
    ends = iterate(problem, strain, theta)
    lost = np.flatnonzero((objections(problem, ends) != "") & (theta != 0).any(axis=1))
    if lost.size:
        _replace(ends, lost, iterate(problem[lost], np.zeros_like(strain[lost]), np.zeros_like(theta[lost])))
    if settings.loads == "stations" and settings.prior_weight != 0:
        lost = np.flatnonzero(objections(problem, ends) != "")
        if lost.size:
            _replace(ends, lost, iterate(problem[lost], *_from_loads_everywhere(posed[lost], settings)))
    return ends


def _replace(ends: Ends, rows: Index, better: Ends) -> None:
    for member in fields(Ends):
        getattr(ends, member.name)[rows] = getattr(better, member.name)


def _from_loads_everywhere(posed: Unscaled, settings: FitSettings) -> tuple[Array, Array]:
    """Strains and unknowns to begin from where loads at stations do not find the wing from its unloaded shape."""
    problem = posed.problem
    elsewhere = settings.model_copy(update={"loads": "everywhere"})
    found = fit_each(pose(problem.half, elsewhere, problem.measure, problem.seen, problem.coordinates), elsewhere)
    theta = np.zeros((len(posed), problem.unknowns))
    theta[:, : len(problem.load_sigma)] = found.loads.reshape(len(posed), -1) / problem.load_sigma
    known = found.converged[:, None]
    return np.where(known[:, :, None], found.strain, 0.0), np.where(known, theta, 0.0)


def _group(half: HalfWing, settings: FitSettings) -> Index:
    """(u,) what each unknown is scaled with."""
    if settings.loads == "everywhere":
        return strain_prior(half, settings).group
    return np.concatenate([np.tile(STATIONS_GROUP, len(settings.load_stations_m)), np.full(4, FREE)])
