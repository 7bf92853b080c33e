"""Several flights, reconstructed in turn by one crew → a result folder each, and flights.json: what became of them."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from capture.errors import UsageError, WingshapeError
from process.flights import Flight
from process.json_file import provenance, write_json
from process.workers import Crew, crew, usable_cores
from reconstruct.result import read_json_object
from reconstruct.run import MODULES, Job, Progress, check_job, finished, run_job
from reconstruct.summary import verdict

FLIGHTS = "flights.json"
FIGURES = ("sets", "converged_percent", "markers_seen_percent", "residual_rms_mm", "sigma_tip_mm", "times_real_time")
State = Literal["done", "kept", "failed"]


@dataclass(frozen=True)
class Outcome:
    """What became of one flight."""

    flight: Flight
    out: Path
    state: State
    """kept: an earlier run had done the same to it, and got to its end"""
    summary: Mapping[str, Any] = field(default_factory=dict)
    """empty when it failed"""
    warnings: tuple[str, ...] = ()
    error: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Its entry in flights.json."""
        return {
            "flight": self.flight.name,
            "folders": [str(path) for path in self.flight.paths],
            "result": str(self.out),
            "state": self.state,
            **({"error": self.error} if self.error else {}),
            **{key: self.summary.get(key) for key in FIGURES if self.summary},
            "warnings": list(self.warnings),
        }


def run_flights(job: Job, flights: Sequence[Flight], progress: Progress = lambda _: None) -> Iterator[Outcome]:
    """Do ``job`` to each flight, into a folder of its name in ``job.out``; flights.json is kept up to date.

    A flight that fails is told as such, and the next one begun. One that an earlier run had done, from the same files
    with the same options, is kept as it is.

    Raises:
        UsageError, ProcessError: what concerns all flights cannot be used: wing, rig, cluster.
    """
    check_job(job)
    job.out.mkdir(parents=True, exist_ok=True)
    kept = _done_alike(job)
    outcomes: list[Outcome] = []
    with ExitStack() as working:
        hands = _hire(job, working)
        for flight in flights:
            own = replace(job, flights=flight.paths, out=job.out / flight.name)
            try:
                outcome = _one(own, flight, hands, progress, may_keep=flight.name in kept)
            except (WingshapeError, OSError) as error:
                outcome = Outcome(flight, own.out, "failed", error=" ".join(str(error).split()))
            outcomes.append(outcome)
            kept.pop(flight.name, None)
            write_json(
                job.out / FLIGHTS, _ledger(job, outcomes, [kept[one.name] for one in flights if one.name in kept])
            )
            yield outcome
            if outcome.state == "failed" and flight is not flights[-1]:
                working.close()  # a worker may have died, or be busy still with what nobody waits for
                hands = _hire(job, working)


def outcome_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """The same as a table to read: a line a flight, below a heading."""
    width = max(len("flight"), *(len(outcome.flight.name) for outcome in outcomes))
    lines = [f"{'flight':<{width}}  {'sets':>7}  fitted %  seen %  tip sigma mm  × real time  verdict"]
    for outcome in outcomes:
        one, name = outcome.summary, f"{outcome.flight.name:<{width}}"
        if outcome.state == "failed":
            lines.append(f"{name}  failed: {outcome.error}")
            continue
        times = "" if one["times_real_time"] is None else f"{one['times_real_time']:.1f}"
        word = verdict(one)[0] + (" Kept." if outcome.state == "kept" else "")
        lines.append(
            f"{name}  {one['sets']:>7}  {one['converged_percent']:>8.2f}  {one['markers_seen_percent']:>6.2f}  "
            f"{one['sigma_tip_mm']:>12.2f}  {times:>11}  {word}"
        )
    return lines


def _one(job: Job, flight: Flight, hands: Crew, progress: Progress, *, may_keep: bool) -> Outcome:
    if may_keep and (summary := finished(job)) is not None:
        return Outcome(flight, job.out, "kept", summary)
    summary, warnings = run_job(job, lambda step: progress(replace(step, stage=f"{flight.name} {step.stage}")), hands)
    return Outcome(flight, job.out, "done", summary, warnings)


def _hire(job: Job, working: ExitStack) -> Crew:
    return working.enter_context(crew(job.workers or usable_cores(), job.scheduler, MODULES))


def _ledger(job: Job, outcomes: Sequence[Outcome], to_come: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        **provenance(job.command, []),
        "options": _options(job),
        "failed": sum(outcome.state == "failed" for outcome in outcomes),
        "flights": [*(outcome.as_dict() for outcome in outcomes), *to_come],
    }


def _options(job: Job) -> dict[str, Any]:
    """What files a result has, beyond what its own summary says of how it was made."""
    force = None if job.specific_force is None else list(job.specific_force.names)
    wanted = {"csv": job.csv, "also": list(job.also), "report": job.report}
    return {**wanted, "max_gap_s": job.max_gap_s, "specific_force": force}


def _done_alike(job: Job) -> dict[str, dict[str, Any]]:
    """By name, what flights.json says of the flights that an earlier run with the same options got done."""
    try:
        known = read_json_object(job.out / FLIGHTS, "")
    except UsageError:
        return {}
    if known.get("options") != _options(job):
        return {}
    return {entry["flight"]: entry for entry in known["flights"] if entry["state"] != "failed"}
