"""`ddgrasp completion bash`: what a shell needs to complete commands, options and their values."""

import contextlib
import io
import os
import re
from collections.abc import Mapping

from app.commands import COMMANDS, parse
from app.commands.parsing import HELP_ALL
from ddgrasp.errors import unknown_name
from ddgrasp.presets import PRESETS

Options = Mapping[str, tuple[str, ...] | None]
"""Option -> the values to choose from, none if it takes any; None for a flag."""

_COLUMNS = "129"
"""Width of the help that is read: wide enough for every option's first line, too narrow for two columns."""
_DEFINITION = re.compile(r"^[│ ] (?P<first>(?:-\w, )?--\S.*?)(?:  .*)?$", re.MULTILINE)
"""The beginning of an option in help, as far as the column of its text."""
_NAME = re.compile(r"(?:^|, )(--[\w.-]*\w)")
_CHOICES = re.compile(r"\{([\w,.-]+)\}")
_SCRIPT = """_ddgrasp() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}}
  local name=${{COMP_WORDS[1]}} second="" words=""
  if [ "$COMP_CWORD" -gt 2 ]; then second=${{COMP_WORDS[2]}}; fi
  if [ "$COMP_CWORD" -eq 1 ]; then
    words="{first}"
  else
    case "$name $second" in
{pairs}
      *) case "$name" in
{singles}
      esac ;;
    esac
    case "$name $before" in
{values}
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o bashdefault -o default -F _ddgrasp ddgrasp"""
"""Where no word fits, the shell offers files."""
SHELLS = {
    "bash": "",
    "zsh": "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n",
}
"""Shell -> what comes before bash's script there."""
USAGE = """usage: ddgrasp completion {bash,zsh}

eval "$(ddgrasp completion bash)"  in ~/.bashrc (zsh: ~/.zshrc) completes commands, options, their values."""


def script(shell: str) -> str:
    """What `eval` takes in that shell; UserError for another one than bash and zsh."""
    if shell not in SHELLS:
        raise unknown_name("shell", shell, SHELLS)
    return SHELLS[shell] + _bash()


def _bash() -> str:
    """Two words that name a command, one that does, or what may follow the first."""
    options = {name: _options(name) for name in COMMANDS}
    second: dict[str, list[str]] = {}
    for name in COMMANDS:
        first, *rest = name.split()
        second.setdefault(first, []).extend(rest)
    pairs = [
        f'      "{name}") words="{" ".join(options[name])}"; name="{name}" ;;'
        for name in COMMANDS
        if " " in name
    ]
    singles = []
    for first, more in second.items():
        words = " ".join([*more, *options.get(first, ())])
        singles.append(f'        {first}) words="{words}" ;;')
    return _SCRIPT.format(
        first=" ".join([*second, "help", "--help", "--version"]),
        pairs="\n".join(pairs),
        singles="\n".join(singles),
        values="\n".join(_values(options)),
    )


def _values(options: Mapping[str, Options]) -> list[str]:
    """A line for each set of values: the options behind which it is offered, of all commands or of some."""
    places: dict[tuple[str, ...], list[str]] = {}
    for option in dict.fromkeys(option for own in options.values() for option in own):
        taken = {name: own[option] for name, own in options.items() if option in own}
        if len(set(taken.values())) == 1:
            taken = {"*": next(iter(taken.values()))}
        for name, values in taken.items():
            if values is not None:
                place = f'*" {option}"' if name == "*" else f'"{name} {option}"'
                places.setdefault(values, []).append(place)
    return [f'      {"|".join(where)}) words="{" ".join(values)}" ;;' for values, where in places.items()]


def _options(name: str) -> Options:
    """All options of the command `name`, from its help."""
    found: dict[str, tuple[str, ...] | None] = {}
    for definition in _DEFINITION.findall(_help(name)):
        names = _NAME.findall(definition.removeprefix("-h, "))
        flag = re.fullmatch(r"[^\s\[{]+(?:, \S+)*", definition) is not None
        choices = dict.fromkeys(word for group in _CHOICES.findall(definition) for word in group.split(","))
        choices.pop("None", None)
        found |= dict.fromkeys(names, None if flag else tuple(choices))
    if "--preset" in found:
        found["--preset"] = tuple(PRESETS)
    return {**found, HELP_ALL: None}


def _help(name: str) -> str:
    """The whole help of the command `name`, at a width of its own."""
    told = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", newline="")
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _COLUMNS
    try:
        with contextlib.redirect_stdout(told), contextlib.suppress(SystemExit):
            parse(name, [HELP_ALL])
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before
    told.seek(0)
    return told.read()
