"""A live FR3 rig and peers that are none of its own: it drops them or refuses them, and serves on."""

import json
import math
import socket
import struct
import time
from contextlib import ExitStack

import pytest

pytest.importorskip("franky_sim", reason="needs pip install -e '.[fr3]'")

from deploy.devices.franka_probe import check_arm, check_hand
from rig.fr3.channel import PORT, REFUSED, Channel
from rig.fr3.process import Fr3Rig
from rig.fr3.scene import primitive

HOST = "127.0.0.72"
ROBOT, GRIPPER = 1337, 1338
HEADERS = {ROBOT: "<III", GRIPPER: "<HII"}
CONNECT, SET_LOAD, SET_COLLISION, GRIPPER_MOVE = 0, 9, 3, 3
WEB = b"GET / HTTP/1.1\r\nHost: arm\r\n\r\n"


@pytest.fixture(scope="module")
def rigs():
    with ExitStack() as stack:
        yield stack, []


@pytest.fixture
def rig(rigs):
    """One for all tests, and another after one that took it down."""
    stack, running = rigs
    if not running or not running[-1].running():
        stack.close()
        running.append(stack.enter_context(Fr3Rig(HOST, primitive("cube"))))
    return running[-1]


@pytest.fixture
def serves_on(rig):
    """Afterwards arm and hand answer, time has gone on from where it was, and the cube lies where it lay."""
    before = rig.channel.ask("state")
    yield
    assert rig.running()
    check_arm(HOST, "fr3")
    check_hand(HOST)
    after = rig.channel.ask("state")
    assert after["time_s"] > before["time_s"], "the world was begun anew"
    assert after["q_rad"] == pytest.approx(before["q_rad"], abs=2e-3)
    assert math.dist(after["object_position_m"], before["object_position_m"]) < 0.01


def message(port: int, command: int, payload: bytes, size: int | None = None) -> bytes:
    """One of the protocol's; `size` says another length than it has."""
    header = struct.Struct(HEADERS[port])
    return header.pack(command, 7, header.size + len(payload) if size is None else size) + payload


def is_dropped(client: socket.socket) -> bool:
    """Whether the rig hangs up, whatever it has said before."""
    client.settimeout(5.0)
    try:
        while client.recv(4096):
            pass
    except ConnectionError:
        pass
    except TimeoutError:
        return False
    return True


def connected(port: int, states: socket.socket) -> socket.socket:
    """A client as franky is one, whose states come to `states`."""
    client = socket.create_connection((HOST, port), 5.0)
    client.sendall(message(port, CONNECT, struct.pack("<HH", 3, states.getsockname()[1])))
    client.settimeout(5.0)
    assert len(client.recv(64)) == struct.calcsize(HEADERS[port]) + 8
    return client


@pytest.fixture
def states():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))  # as the clients below
        receiver.settimeout(5.0)
        yield receiver


@pytest.mark.parametrize("port", [ROBOT, GRIPPER])
@pytest.mark.parametrize(
    "said",
    [
        lambda port: WEB,
        lambda port: b"\x16\x03\x01\x02\x00" + bytes(range(40)),
        lambda port: bytes(12),
        lambda port: message(port, CONNECT, b"x"),
        lambda port: message(port, CONNECT, struct.pack("<HH", 3, 0)),
        lambda port: message(port, CONNECT, b"", size=3),
        lambda port: message(port, CONNECT, b"xxxx", size=2**32 - 1),
        lambda port: message(port, 99, b""),
        lambda port: b"",
        lambda port: message(port, CONNECT, b"")[:5],
    ],
    ids=["http", "tls", "zeros", "short", "no-port", "small", "large", "unknown", "silent", "half"],
)
def test_a_stray_connection_is_dropped(rig, serves_on, port, said):
    with socket.create_connection((HOST, port), 5.0) as client:
        client.sendall(said(port))
        assert is_dropped(client)


@pytest.mark.parametrize(
    ("port", "command", "payload"),
    [
        (ROBOT, SET_LOAD, struct.pack("<13d", math.nan, *[0.0] * 12)),
        (ROBOT, SET_LOAD, struct.pack("<13d", 1e300, *[0.0] * 12)),
        (ROBOT, SET_LOAD, b"short"),
        (ROBOT, SET_COLLISION, struct.pack("<52d", *[math.inf] * 52)),
        (ROBOT, 1, struct.pack("<II6d", 9, 9, *[0.0] * 6)),
        (GRIPPER, GRIPPER_MOVE, struct.pack("<dd", math.nan, 0.1)),
        (GRIPPER, GRIPPER_MOVE, b""),
    ],
    ids=["nan", "huge", "short", "inf", "mode", "gripper-nan", "gripper-short"],
)
def test_a_client_that_asks_for_nonsense_is_dropped(rig, serves_on, states, port, command, payload):
    with connected(port, states) as client:
        client.sendall(message(port, command, payload))
        assert is_dropped(client)


def test_datagrams_that_are_no_command_are_not_heard(rig, serves_on, states):
    """They may come from anywhere: the client whose port it is stays, and its own are heard whole."""
    with connected(ROBOT, states) as client:
        _, rig_s_port = states.recvfrom(4096)
        whole = struct.Struct("<Q7d7d16d6d2d??7d?")
        no_numbers = whole.pack(1, *[math.nan] * 38, False, False, *[math.nan] * 7, False)
        client.sendall(message(ROBOT, 1, struct.pack("<II6d", 2, 0, *[0.0] * 6)))  # by torques
        for said in (b"", b"x", bytes(1000), no_numbers):
            states.sendto(said, rig_s_port)
        time.sleep(0.3)
        assert rig.channel.ask("state")["in_motion"]
        states.sendto(whole.pack(2, *[0.0] * 38, False, True, *[0.0] * 7, True), rig_s_port)  # it ends
        end_s = time.monotonic() + 5.0
        while rig.channel.ask("state")["in_motion"] and time.monotonic() < end_s:
            time.sleep(0.01)
        assert not rig.channel.ask("state")["in_motion"]


@pytest.mark.parametrize(
    "line",
    [
        b"hello",
        b"[1]",
        b"\xff\xfe\x00",
        b"{}",
        b"[" * 20_000,
        b'{"ask": ' + b"1" * 5000 + b"}",
        b'{"ask": "place", "x_m": NaN, "y_m": 0, "yaw_rad": 0}',
        b'{"ask": "place", "x_m": 0.5, "y_m": 1e308, "yaw_rad": 0}',
        b'{"ask": "place", "x_m": 0.5, "y_m": "0", "yaw_rad": 0}',
        b'{"ask": "place", "x_m": 0.5, "y_m": 0, "yaw_rad": 1' + b"0" * 400 + b"}",
        b'{"ask": "disconnect", "seconds": 1' + b"0" * 400 + b"}",
        b'{"ask": "disconnect", "seconds": Infinity}',
        b'{"ask": "disconnect", "seconds": "x"}',
        b'{"ask": "slow", "on": [[[1]]]}',
    ],
    ids=lambda line: line[:40].decode(errors="replace"),
)
def test_a_request_for_nonsense_is_refused(rig, serves_on, line):
    with socket.create_connection((HOST, PORT), 5.0) as client:
        client.settimeout(10.0)
        file = client.makefile("rwb")
        for _ in range(2):  # the connection stays
            file.write(line + b"\n")
            file.flush()
            answer = json.loads(file.readline())
            assert list(answer) == [REFUSED] and "\n" not in answer[REFUSED] and len(answer[REFUSED]) < 300


def test_a_request_without_an_end_is_refused_and_dropped(rig, serves_on):
    with socket.create_connection((HOST, PORT), 5.0) as client:
        client.sendall(b"x" * 100_000)
        client.settimeout(10.0)
        assert REFUSED.encode() in client.makefile("rb").readline()
        assert is_dropped(client)


def test_a_refusal_disturbs_no_other_connection(rig):
    other = Channel(HOST)
    with socket.create_connection((HOST, PORT), 5.0) as client:
        client.sendall(WEB)
    other.ask("place", x_m=0.5, y_m=0.1, yaw_rad=0.0)
    assert other.ask("state")["object_position_m"][:2] == pytest.approx([0.5, 0.1], abs=1e-3)
    other.close()
