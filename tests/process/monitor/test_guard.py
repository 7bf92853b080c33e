"""Who is let in, what is let out, and what strangers may send: nothing of it stops the monitor or the recorder."""

import contextlib
import http.client
import json
import os
import random
import re
import signal
import socket
import stat
import subprocess
import time
from pathlib import Path

import pytest
from field import Field, basic, command
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from capture.health import Health, Notice, judge, write_health

TOKEN = "0123456789abcdef0123456789abcdef"
PATHS = [
    "/",
    "/monitor.js",
    "/monitor.css",
    "/api/status",
    "/api/thumbnail/left/cam0",
    "/metrics",
    "/api/control",
    "/nonsense",
]


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    path = tmp_path / "monitor.token"
    path.write_text(TOKEN + "\n")
    path.chmod(0o600)
    return path


@pytest.fixture
def open_monitor(field: Field) -> Field:
    """Without a token, on loopback."""
    field.start_monitor()
    return field


@pytest.mark.parametrize(
    "authorization",
    [
        None,
        "",
        "Bearer",
        "Bearer ",
        f"Bearer {TOKEN[:-1]}",
        f"Bearer {TOKEN}0",
        f"bearer{TOKEN}",
        f"Digest {TOKEN}",
        f"Basic {TOKEN}",
        "Basic Og==",
        "Basic ÿÿ",
        "Bearer " + "é" * 32,
    ],
)
def test_who_lacks_the_token_is_told_nothing(secured, authorization):
    for path in PATHS:
        connection = http.client.HTTPConnection(secured.address.removeprefix("http://"), timeout=10)
        connection.putrequest("GET", path)
        if authorization is not None:
            connection.putheader("authorization", authorization.encode("latin-1"))
        connection.endheaders()
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (401, b"")
        told = {name.lower() for name, _ in answer.getheaders()}
        assert not told & {"set-cookie", "server", "date", "x-powered-by"}
        assert "test_07" not in str(answer.getheaders())
        connection.close()


@pytest.fixture(scope="module")
def secured(tmp_path_factory):
    """A monitor with a token; one for all that only asks."""
    from field import field_in

    folder = tmp_path_factory.mktemp("secured")
    token = folder / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    with field_in(folder) as field:
        field.health.mkdir()
        field.start_monitor("--token-file", token)
        yield field


def test_the_token_opens_both_ways(secured):
    for headers in ({"authorization": f"Bearer {TOKEN}"}, basic(TOKEN), {"authorization": f"bEaReR {TOKEN}"}):
        code, told, body = secured.get("/", headers=headers)
        assert code == 200
        assert b"<title>wingshape</title>" in body
        assert told["content-security-policy"].startswith("default-src 'none'; script-src 'self'")
        assert told["x-content-type-options"] == "nosniff"
        assert told["cache-control"] == "no-store"
        assert told["set-cookie"] is None
    assert secured.get("/nonsense", TOKEN)[0] == 404


def test_the_token_is_in_no_answer(secured):
    write_health(secured.health, Health("f", "recording", 0.0, 0, 0.0, (), (), ()))
    for path in PATHS:
        _, headers, body = secured.get(path, TOKEN)
        assert TOKEN not in str(headers)
        assert TOKEN.encode() not in body


def test_a_page_from_elsewhere_whose_name_was_bound_to_us_is_not_us(open_monitor):
    assert open_monitor.get("/api/status", headers={"host": "evil.example"})[0] == 421
    assert open_monitor.get("/api/status", headers={"host": "localhost:1"})[0] == 200


def test_control_wants_our_own_page_and_says_why_not(open_monitor):
    write_health_now(open_monitor)
    connection = http.client.HTTPConnection(open_monitor.address.removeprefix("http://"), timeout=10)

    def post(body: bytes, **headers: str) -> tuple[int, bytes]:
        connection.request("POST", "/api/control", body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()

    ours = {"content-type": "application/json", "x-wingshape": "monitor"}
    assert post(b"{}")[0] == 415
    assert post(b"{}", **{"content-type": "text/plain", "x-wingshape": "monitor"})[0] == 415
    for body in (b"", b"{", b"[]", b"7", b'{"action": "stop"}', b'{"action": "format", "flight": "f"}', b"[" * 900):
        assert post(body, **ours)[0] == 400
    code, said = post(b'{"action": "stop", "flight": "f"}', **ours)
    assert (code, list(json.loads(said))) == (409, ["message"])
    connection.close()


def test_a_body_beyond_bounds_is_refused(open_monitor):
    host, port = open_monitor.address.removeprefix("http://").split(":")
    for head, body in (
        (b"content-length: 1000000\r\n", b""),
        (b"transfer-encoding: chunked\r\n", b"1000\r\n" + b"x" * 4096 + b"\r\n0\r\n\r\n"),
    ):
        with socket.create_connection((host, int(port)), timeout=10) as connection:
            connection.sendall(
                b"POST /api/control HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
                b"x-wingshape: monitor\r\n" + head + b"\r\n" + body
            )
            assert connection.recv(4096).startswith(b"HTTP/1.1 413")


def test_who_asks_too_often_waits(open_monitor):
    codes = {open_monitor.get("/api/status")[0] for _ in range(400)}
    assert codes == {200, 429}
    time.sleep(1.0)
    assert open_monitor.get("/api/status")[0] == 200


@pytest.mark.slow
def test_half_requests_and_too_many_connections_are_hung_up_on(open_monitor):
    host, port = open_monitor.address.removeprefix("http://").split(":")
    slow = [socket.create_connection((host, int(port)), timeout=30) for _ in range(70)]
    slow[0].sendall(b"GET / HTTP/1.1\r\nhost: loc")
    time.sleep(0.3)
    closed = 0
    for connection in slow:
        connection.setblocking(False)
        try:
            closed += connection.recv(1) == b""
        except BlockingIOError:
            pass
        except ConnectionResetError:
            closed += 1
    assert closed >= 6  # beyond 64 of one client
    slow[0].settimeout(25)
    with contextlib.suppress(ConnectionResetError):
        assert slow[0].recv(1) == b""
    for connection in slow:
        connection.close()
    assert open_monitor.get("/api/status")[0] == 200


def send(address: str, data: bytes) -> None:
    host, port = address.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=5) as connection:
        try:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(65536):
                pass
        except (ConnectionError, TimeoutError):
            pass


REQUESTS = st.one_of(
    st.binary(max_size=2000),
    st.builds(
        lambda method, path, headers, body: (
            method + b" /" + path + b" HTTP/1.1\r\nhost: localhost\r\n" + headers + b"\r\n\r\n" + body
        ),
        st.sampled_from([b"GET", b"POST", b"HEAD", b"PUT", b"OPTIONS", b"TRACE", b"CONNECT", b"\xff"]),
        st.one_of(
            st.sampled_from([path[1:].encode() for path in PATHS]),
            st.binary(max_size=60),
            st.sampled_from([b"api/thumbnail/../../etc/passwd", b"api/thumbnail/%2e%2e/x", b"%00", b"?" * 900, b"//"]),
        ),
        st.sampled_from(
            [
                b"content-type: application/json\r\nx-wingshape: monitor\r\ncontent-length: 9",
                b"content-length: -1",
                b"content-length: 99999999999999999999999",
                b"transfer-encoding: chunked",
                b"upgrade: websocket\r\nconnection: upgrade\r\nsec-websocket-key: x\r\nsec-websocket-version: 13",
                b"authorization: Basic \xff\xfe",
                b"authorization: Bearer " + b"x" * 4000,
                b"expect: 100-continue\r\ncontent-length: 5",
            ]
        ),
        st.binary(max_size=300),
    ),
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(REQUESTS)
def test_no_request_brings_it_down(secured, request_bytes):
    send(secured.address, request_bytes)
    assert secured.processes["monitor"].poll() is None


def test_rubbish_after_the_answer_is_hung_up_on(secured):
    """The head of a request is answered before its body has come; the body then is none."""
    host, port = secured.address.removeprefix("http://").split(":")
    for _ in range(3):
        with socket.create_connection((host, int(port)), timeout=5) as connection:
            connection.sendall(b"GET /metrics HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n")
            assert b"401" in connection.recv(4096)
            with contextlib.suppress(ConnectionError):
                connection.sendall(b"no chunk\r\n\r\n")
                while connection.recv(4096):
                    pass


def test_after_all_that_it_answers_and_has_complained_of_nothing(secured):
    rng = random.Random(7)
    for _ in range(50):
        send(secured.address, rng.randbytes(3000))
    time.sleep(1.5)
    assert secured.get("/metrics", TOKEN)[0] == 200
    assert "Traceback" not in secured.said("monitor")


def test_fuzzed_requests_behind_the_token_leave_no_traceback(open_monitor):
    rng = random.Random(8)
    write_health_now(open_monitor)
    for k in range(100):
        path = rng.choice(
            ["api/thumbnail/" + "%" + rng.randbytes(3).hex(), "api/status?" + "a" * k, "%ff%fe/x", "api/control"]
        )
        method = rng.choice(["GET", "POST", "DELETE"])
        body = rng.randbytes(rng.randrange(0, 900))
        send(
            open_monitor.address,
            f"{method} /{path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
            f"x-wingshape: monitor\r\ncontent-length: {len(body)}\r\n\r\n".encode()
            + body,
        )
    time.sleep(1.0)
    assert open_monitor.get("/api/status")[0] == 200
    assert "Traceback" not in open_monitor.said("monitor")


@pytest.mark.parametrize("junk", [b"", b"{}", b'{"format": "wingshape health", "version": 1}', os.urandom(300)])
def test_junk_in_the_health_folder_is_no_go_and_no_crash(open_monitor, junk):
    open_monitor.health.mkdir()
    (open_monitor.health / "health.json").write_bytes(junk)
    status = open_monitor.status()
    assert not status["go"]
    assert "health.json" in status["reasons"][0]["message"]


def test_metrics_are_what_a_scraper_takes(open_monitor):
    write_health_now(open_monitor, 'a "quoted" \\ name\n')
    code, headers, body = open_monitor.get("/metrics")
    assert code == 200
    assert headers["content-type"].startswith("text/plain; version=0.0.4")
    names, sample = (
        set(),
        re.compile(r'^([a-z_]+)(\{[a-z]+="(?:[^"\\\n]|\\["\\n])*"(,[a-z]+="(?:[^"\\\n]|\\["\\n])*")*\})? (\S+)$'),
    )
    for line in body.decode().splitlines():
        if line.startswith("# TYPE "):
            names.add(line.split()[2])
        elif not line.startswith("#"):
            found = sample.match(line)
            assert found, line
            assert found[1] in names
            float(found[4])
    assert {"wingshape_go", "wingshape_triggers_total", "wingshape_diagnostic_level"} <= names
    assert 'wingshape_diagnostic_level{name="a \\"quoted\\" \\\\ name\\n"} 2.0' in body.decode()


def write_health_now(field: Field, name: str = "ptp") -> None:
    field.health.mkdir(exist_ok=True)
    notice = Notice(2, name, "no master", {"offset_ns": "1200"})
    health = Health("f", "recording", 1.0, 25, 25.0, (), (), (notice,), written_monotonic_s=time.monotonic())
    assert not judge(health, time.monotonic()).go
    write_health(field.health, health)


def refused(*words: object) -> str:
    answer = subprocess.run(command("process", "monitor", *words), capture_output=True, text=True, timeout=60)
    assert answer.returncode == 2, answer.stderr
    assert "Traceback" not in answer.stderr
    return answer.stderr


def test_beyond_loopback_only_with_a_token(token_file, tmp_path):
    assert "--token-file" in refused("--host", "0.0.0.0", "--port", 0)
    assert "--token-file" in refused("--host", "::", "--port", 0)
    assert "no such" in refused("--token-file", tmp_path / "none").lower()
    token_file.chmod(0o644)
    assert "chmod 600" in refused("--token-file", token_file)
    token_file.chmod(0o600)
    token_file.write_text("short\n")
    assert "openssl rand" in refused("--token-file", token_file)
    assert "go together" in refused("--certificate", tmp_path / "c.pem")


def test_a_port_in_use_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "cannot listen" in refused("--port", taken.getsockname()[1])


def test_the_token_of_the_service_manager_is_used(field, token_file, monkeypatch, tmp_path):
    (tmp_path / "credentials").mkdir()
    token_file.rename(tmp_path / "credentials/token")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / "credentials"))
    field.start_monitor("--host", "0.0.0.0")
    assert field.get("/api/status")[0] == 401
    assert field.get("/api/status", TOKEN)[0] == 200


def test_it_ends_when_told_to(open_monitor):
    connection = http.client.HTTPConnection(open_monitor.address.removeprefix("http://"), timeout=10)
    connection.request("GET", "/")  # a connection that stays open
    connection.getresponse().read()
    begin_s = time.monotonic()
    assert open_monitor.end("monitor") in (0, -signal.SIGTERM)
    assert time.monotonic() - begin_s < 5.0
    connection.close()


def test_the_token_file_the_test_uses_is_private(token_file):
    assert stat.S_IMODE(token_file.stat().st_mode) == 0o600
