"""wing.toml's contents into checked values: every key with its unit, its bounds and what must hold between them."""

import itertools
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from reconstruct.rotation import Array

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Angle = Annotated[float, Field(gt=-180, lt=180)]
Vector = tuple[Finite, Finite, Finite]
_SAME_STATION_M = 1e-9


class Strict(BaseModel):
    """A table of a file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Root(Strict):
    """Where the right half wing begins in the body frame, and how its root section is turned."""

    position_m: Vector = (0.0, 0.0, 0.0)
    incidence_deg: Angle = 0.0  # nose-up


class SegmentSection(Strict):
    """A straight (or evenly curved) piece of the half wing with one section."""

    length_m: Positive
    elements: Annotated[int, Field(ge=1, le=1000)]  # no element of it is longer than length_m / elements
    EA: Positive  # N
    GJ: Positive  # N·m²
    EI_out: Positive  # N·m², out of plane: about e2
    EI_in: Positive  # N·m², in plane: about e3
    k12: Finite = 0.0  # couplings: 1 extension (N), 2 twist, 3 out-of-plane, 4 in-plane bending (N·m, N·m²)
    k13: Finite = 0.0
    k14: Finite = 0.0
    k23: Finite = 0.0
    k24: Finite = 0.0
    k34: Finite = 0.0
    dihedral_deg: Angle = 0.0  # tip up
    sweep_deg: Angle = 0.0  # tip aft
    twist_deg: Angle = 0.0  # nose-up, on top of the root's incidence
    curvature_1pm: Vector = (0.0, 0.0, 0.0)  # built-in, about e1, e2, e3
    chord_m: Positive | None = None  # with axis: markers must lie on the chord
    axis: Annotated[float, Field(ge=0, le=1)] = 0.5  # the beam's axis, fraction of the chord behind the leading edge
    mass_per_m: NotNegative = 0.0  # kg/m
    cg_chord_m: Finite = 0.0  # of that mass, forward of the axis
    cg_height_m: Finite = 0.0

    @property
    def stiffness(self) -> Array:
        """(4, 4) of the right wing, order extension, twist, out-of-plane, in-plane."""
        return np.array(
            [
                [self.EA, self.k12, self.k13, self.k14],
                [self.k12, self.GJ, self.k23, self.k24],
                [self.k13, self.k23, self.EI_out, self.k34],
                [self.k14, self.k24, self.k34, self.EI_in],
            ]
        )

    @model_validator(mode="after")
    def _positive_definite(self) -> "SegmentSection":
        scale = np.sqrt(np.diag(self.stiffness))
        smallest = np.linalg.eigvalsh(self.stiffness / np.outer(scale, scale))[0]
        if smallest < 1e-9:
            raise ValueError("the stiffness is not positive definite: a coupling is too large for its diagonal terms")
        return self


class Mass(Strict):
    """Something mounted on the wing: a pod, a payload, a lumped piece of structure."""

    name: str = ""
    station_m: NotNegative
    mass_kg: Positive
    span_m: Finite = 0.0  # offset of its centre of gravity from the axis: outboard,
    chord_m: Finite = 0.0  # forward,
    height_m: Finite = 0.0  # up
    side: Literal["both", "left", "right"] = "both"


class Pair(Strict):
    """Two markers at one station."""

    station_m: NotNegative
    chord_m: tuple[Finite, Finite]  # fore and aft marker, positive forward of the axis
    height_m: Finite = 0.0  # of the light's centre above the axis

    @model_validator(mode="after")
    def _fore_is_forward(self) -> "Pair":
        if self.chord_m[0] <= self.chord_m[1]:
            raise ValueError("chord_m is [fore, aft], positive forward: the first must be the larger")
        return self


class Markers(Strict):
    """The LEDs of a half wing, innermost pair first."""

    pairs: tuple[Pair, ...] = ()

    @model_validator(mode="after")
    def _outward(self) -> "Markers":
        stations = [pair.station_m for pair in self.pairs]
        if any(b <= a for a, b in itertools.pairwise(stations)):
            raise ValueError("pairs must be listed from the root outward, each at its own station")
        return self


class StiffnessSigma(Strict):
    """One sigma of the stiffness, relative."""

    EA: NotNegative = 0.0
    GJ: NotNegative = 0.0
    EI_out: NotNegative = 0.0
    EI_in: NotNegative = 0.0


class FitSettings(Strict):
    """What the inverse may assume: where loads act, what they may do to the wing, how good the markers' model is.

    The prior of loads at every node is stated by the strains they cause: one sigma of the angle by which the tip turns
    when that strain is the same all along.
    """

    loads: Literal["everywhere", "stations"] = "everywhere"  # at every node, or only at the stations (the paper's way)
    load_stations_m: Annotated[tuple[Positive, ...], Field(min_length=1)]  # where loads act, or are reported
    twist_sigma_deg: Positive = 2.0
    bend_out_sigma_deg: Positive = 40.0
    bend_in_sigma_deg: Positive | None = None  # None: out of plane's, times √(EI_out / EI_in)
    extension_sigma: Positive = 5e-5
    correlation: Positive = 1.5  # in half spans: loads much closer than this are alike
    force_sigma_n: Positive = 30.0  # of each component at each station
    moment_sigma_nm: Positive = 5.0
    prior_weight: Literal["data"] | NotNegative = "data"  # chosen by the data; 1 as stated; 0 none (stations only)
    marker_model_sigma_m: NotNegative = 0.0002  # added to every marker's covariance
    outlier_sigma: Positive = 4.6  # a marker farther off than this (χ² of 3, p = 1e-4) is left out

    @model_validator(mode="after")
    def _loads_everywhere_need_a_prior(self) -> "FitSettings":
        if self.loads == "everywhere" and self.prior_weight == 0:
            raise ValueError(
                'prior_weight = 0 needs loads = "stations": loads at every node are too many without prior'
            )
        return self


class WingFile(Strict):
    """A whole wing.toml."""

    name: Annotated[str, Field(min_length=1)]
    source: str = ""  # where the numbers come from
    root: Root = Root()
    segment: Annotated[tuple[SegmentSection, ...], Field(min_length=1)]
    mass: tuple[Mass, ...] = ()
    markers: Markers = Markers()
    stiffness_sigma: StiffnessSigma = StiffnessSigma()
    fit: FitSettings | None = None

    @property
    def semispan_m(self) -> float:
        """Arc length of the half wing."""
        return sum(segment.length_m for segment in self.segment)

    def segment_at(self, station_m: float) -> SegmentSection:
        """The segment a station lies in; at a joint the inboard one."""
        end = 0.0
        for segment in self.segment:
            end += segment.length_m
            if station_m <= end + _SAME_STATION_M:
                return segment
        raise ValueError(f"station {station_m:g} m is off the wing: its half span is {end:g} m")

    @model_validator(mode="after")
    def _everything_on_the_wing(self) -> "WingFile":
        for index, pair in enumerate(self.markers.pairs):
            try:
                segment = self.segment_at(pair.station_m)
            except ValueError as error:
                raise ValueError(f"markers.pairs[{index}].station_m: {error}") from error
            if segment.chord_m is None:
                continue
            front, back = segment.axis * segment.chord_m, (segment.axis - 1) * segment.chord_m
            if pair.chord_m[0] > front or pair.chord_m[1] < back:
                raise ValueError(
                    f"markers.pairs[{index}].chord_m: off the chord, which reaches from {back:g} to {front:g} m there"
                )
        for index, mass in enumerate(self.mass):
            try:
                self.segment_at(mass.station_m)
            except ValueError as error:
                raise ValueError(f"mass[{index}].station_m: {error}") from error
        for station in self.fit.load_stations_m if self.fit else ():
            try:
                self.segment_at(station)
            except ValueError as error:
                raise ValueError(f"fit.load_stations_m: {error}") from error
        return self


def first_error(error: ValidationError) -> str:
    """The first thing wrong with a file, as key: reason."""
    first = error.errors()[0]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    reason = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        reason = "unknown key (see docs/reference/wing-file.md)"
    elif first["type"] == "missing":
        reason = "missing"
    return f"{key}: {reason}" if key else reason
