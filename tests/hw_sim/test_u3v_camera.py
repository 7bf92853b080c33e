"""The USB3 Vision camera without its plug: registers, the XML that describes them, frames on edges, a full buffer."""

import struct
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from capture.errors import UsageError
from hw_sim import u3v_camera
from hw_sim.u3v_camera import FEATURES, REGISTERS, SIRM, AccessError, Counts, Kind, U3vCamera, pattern
from hw_sim.u3v_rig import UsbFault

NAMESPACE = "{http://www.genicam.org/GenApi/Version_1_1}"
POWER_UP_NS = 1_000_000_000


def camera(buffer_frames: int = 0) -> U3vCamera:
    return U3vCamera(1, "17490001", POWER_UP_NS, 20, Counts(), Kind(buffer_frames))


def put(device: U3vCamera, name: str, value: float) -> None:
    register = REGISTERS[name]
    device.write(FEATURES + register.at, struct.pack("<" + register.format, value), POWER_UP_NS)


def get(device: U3vCamera, name: str) -> float:
    register = REGISTERS[name]
    return struct.unpack("<" + register.format, device.read(FEATURES + register.at, struct.calcsize(register.format)))[
        0
    ]


def taking(buffer_frames: int = 0) -> U3vCamera:
    """A camera of 64×48 that waits for edges."""
    device = camera(buffer_frames)
    for name, value in {"Width": 64, "Height": 48, "TriggerMode": 1, "AcquisitionStart": 1}.items():
        put(device, name, value)
    device.write(SIRM + 4, struct.pack("<I", 1), POWER_UP_NS)
    return device


def test_the_xml_describes_the_registers_that_there_are():
    root = ElementTree.fromstring(u3v_camera.XML)
    described = {}
    for kind, formats in (("IntReg", "IQ"), ("FloatReg", "d")):
        for node in root.iter(NAMESPACE + kind):
            if node.findtext(NAMESPACE + "pPort") != "Device":  # in the chunk data, not in a register
                continue
            name = node.attrib["Name"].removesuffix("Reg")
            described[name] = int(node.findtext(NAMESPACE + "Address"), 16) - FEATURES
            register = REGISTERS[name]
            assert register.format in formats
            assert int(node.findtext(NAMESPACE + "Length")) == struct.calcsize(register.format)
            assert (node.findtext(NAMESPACE + "AccessMode") == "RO") == (register.allowed is None)
    assert described == {name: register.at for name, register in REGISTERS.items()}
    names = {node.attrib["Name"] for node in root.iter() if "Name" in node.attrib}
    for node in root.iter():
        if node.tag.removeprefix(NAMESPACE) in ("pFeature", "pValue", "pMax", "pVariable", "pPort", "pSelected"):
            assert node.text in names


def test_settings_are_kept_in_the_steps_that_the_device_can_do():
    device = camera()
    put(device, "ExposureTime", 1234.7)
    assert get(device, "ExposureTime") == 1234.5
    put(device, "Width", 1050)
    assert get(device, "Width") == 1040
    (payload,) = struct.unpack("<Q", device.read(SIRM + 8, 8))
    assert payload == 1040 * 1552


@pytest.mark.parametrize(
    ("name", "value"), [("Width", 4096), ("ExposureTime", 1.0), ("PixelFormat", 7), ("SensorWidth", 100)]
)
def test_what_it_cannot_do_it_refuses(name, value):
    with pytest.raises(AccessError):
        put(camera(), name, value)
    with pytest.raises(AccessError):
        camera().read(0x900000, 4)


def test_an_edge_gives_a_frame_with_the_devices_own_time():
    device = taking()
    device.edge(12, POWER_UP_NS + 10**9)
    frame = device.next_frame(0.0)
    magic, _, size, frame_id, _, kind, ticks, pixel_format, width, height = struct.unpack_from(
        "<IHHQHHQIII", frame.leader
    )
    assert (magic, size, frame_id, kind, pixel_format, width, height) == (
        *(int.from_bytes(b"U3VL", "little"), 52, 0, 1, 0x01080001, 64, 48),
    )
    assert ticks == 10**9 + 20_000  # 20 ppm fast
    k = np.arange(64 * 48)
    assert np.array_equal(np.frombuffer(frame.payload, np.uint8), (k + 17 * 12 + 60 * 1) % 251)
    assert frame.trailer[:4] == b"U3VT"
    assert struct.unpack_from("<Q", frame.trailer, 20) == (64 * 48,)


def test_chunk_data_follows_the_pixels():
    """Little-endian, as USB3 Vision wants it: each chunk, the image among them, and then its id and its length."""
    device = taking()
    for name, value in {"ChunkModeActive": 1, "ChunkSelector": 0, "ChunkEnable": 1}.items():
        put(device, name, value)
    for selector in (1, 2):
        put(device, "ChunkSelector", selector)
        assert get(device, "ChunkEnable") == 0
        put(device, "ChunkEnable", 1)
    size = 64 * 48
    assert get(device, "PayloadSize") == size + 8 + 3 * 16
    device.edge(5, POWER_UP_NS)
    frame = device.next_frame(0.0)
    assert struct.unpack_from("<H", frame.leader, 18) == (0x4001,)
    assert bytes(frame.payload[:size]) == bytes(pattern(1, 5, size))
    assert struct.unpack("<IIdIIdIIQII", frame.payload[size:]) == (
        *(0x1000, size, 10_005.0, 0x1001, 8, 0.1, 0x1002, 8, 1, 0x1003, 8),
    )
    assert struct.unpack_from("<Q", frame.trailer, 20) == (len(frame.payload),)
    put(device, "ChunkModeActive", 0)
    device.sent(frame)
    device.edge(6, POWER_UP_NS)
    assert len(device.next_frame(0.0).payload) == get(device, "PayloadSize") == size


def test_no_frame_before_the_start_nor_on_another_line():
    device = taking()
    put(device, "TriggerSource", 2)
    device.edge(0, POWER_UP_NS)
    put(device, "TriggerSource", 0)
    put(device, "AcquisitionStop", 1)
    device.edge(1, POWER_UP_NS)
    assert device.next_frame(0.0) is None
    assert device.counts == Counts()


def test_a_full_buffer_costs_frames_and_their_ids():
    device = taking(buffer_frames=2)
    device.hold_until(4)
    for index in range(6):
        device.edge(index, POWER_UP_NS + index * 10**8)
        if index == 4:  # the host fetches again
            for _ in range(2):
                device.sent(device.next_frame(0.0))
    last = device.next_frame(0.0)
    assert struct.unpack_from("<Q", last.leader, 8) == (5,)
    assert device.counts == Counts(exposed=6, sent=2, overflowed=3)


def test_half_a_frame_says_that_it_is_whole():
    """As on a real wire, where the camera does not know what was lost."""
    device = taking()
    device.cut_short(3)
    device.edge(3, POWER_UP_NS)
    frame = device.next_frame(0.0)
    assert len(frame.payload) == 64 * 48 // 2
    assert struct.unpack_from("<Q", frame.trailer, 20) == (64 * 48,)


def test_the_pattern_tells_triggers_apart():
    seen = {bytes(pattern(number, index, 16)) for number in range(4) for index in range(251)}
    assert len(seen) == 251  # the number shifts the pattern: told apart within one camera
    assert pattern(0, 5, 64) != pattern(1, 5, 64)


def test_faults_are_read_or_refused():
    assert UsbFault.parse("2:hold@30-39") == UsbFault(2, "hold", 30, 39)
    assert UsbFault.parse("0:unplug@40") == UsbFault(0, "unplug", 40, 40)
    for text in ("0:hold@3", "0:unplug@3-4", "5", "0:burn@3"):
        with pytest.raises(UsageError):
            UsbFault.parse(text)
