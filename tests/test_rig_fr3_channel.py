"""The side channel's client and what answers at its port that is no FR3 rig, or a rig that is not well."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from ddgrasp.errors import UserError
from deploy.devices.fr3_imager import Fr3Imager
from rig.fr3 import channel
from rig.fr3.channel import Channel

HOST = "127.0.0.74"
NO_RIG = "^What answers there is no FR3 rig: name its address, on this machine --host 127.0.0.1.$"
SCENE = '<mujoco><worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
DEEP = f"<mujoco><worldbody/>{'<a>' * 2000}{'</a>' * 2000}</mujoco>"
STATE = {"qpos": [0.0] * 7, "object_position_m": [0.0] * 3}


@contextmanager
def answering(monkeypatch, *said: bytes) -> Iterator[None]:
    """Something that takes one connection and answers a line each to what it is asked."""

    def answer(server: socket.socket) -> None:
        client, _ = server.accept()
        with client, client.makefile("rb") as asked:
            for line, _ in zip(said, asked, strict=False):
                try:
                    client.sendall(line)
                except OSError:  # whoever asked has had enough
                    return

    with socket.create_server((HOST, 0)) as server:
        monkeypatch.setattr(channel, "PORT", server.getsockname()[1])
        threading.Thread(target=answer, args=(server,), daemon=True).start()
        yield


def line(**values) -> bytes:
    return json.dumps(values).encode() + b"\n"


@pytest.mark.parametrize(
    "said",
    [
        b"HTTP/1.1 400 Bad Request\r\n",
        b"\xff\xfe\x00garbage\n",
        b"[" * 100_000 + b"\n",
        b"1" * 5000 + b"\n",
        b'{"xml": ' + b"1" * 5000 + b"}\n",
        b"[]\n",
        line(a=1),
        line(xml="<a/>"),
        line(xml=5, object="cube"),
        line(xml="<a/>", object=[]),
    ],
    ids=lambda said: repr(said[:20]),
)
def test_what_answers_no_scene_is_no_rig(monkeypatch, said):
    with answering(monkeypatch, said):
        client = Channel(HOST)
        with pytest.raises(UserError, match=NO_RIG):
            client.scene()
        client.close()


@pytest.mark.parametrize(
    "changed",
    [
        {"qpos": None},
        {"qpos": 0.0},
        {"qpos": [0.0, "1"]},
        {"qpos": [10**400]},
        {"qpos": [float("nan")]},
        {"object_position_m": [0.0, 0.0]},
        {"object_position_m": [0.0, 0.0, float("inf")]},
    ],
    ids=lambda changed: repr(changed)[:30],
)
def test_what_answers_no_state_is_no_rig(monkeypatch, changed):
    with answering(monkeypatch, line(**STATE | changed)):
        client = Channel(HOST)
        with pytest.raises(UserError, match=NO_RIG):
            client.ask("state")
        client.close()


def test_an_answer_without_an_end_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(channel, "LONGEST_ANSWER", 1000)
    with answering(monkeypatch, b"x" * 10_000):
        client = Channel(HOST)
        with pytest.raises(UserError, match=NO_RIG):
            client.scene()
        client.close()


def test_a_refusal_is_one_line_however_long(monkeypatch):
    with answering(monkeypatch, line(refused="a\nb" + "c" * 10_000)):
        client = Channel(HOST)
        with pytest.raises(
            UserError, match="^the FR3 rig refuses a bc+: is it of another version"
        ) as refused:
            client.ask("state")
        assert len(str(refused.value)) < 400
        client.close()


def test_whole_answers_are_as_they_were_said(monkeypatch):
    with answering(monkeypatch, line(xml=SCENE, object="Würfel"), line(**STATE, more=None)):
        client = Channel(HOST)
        assert client.scene() == {"xml": SCENE, "object": "Würfel"}
        assert client.ask("state") == STATE | {"more": None}
        client.close()


@pytest.mark.parametrize(
    "xml",
    ["<a>", "", "<a/>", "<mujoco><worldbody><geom size='x'/></worldbody></mujoco>", "\ud800", DEEP],
    ids=["open", "empty", "no-world", "no-number", "surrogate", "deep"],
)
def test_a_scene_that_mujoco_does_not_read_is_one_line(monkeypatch, xml):
    with answering(monkeypatch, line(xml=xml, object="cube")):
        camera = Fr3Imager(HOST, np.eye(4))
        with pytest.raises(UserError, match=r"^the FR3 rig's scene is none that MuJoCo reads \(") as refused:
            camera.start()
        assert "\n" not in str(refused.value)
        camera.stop()


def test_a_state_of_another_scene_is_one_line(monkeypatch, open_gl):
    answers = [line(xml=SCENE, object="cube"), line(), line(**STATE | {"qpos": [0.0]}), line()]
    with answering(monkeypatch, *answers):
        camera = Fr3Imager(HOST, np.eye(4))
        camera.start()
        with pytest.raises(
            UserError, match=r"state has 1 joint values, its scene 7: is it of another version\?"
        ):
            camera.picture()
        camera.stop()
