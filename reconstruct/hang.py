"""The wing at rest, as measured and as the wing file has it under its own weight → by how much its stiffness is off.

In flight the loads are unknown, and where they may act anywhere a softer wing cannot be told from larger loads. At rest
they are known: the weight of the masses in the wing file. So a window at rest is what shows a wrong stiffness.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from reconstruct.equilibrium import solve
from reconstruct.loads_file import LoadsFile, loads_on
from reconstruct.reference import UNLOADED_WING
from reconstruct.rotation import Array
from reconstruct.tables import REFERENCE_POSITION
from reconstruct.wing import HalfWing, Wing

LEAST_HANG_SIGMAS = 3.0  # what hangs by less than this many sigmas says nothing of stiffness
DOUBTFUL_SIGMAS = 2.0  # a misfit that readers are warned of
_ROUNDS = 8  # of Newton's method for the stiffness
_STEP = 1e-3  # of it, relative
_STIFFEST = -0.9
_OUT_OF_PLANE = 2  # of stiffness_sigma's EA, GJ, EI_out, EI_in


@dataclass(frozen=True)
class Hang:
    """One half wing's tip at rest against the unloaded, weightless wing, along the way the model's weight moves it."""

    side: str
    measured_m: float
    sigma_m: float  # one sigma of it: noise, and what all frames share
    model_m: float
    softer: float  # the stiffness that hangs so is the wing file's by 1 + softer
    sigma_softer: float
    stated: float  # the wing file's own sigma of its out-of-plane bending stiffness, relative

    @property
    def misfit(self) -> float:
        """``softer`` in sigmas of measurement and stated stiffness together."""
        return self.softer / float(np.hypot(self.sigma_softer, self.stated))

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return {
            "tip_measured_mm": 1e3 * self.measured_m,
            "tip_sigma_mm": 1e3 * self.sigma_m,
            "tip_model_mm": 1e3 * self.model_m,
            "softer_percent": 100 * self.softer,
            "sigma_softer_percent": 100 * self.sigma_softer,
            "stated_sigma_percent": 100 * self.stated,
        }

    def sentence(self) -> str:
        """For people."""
        how = "softer" if self.softer > 0 else "stiffer"
        return (
            f"At rest the {self.side} tip hangs {1e3 * self.measured_m:.1f} ± {1e3 * self.sigma_m:.1f} mm, by the wing "
            f"file's weight {1e3 * self.model_m:.1f} mm: the wing is {100 * abs(self.softer):.1f} ± "
            f"{100 * self.sigma_softer:.1f} % {how} than its file ({100 * self.stated:.0f} % stated, "
            f"{abs(self.misfit):.1f} sigmas), or its weight is wrong, or more than its root held it."
        )


def hang(half: HalfWing, tip_m: Array, sigma_tip_m: Array) -> Hang | None:
    """What a tip at rest says, recorded at ``tip_m`` (3,), body frame, with one sigma (3,) an axis.

    None when the wing file has no masses, or they move the tip too little to be told from the tip's own error, or the
    model under weight has no equilibrium.
    """
    if not np.sum(half.mass_kg) > 0:
        return None
    model = _tip_m(half, 0.0)
    if model is None:
        return None
    way = model - half.rest_position_m[-1]
    model_m = float(np.linalg.norm(way))
    direction = way / max(model_m, 1e-12)
    measured_m = float(direction @ (tip_m - half.rest_position_m[-1]))
    sigma_m = float(np.linalg.norm(direction * sigma_tip_m))
    if model_m < LEAST_HANG_SIGMAS * sigma_m or model_m == 0.0:
        return None
    softer, slope_m = 0.0, model_m
    here: Array | None = model
    for _ in range(_ROUNDS):
        beside = _tip_m(half, softer + _STEP)
        if here is None or beside is None:
            return None
        slope_m = float(direction @ (beside - here)) / _STEP
        change = (measured_m - float(direction @ (here - half.rest_position_m[-1]))) / slope_m
        softer = max(_STIFFEST, softer + change)
        if abs(change) < _STEP:
            break
        here = _tip_m(half, softer)
    return Hang(
        half.side,
        measured_m,
        sigma_m,
        model_m,
        softer,
        sigma_m / abs(slope_m),
        float(half.stiffness_sigma[_OUT_OF_PLANE]),
    )


def recorded_hangs(wing: Wing, wings: pa.Table) -> list[Hang]:
    """Of the wings whose displacements are counted from a recorded shape; ``wings`` is unloaded.parquet."""
    found = []
    for row in wings.to_pylist():
        half = wing.half(row["side"])
        if row["reference"] != UNLOADED_WING and row["station"] == len(half.node_s_m) - 1:
            tip, sigma = (np.array([row[prefix + name] for name in REFERENCE_POSITION]) for prefix in ("", "sigma_"))
            found.append(hang(half, tip, sigma))
    return [one for one in found if one is not None]


def _tip_m(half: HalfWing, softer: float) -> Array | None:
    """Where the tip of a wing hangs that is so much softer than its file."""
    beam = replace(half.beam, stiffness=half.beam.stiffness / (1 + softer))
    found = solve(beam, loads_on(half, LoadsFile(gravity=True)))
    return found.shape.position_m[-1] if found.converged else None
