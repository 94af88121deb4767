"""One teacher on one device, on eight, on two processes, killed and resumed: the same learner each time."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import teacher_worker as worker
from ddgrasp.config import HostsConfig
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from ppo import hosts, learner

ROOT = Path(__file__).parents[1]
TIMEOUT_S = 600.0
RELATIVE, ABSOLUTE = 1e-3, 3e-4
"""Between numbers of devices, after 48 control steps: sums are taken in another order, and motion amplifies
the last digit. Measured on a CPU: 7e-5 in actions, 3e-5 in parameters and optimiser."""
ABSOLUTE_WARMSTART = 0.05
"""The same for the constraint solver's accelerations, tens of rad/s^2 in contact; measured 5e-3."""


def _start(*command: str, devices: int = 1) -> subprocess.Popen:
    """`command` on so many CPU devices."""
    env = os.environ | {
        "JAX_NUM_CPU_DEVICES": str(devices),
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    return subprocess.Popen(
        [sys.executable, *command],
        cwd=ROOT,
        env=env,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def _train(out: Path, *options: str, devices: int = 1) -> subprocess.Popen:
    options = (*worker.TINY, "--out", str(out), *options)
    return _start("-m", "app.cli", "teacher", "train", *options, devices=devices)


def _succeed(*processes: subprocess.Popen) -> None:
    for process in processes:
        _, errors = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode == 0, errors[-3000:]


def _close(here: dict[str, np.ndarray], there: dict[str, np.ndarray]) -> None:
    assert here.keys() == there.keys()
    for name, value in here.items():
        absolute = ABSOLUTE_WARMSTART if name.endswith(".warmstart") else ABSOLUTE
        np.testing.assert_allclose(value, there[name], rtol=RELATIVE, atol=absolute, err_msg=name)


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """Run directory of an uninterrupted run on one device."""
    out = tmp_path_factory.mktemp("one") / "run"
    _succeed(_train(out))
    return out


def test_eight_devices_train_what_one_trains(one, tmp_path):
    _succeed(_start(str(Path(worker.__file__)), str(tmp_path), devices=8))
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["devices"] == 8
    assert report["shares"] == [2]  # of 16 environments: nothing is gathered between iterations
    assert report["batches"] == [[device, 2] for device in range(8)]  # each device stepped its own two
    _close(dict(np.load(tmp_path / "state.npz")), worker.saved(one))
    manifest = json.loads((one / "teacher" / "manifest.json").read_text())
    assert report["evaluation"]["objects"] == manifest["metrics"]["objects"]


def test_two_processes_train_what_one_trains(one, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    options = ("--hosts.coordinator", address, "--hosts.processes", "2", "--hosts.process")
    out = tmp_path / "run"
    _succeed(*[_train(out, *options, str(process)) for process in range(2)])
    _close(worker.saved(out), worker.saved(one))
    curves = (out / "teacher" / "curves.jsonl").read_text().splitlines()
    assert len(curves) == len((one / "teacher" / "curves.jsonl").read_text().splitlines())


def test_killed_and_resumed_is_the_uninterrupted_run_to_the_bit(one, tmp_path):
    out = tmp_path / "run"
    killed = _train(out)
    deadline = time.monotonic() + TIMEOUT_S
    while not _steps(out) and killed.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert killed.returncode == -signal.SIGKILL
    assert 0 < max(_steps(out)) < worker.ITERATIONS
    _succeed(_train(out, "--resume"))
    whole, resumed = worker.saved(one), worker.saved(out)
    assert whole[".iteration"] == worker.ITERATIONS
    assert whole.keys() == resumed.keys()
    for name, value in whole.items():
        np.testing.assert_array_equal(value, resumed[name], err_msg=name)


def _steps(out: Path) -> list[int]:
    folder = out / "teacher" / "checkpoints"
    return [int(path.name) for path in folder.glob("*") if path.name.isdigit()]


def test_a_batch_that_devices_cannot_share_is_refused_in_one_line(tmp_path):
    process = _train(tmp_path / "run", devices=5)
    _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 2
    assert errors.count("\n") == 1
    assert (
        "teacher.num_envs 16 in 2 minibatches cannot be shared by 5 devices: make it a multiple of 10"
        in errors
    )
    assert not (tmp_path / "run").exists()


def test_eight_devices_can_share_every_preset():
    for preset in PRESETS.values():
        learner.check_divisible(preset.teacher, 8)


def test_minibatches_must_be_whole_on_every_device():
    config = worker.config().teacher
    learner.check_divisible(config, 8)
    with pytest.raises(UserError, match="by 16 devices: make it a multiple of 32"):
        learner.check_divisible(config, 16)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"coordinator": "host"}, "coordinator is 'host'; expected host:port with a port of 1 to 65535, or"),
        ({"coordinator": "localhost:99999"}, "coordinator is 'localhost:99999'; expected host:port"),
        ({"coordinator": "localhost:0"}, "coordinator is 'localhost:0'; expected host:port"),
        ({"coordinator": "localhost:²"}, "coordinator is 'localhost:²'; expected host:port"),
        ({"processes": 2}, "hosts.processes is 2, hosts.process 0, hosts.coordinator '': give the address"),
        ({"coordinator": "a:1", "processes": 0}, "hosts.processes is 0; expected at least 1"),
        ({"coordinator": "a:1", "processes": 2, "process": 2}, "hosts.process is 2; expected 0 to 1"),
    ],
)
def test_mistaken_hosts_are_named(values, expected):
    with pytest.raises(UserError, match=expected):
        HostsConfig(**values)


def test_a_coordinator_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(hosts, "CONNECT_TIMEOUT_S", 1)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, not listening
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(UserError, match=f"'{address}', and nothing answered there for 1 s"):
            hosts.connect(HostsConfig(address, processes=2, process=1))


def _waits_for_another(seconds: int) -> tuple[str, subprocess.Popen]:
    """(address, process 0 of 2, which waits there so long and has said so)."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    script = f"""
import signal
from ddgrasp.config import HostsConfig
from ppo import hosts
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored
hosts.CONNECT_TIMEOUT_S = {seconds}
hosts.connect(HostsConfig({address!r}, processes=2, process=0))
"""
    process = _start("-c", script)
    assert process.stderr is not None
    told = process.stderr.readline()
    assert told == f"process 0 of 2: waiting for the others at {address}, {seconds} s at most\n"
    return address, process


def test_processes_that_do_not_come_end_the_one_that_waits_with_a_line():
    """JAX aborts it, with a stack trace of C++."""
    address, process = _waits_for_another(3)
    _, errors = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 2 and errors.count("\n") == 1
    assert errors.startswith(
        f"ddgrasp: hosts.coordinator is {address!r}, and not all processes (2) came there in 3 s: start"
    )


def test_ctrl_c_ends_the_one_that_waits_at_once():
    _, process = _waits_for_another(600)
    time.sleep(1.0)  # until it does
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30.0)
    assert process.returncode == -signal.SIGINT


def test_a_coordinator_by_its_ipv6_address_is_found():
    with socket.socket(socket.AF_INET6) as listening:
        try:
            listening.bind(("::1", 0))
        except OSError:
            pytest.skip("no IPv6 here")
        listening.listen()
        hosts._wait_until_it_listens(f"[::1]:{listening.getsockname()[1]}")


def test_a_coordinator_that_can_be_no_host_is_named_at_once():
    with pytest.raises(UserError, match="'a..b:1', and 'a..b' can be no host's name") as error:
        hosts.connect(HostsConfig("a..b:1", processes=2, process=1))
    assert "\n" not in str(error.value)


def test_auto_without_a_cluster_says_what_to_give():
    with pytest.raises(UserError, match="'auto', and no cluster answers for it: give host:port"):
        hosts.connect(HostsConfig("auto"))
