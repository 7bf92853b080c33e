"""A booted container with the service installed by our own command, on a simulated rig of small images."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest
from nspawn import PREFIX, Machine, machine, wait_for

RIG_UNIT = f"""[Service]
Type=exec
User=wingshape
RuntimeDirectory=rig
WorkingDirectory=/run/rig
ExecStart={PREFIX}/bin/wingsim rig --world /var/lib/rig/world.toml --socket rig.sock --trigger-port trigger
"""
DISK_MB = 400
RIGHTS = """[Service]
AmbientCapabilities=CAP_SYS_NICE CAP_IPC_LOCK
CapabilityBoundingSet=CAP_SYS_NICE CAP_IPC_LOCK
"""
"""For a machine whose root may not raise limits (a container in a container): the same rights by capability."""


def recorder_config(extra: str = "") -> str:
    """For the simulated rig; the disks are the paths that the units know."""
    cameras = "".join(
        f'[[cameras]]\nside = "{side}"\nname = "{name}"\naddress = "/run/rig/rig.sock#{side}_{name}"\n'
        for side, name in itertools.product(("left", "right"), ("cam0", "cam1"))
    )
    return (
        '[trigger]\nport = "/run/rig/trigger"\n[ptp]\nsocket = "/run/wingshape-ptp/ptp4l"\n'
        '[disks]\nleft = "/mnt/ssd_left"\nright = "/mnt/ssd_right"\nreserve_mb = 5\nsegment_mb = 20\n'
        "[ring]\nstall_s = 0.5\n"
        "[threads]\nread_priority = 40\nwrite_priority = 30\ncontrol_priority = 20\nwrite_cpus = [1]\n"
        f'[camera]\nbackend = "simulated"\nwidth = 260\nheight = 194\n{cameras}{extra}'
    )


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """Booted, `wingcap install --enable` done, disks mounted, rig running; the recorder not started."""
    with machine(tmp_path_factory.mktemp("machine")) as found:
        found.boot()
        found.ask(PREFIX / "bin/wingcap", "install", "--enable")
        for side in ("left", "right"):
            found.ask("mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", f"/mnt/ssd_{side}")
            found.ask("chown", "wingshape:", f"/mnt/ssd_{side}")
        found.ask(PREFIX / "bin/wingsim", "world", "-o", "/var/lib/rig/world.toml", "--scale", 8)
        write(found, "etc/systemd/system/rig.service", RIG_UNIT)
        write(found, "etc/wingshape/wingcap.toml", recorder_config())
        if not may_raise_limits():
            write(found, "etc/systemd/system/wingcap.service.d/rights.conf", RIGHTS)
        write(found, "etc/systemd/system/wingshape-ptp4l.service.d/rights.conf", PTP_RIGHTS)
        write(found, "etc/wingshape/ptp.env", "PTP_INTERFACE=lo\n")
        ptp = found.root / "etc/wingshape/ptp4l.conf"
        ptp.write_text(ptp.read_text().replace("time_stamping hardware", "time_stamping software"))
        found.ask("systemctl", "daemon-reload")
        found.ask("systemctl", "start", "rig")
        wait_for(lambda: found.run("test", "-S", "/run/rig/rig.sock").returncode == 0, 20.0)
        yield found


PTP_RIGHTS = """[Service]
AmbientCapabilities=
AmbientCapabilities=CAP_NET_ADMIN CAP_NET_BIND_SERVICE CAP_NET_RAW
CapabilityBoundingSet=
CapabilityBoundingSet=CAP_NET_ADMIN CAP_NET_BIND_SERVICE CAP_NET_RAW
"""
"""A container has no right to set its machine's clock."""


def may_raise_limits() -> bool:
    """Whether this machine's root has CAP_SYS_RESOURCE."""
    status = Path("/proc/self/status").read_text()
    return bool(int(status.split("CapBnd:")[1].split()[0], 16) & 1 << 24)


def write(where: Machine, path: str, text: str) -> None:
    """A file of the container."""
    (where.root / path).parent.mkdir(parents=True, exist_ok=True)
    (where.root / Path(path)).write_text(text)
