"""`ddgrasp completion`: what bash offers after a few words."""

import re
import shutil
import subprocess

import pytest

from app import cli
from app.commands import COMMANDS
from app.completion import script

BASH = shutil.which("bash")


@pytest.fixture(scope="module")
def text() -> str:
    return script("bash")


@pytest.mark.skipif(BASH is None, reason="no bash here")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("te",), ["teacher"]),
        (("teacher", ""), ["train", "eval", "compare"]),
        (("teacher", "train", "--teacher.num"), ["--teacher.num-envs"]),
        (("run", "--conf"), ["--config"]),
        (("record", "im"), ["import"]),
        (("record", "--resu"), ["--resume"]),
        (("deploy", "trials", "--ri"), ["--rig"]),
        (("deploy", "--ro"), ["--robot"]),
        (("deploy", "tri"), ["trials"]),
        (("play", "--obj"), ["--object", "--objects"]),
        (("record", "import", "--no-"), ["--no-consecutive", "--no-aligned"]),
        (("run", "--student.picture.no-f"), ["--student.picture.no-fill-holes"]),
        (("run", "--preset", "ppo"), ["ppo", "ppo_paper"]),
        (("run", "--seed", "3", "--preset", "de"), ["debug", "demo"]),
        (("play", "--viewer", ""), ["auto", "film", "mujoco", "rerun", "web"]),
        (("deploy", "--camera", "rig"), ["rig", "rig-ideal"]),
        (("deploy", "trials", "--camera", ""), ["stereo", "coarse", "ideal", "other_tables"]),
        (("teacher", "compare", "x", "--backends", "c"), ["cpu"]),
        (("play", "--out", ""), []),
        (("run", "--config", ""), []),
        (("run", "--student.init-from", "--"), []),
        (("run", "--resume", "--out"), ["--out"]),
        (("no", "--x"), []),
    ],
)
def test_bash_offers_what_may_follow(text, words, offered):
    typed = " ".join(f"'{word}'" for word in ("ddgrasp", *words))
    ask = f'COMP_WORDS=({typed}); COMP_CWORD={len(words)}; _ddgrasp; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run([str(BASH), "-c", f"{text}\n{ask}"], capture_output=True, text=True, check=True)
    assert done.stdout.split() == offered and done.stderr == ""


def test_every_command_has_its_options(text):
    for name in COMMANDS:
        line = next(line for line in text.splitlines() if line.strip().startswith((f'"{name}")', f"{name})")))
        assert "--help" in line and "--help-all" in line, name


def test_only_options_that_there_are_are_offered_whatever_the_terminal_s_width(text, monkeypatch):
    options = set(re.findall(r"--[\w.-]+", text))
    assert [option for option in options if not option[-1].isalnum()] == [] and len(options) > 200
    monkeypatch.setenv("COLUMNS", "300")
    assert script("bash") == text


def test_another_shell_is_named(capsys, text):
    assert script("zsh").endswith(text) and "bashcompinit" in script("zsh")
    assert cli.main(["completion", "bsh"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("ddgrasp: Unknown shell 'bsh'. Did you mean 'bash'?") and said.count("\n") == 1


@pytest.mark.parametrize("words", [["completion", "--help"], ["help", "completion"], ["completion", "-h"]])
def test_help_of_it_says_how_it_is_used(words, capsys):
    assert cli.main(words) == 0
    told = capsys.readouterr()
    assert told.out.startswith("usage: ddgrasp completion {bash,zsh}\n") and told.err == ""
    assert 'eval "$(ddgrasp completion bash)"' in told.out and "COMP_WORDS" not in told.out
