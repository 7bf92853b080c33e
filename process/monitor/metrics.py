"""Health to metrics in the text format of Prometheus (exposition format 0.0.4)."""

from collections.abc import Iterable, Mapping
from typing import Any

from capture.health import Health, Verdict

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_Sample = tuple[Mapping[str, str], float | None]


def metrics_text(health: Health | None, verdict: Verdict, pictures: Mapping[str, Mapping[str, Any]]) -> str:
    """All metrics; what is not known is left out.

    Args:
        health: the latest snapshot, however old.
        verdict: what it is worth now.
        pictures: figures of the latest pictures, by place, as ``Picture.figures`` gives them.
    """
    out = _Text()
    out.gauge("wingshape_go", "1: nothing stands against flying", [({}, float(verdict.go))])
    out.gauge("wingshape_health_age_seconds", "since the recorder wrote its health", [({}, verdict.age_s)])
    if health is not None:
        _recorder(out, health)
        _cameras(out, health)
        _disks(out, health)
        _rest(out, health)
    for key, name, what in (
        ("markers", "wingshape_markers_found", "in the latest preview"),
        ("saturated_markers", "wingshape_markers_saturated", "in the latest preview"),
        ("saturated_share", "wingshape_saturated_share", "of the latest preview's pixels"),
        ("background", "wingshape_background_level", "median of the latest preview, grey levels"),
    ):
        out.gauge(name, what, [(_place(place), figures[key]) for place, figures in pictures.items()])
    return out.text


class _Text:
    def __init__(self) -> None:
        self.text = ""

    def gauge(self, name: str, what: str, samples: Iterable[_Sample]) -> None:
        self._add("gauge", name, what, samples)

    def counter(self, name: str, what: str, samples: Iterable[_Sample]) -> None:
        self._add("counter", name, what, samples)

    def _add(self, kind: str, name: str, what: str, samples: Iterable[_Sample]) -> None:
        lines = [f"{name}{_labels(labels)} {float(value)!r}\n" for labels, value in samples if value is not None]
        if lines:
            self.text += f"# HELP {name} {what}\n# TYPE {name} {kind}\n{''.join(lines)}"


def _recorder(out: _Text, health: Health) -> None:
    out.gauge("wingshape_recording", "1: the recorder records", [({}, float(health.state == "recording"))])
    out.counter("wingshape_triggers_total", "by the board's count", [({}, health.triggers)])
    out.gauge("wingshape_trigger_rate_hertz", "over the last two seconds", [({}, health.trigger_rate_hz)])


def _cameras(out: _Text, health: Health) -> None:
    cameras = [({"side": camera.side, "camera": camera.name}, camera) for camera in health.cameras]
    out.counter("wingshape_frames_recorded_total", "in the files", [(at, c.recorded) for at, c in cameras])
    lost = [({**at, "stage": stage}, float(count)) for at, c in cameras for stage, count in c.lost.items()]
    out.counter("wingshape_frames_lost_total", "by the stage they were lost at", lost)
    for name, what, key in (
        ("wingshape_camera_rate_hertz", "frames that arrived, over the last two seconds", "rate_hz"),
        ("wingshape_camera_silent_seconds", "since the last frame arrived", "silent_s"),
        ("wingshape_camera_temperature_celsius", "as the camera tells", "temperature_c"),
        ("wingshape_ring_slots_in_use", "of the camera's ring", "ring_in_use"),
        ("wingshape_ring_slots", "of the camera's ring", "ring_slots"),
    ):
        out.gauge(name, what, [(at, getattr(camera, key)) for at, camera in cameras])


def _disks(out: _Text, health: Health) -> None:
    disks = [({"side": disk.side}, disk) for disk in health.disks]
    out.gauge("wingshape_disk_free_bytes", "to an unprivileged user", [(at, d.free_bytes) for at, d in disks])
    out.gauge(
        "wingshape_disk_minutes_left", "at this rate, down to the reserve", [(at, d.minutes_left) for at, d in disks]
    )
    out.gauge("wingshape_disk_queue", "items that wait for the disk", [(at, d.queued) for at, d in disks])
    out.gauge("wingshape_disk_write_seconds", "of the last frame", [(at, d.last_write_us / 1e6) for at, d in disks])
    out.gauge("wingshape_disk_failed", "1: failed", [(at, float(d.failure is not None)) for at, d in disks])


def _rest(out: _Text, health: Health) -> None:
    sensors = [({"sensor": name}, value) for name, value in health.temperatures_c.items()]
    out.gauge("wingshape_temperature_celsius", "of the computer", sensors)
    levels: dict[str, int] = {}
    for notice in health.diagnostics:  # a name may come twice: two gates, two notices of one part
        levels[notice.name] = max(notice.level, levels.get(notice.name, 0))
    out.gauge(
        "wingshape_diagnostic_level",
        "0 ok, 1 caution, 2 NO-GO, 3 stale",
        [({"name": name}, float(level)) for name, level in levels.items()],
    )
    offset_ns = ptp_offset_ns(health)
    offset_s = None if offset_ns is None else offset_ns / 1e9
    out.gauge("wingshape_ptp_offset_seconds", "of the clock from its master", [({}, offset_s)])


def ptp_offset_ns(health: Health) -> float | None:
    """The clock's offset from its master as the PTP watch tells it; None: it does not."""
    for notice in health.diagnostics:
        if notice.name == "ptp":
            try:
                return float(notice.values["offset_ns"])
            except (KeyError, ValueError):
                return None
    return None


def _place(place: str) -> dict[str, str]:
    side, _, camera = place.partition("/")
    return {"side": side, "camera": camera}


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items()) + "}"


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
