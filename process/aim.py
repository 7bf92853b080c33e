"""What is seen of the markers to what to do about aperture, exposure, focus and light.

The paper's lessons: an over-exposed marker has a starry halo and no circular shape any more (Fig. 11); in sunlight a
shorter exposure, 1 to 5 ms, isolates the markers (Fig. 12); matt white paint on the wing takes away their reflections
(Fig. 13).

Brightness is judged by the brightest markers: those of the wing's root are near and bright, its tip's far and faint.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

from process.json_file import finite_or_none
from process.look import Look

BRIGHTEST_GOOD = 190.0  # grey levels
BRIGHTEST_LOW, BRIGHTEST_HIGH = 100.0, 235.0
EXPOSURES_US = (1000, 5000)  # the paper's
BACKGROUND_BRIGHT = 40.0
EDGE_BLURRED_PX = 2.5
DIAMETER_SMALL_PX = 1.8
CIRCULARITY_LOW = 0.8  # the paper's gate
REFLECTION_SHARE = 0.1
HALO_SHARE = 0.15
SATURATED_SHARE = 0.1


@dataclass(frozen=True)
class Advice:
    """One thing to do. ``what`` is for programs: over_exposed, dim, sunlit, reflections, halo, blurred, small,
    not_round, no_markers, missing, extra."""

    what: str
    text: str


@dataclass(frozen=True, eq=False)
class Aim:
    """One camera's frame, judged."""

    place: str
    look: Look
    expected: int
    exposure_us: int | None
    """None: not known"""
    advice: tuple[Advice, ...]

    @property
    def good(self) -> bool:
        """Nothing is left to do."""
        return not self.advice

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``; what no spot tells is null."""
        look = self.look
        return {
            "camera": self.place,
            "good": self.good,
            "exposure_us": self.exposure_us,
            "markers": look.markers,
            "markers_expected": self.expected,
            "markers_saturated": look.saturated_markers,
            "saturated_share": look.saturated_share,
            "background": look.background,
            "background_high": look.background_high,
            "amplitude": finite_or_none(look.amplitude),
            "brightest": finite_or_none(look.brightest),
            "diameter_px": finite_or_none(look.diameter_px),
            "circularity": finite_or_none(look.circularity),
            "edge_px": finite_or_none(look.edge_px),
            "halo": finite_or_none(look.halo),
            "rejected": look.rejected,
            "advice": [asdict(advice) for advice in self.advice],
        }


def judge_look(place: str, look: Look, expected: int, exposure_us: int | None = None) -> Aim:
    """What to do for the camera ``place``, the most important first."""
    advice = [*_brightness(look, exposure_us), *_light(look), *_shape(look), *_count(look, expected)]
    return Aim(place, look, expected, exposure_us, tuple(advice))


def _brightness(look: Look, exposure_us: int | None) -> list[Advice]:
    if not look.markers:
        return []
    over = look.saturated_markers > SATURATED_SHARE * look.markers
    if over or look.brightest > BRIGHTEST_HIGH:
        text = (
            f"{look.saturated_markers} of {look.markers} markers are saturated: {_longer(look.brightest, exposure_us)}"
        )
        return [Advice("over_exposed", text)]
    if look.brightest < BRIGHTEST_LOW:
        return [Advice("dim", f"markers reach {look.brightest:.0f} of 255: {_longer(look.brightest, exposure_us)}")]
    return []


def _longer(brightest: float, exposure_us: int | None) -> str:
    """How to bring the brightest to where they are good: brightness goes with exposure × aperture area."""
    factor = BRIGHTEST_GOOD / max(brightest, 1.0)
    word = "longer" if factor > 1.0 else "shorter"
    if exposure_us is None:
        return f"expose {factor if factor > 1.0 else 1.0 / factor:.1f} times {word}"
    shortest, longest = EXPOSURES_US
    wanted_us = exposure_us * factor
    allowed_us = min(max(wanted_us, shortest), longest)
    steps: list[str] = []
    if not math.isclose(allowed_us, exposure_us, rel_tol=0.1):
        steps.append(f"set exposure_us to {_round(allowed_us)} (now {exposure_us})")
    stops = math.log2(wanted_us / allowed_us)
    if abs(stops) > 0.3:
        steps.append(f"{'open' if stops > 0.0 else 'close'} the aperture by {abs(stops):.1f} stops")
    return " and ".join(steps) or f"expose a little {word}"


def _round(exposure_us: float) -> int:
    return round(exposure_us / 100.0) * 100


def _light(look: Look) -> list[Advice]:
    found = []
    bright = max(look.background, look.background_high)
    if bright > BACKGROUND_BRIGHT:
        text = (
            f"the scene is bright, {look.background:.0f} to {look.background_high:.0f} of 255: expose shorter and "
            "drive the markers brighter, shade the lens, or put on the infrared filter"
        )
        found.append(Advice("sunlit", text))
    if look.reflections >= max(2.0, REFLECTION_SHARE * look.markers):
        text = f"{look.reflections} reflections off the wing: dust it with matt white paint"
        found.append(Advice("reflections", text))
    if look.halo > HALO_SHARE and not look.reflections:
        text = f"{100 * look.halo:.0f} % of the markers' light is halo: clean the lens; close the aperture"
        found.append(Advice("halo", text))
    return found


def _shape(look: Look) -> list[Advice]:
    found = []
    if look.edge_px > EDGE_BLURRED_PX:
        text = f"edges are {look.edge_px:.1f} px wide: turn the focus until that is least"
        found.append(Advice("blurred", text))
    if look.diameter_px < DIAMETER_SMALL_PX:
        text = f"markers are {look.diameter_px:.1f} px wide: open the aperture or turn the focus a little out"
        found.append(Advice("small", text))
    if look.circularity < CIRCULARITY_LOW:
        text = f"a marker's circularity is {look.circularity:.2f}: look for halos, covers and two markers in one"
        found.append(Advice("not_round", text))
    return found


def _count(look: Look, expected: int) -> list[Advice]:
    if not look.markers:
        if look.background > BACKGROUND_BRIGHT:
            return [Advice("no_markers", "no marker stands out from the bright scene: expose shorter")]
        return [Advice("no_markers", "no marker: are they lit and in view? open the aperture, expose longer")]
    if look.markers < expected:
        text = f"{look.markers} of {expected} markers: turn the camera until all are in view, however the wing bends"
        return [Advice("missing", text)]
    if look.markers > expected:
        text = f"{look.markers} lights where {expected} markers are expected: cover what shines besides"
        return [Advice("extra", text)]
    return []
