"""`ddgrasp completion`: what bash offers after a few words."""

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


def test_another_shell_is_named(capsys, text):
    assert script("zsh").endswith(text) and "bashcompinit" in script("zsh")
    assert cli.main(["completion", "bsh"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("ddgrasp: Unknown shell 'bsh'. Did you mean 'bash'?") and said.count("\n") == 1
