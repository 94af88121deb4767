"""What of a machine a process may use, by files as Linux has them."""

import os
import subprocess

import psutil
import pytest

from ddgrasp import install, machine
from ddgrasp.errors import UserError
from learning import memory

GB = 1_000_000_000


@pytest.fixture
def control_group(tmp_path, monkeypatch):
    """control_group({file: text}, "lines of /proc/self/cgroup"): those limits, 64 cores and 200 GB."""

    def made(files, own="0::/\n"):
        for name, text in files.items():
            (tmp_path / "fs" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "fs" / name).write_text(text)
        (tmp_path / "own").write_text(own)
        monkeypatch.setattr(machine, "_CGROUP", tmp_path / "fs")
        monkeypatch.setattr(machine, "_OWN_CGROUPS", tmp_path / "own")
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
        monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 200 * GB})())

    return made


OF_A_JOB = "0::/system.slice/job.scope\n"
OF_VERSION_1 = "4:cpu,cpuacct:/docker/abc\n3:memory:/docker/abc\n0::/\n"


@pytest.mark.parametrize(
    ("files", "own", "cores"),
    [
        ({}, "0::/\n", 64),
        ({"cpu.max": "200000 100000\n"}, "0::/\n", 2),
        ({"cpu.max": "150000 100000\n"}, "0::/\n", 2),
        ({"cpu.max": "max 100000\n"}, "0::/\n", 64),
        ({"system.slice/cpu.max": "400000 100000\n", "system.slice/job.scope/cpu.max": "max 1\n"},
         OF_A_JOB, 4),
        ({"other.slice/cpu.max": "400000 100000\n"}, OF_A_JOB, 64),
        ({"cpu/docker/abc/cpu.cfs_quota_us": "300000", "cpu/docker/abc/cpu.cfs_period_us": "100000"},
         OF_VERSION_1, 3),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, OF_VERSION_1, 64),
    ],
)  # fmt: skip
def test_a_share_of_the_cores_time_counts_as_so_many_cores(control_group, files, own, cores):
    control_group(files, own)
    assert machine.cores() == cores


V2 = {
    "memory.max": str(8 * GB),
    "memory.current": str(5 * GB),
    "memory.stat": f"anon 1\ninactive_file {GB}\n",
}
V1 = {
    "memory.limit_in_bytes": str(6 * GB), "memory.usage_in_bytes": str(4 * GB),
    "memory.stat": f"inactive_file 7\ntotal_inactive_file {GB}\n",
}  # fmt: skip


@pytest.mark.parametrize(
    ("files", "own", "left"),
    [
        ({}, "0::/\n", 200 * GB),
        (V2, "0::/\n", 4 * GB),
        ({f"system.slice/{name}": text for name, text in V2.items()}, OF_A_JOB, 4 * GB),
        ({"memory.max": "max\n", "memory.current": "5\n"}, "0::/\n", 200 * GB),
        ({f"memory/docker/abc/{name}": text for name, text in V1.items()}, OF_VERSION_1, 3 * GB),
    ],
)
def test_memory_is_what_the_narrowest_limit_leaves(control_group, files, own, left):
    control_group(files, own)
    assert memory.host_bytes() == left


def test_without_files_of_linux_a_machine_is_described_all_the_same(tmp_path, monkeypatch):
    for name in ("_CGROUP", "_OWN_CGROUPS", "_CPUINFO"):
        monkeypatch.setattr(machine, name, tmp_path / "absent")
    described = machine.describe()
    assert described["cores"] >= 1 and isinstance(described["processor"], str)
    assert described["accelerators"] == []


def test_a_mac_is_named_by_its_processor(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_CPUINFO", tmp_path / "absent")
    monkeypatch.setattr(machine.sys, "platform", "darwin")
    said = subprocess.CompletedProcess([], 0, "Apple M4\n", "")
    monkeypatch.setattr(machine.subprocess, "run", lambda *_, **__: said)
    assert machine._processor() == "Apple M4"


def test_what_cannot_be_installed_here_is_not_advised(monkeypatch):
    monkeypatch.setattr(install, "find_spec", lambda _: None)
    for system, cpu, remedy in (
        ("linux", "x86_64", "fr3"), ("linux", "aarch64", "x86-64 Linux"), ("darwin", "arm64", "x86-64 Linux"),
    ):  # fmt: skip
        monkeypatch.setattr(install.sys, "platform", system)
        monkeypatch.setattr(install.platform, "machine", lambda cpu=cpu: cpu)
        with pytest.raises(UserError, match=f"the rig needs .*{remedy}"):
            install.check_fr3("the rig")
        with pytest.raises(UserError, match="a row needs trimesh: .*fr3"):
            install.check_fr3("a row", install.FR3[2:])
