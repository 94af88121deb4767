"""`ddgrasp completion bash`: what a shell needs to complete commands and options."""

import contextlib
import io
import re

from app.commands import COMMANDS, parse
from app.commands.parsing import HELP_ALL
from ddgrasp.errors import unknown_name

_OPTION = re.compile(r"^[│ ]*(?:-\w, )?(--[\w.-]+)", re.MULTILINE)
"""An option at the beginning of a line of help."""
_SCRIPT = """_ddgrasp() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} words=""
  if [ "$COMP_CWORD" -eq 1 ]; then
    words="{first}"
  else
    case "${{COMP_WORDS[1]}} ${{COMP_WORDS[2]}}" in
{pairs}
      *) case "${{COMP_WORDS[1]}}" in
{singles}
      esac ;;
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o bashdefault -o default -F _ddgrasp ddgrasp"""
SHELLS = {
    "bash": "",
    "zsh": "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n",
}
"""Shell -> what comes before bash's script there."""


def script(shell: str) -> str:
    """What `eval` takes in that shell; UserError for another one than bash and zsh."""
    if shell not in SHELLS:
        raise unknown_name("shell", shell, SHELLS)
    return SHELLS[shell] + _bash()


def _bash() -> str:
    """Two words that name a command, one that does, or what may follow the first."""
    second: dict[str, list[str]] = {}
    for name in COMMANDS:
        first, *rest = name.split()
        second.setdefault(first, []).extend(rest)
    pairs = [f'      "{name}") words="{_options(name)}" ;;' for name in COMMANDS if " " in name]
    singles = []
    for first, more in second.items():
        words = " ".join([*more, *([_options(first)] if first in COMMANDS else [])])
        singles.append(f'        {first}) words="{words}" ;;')
    first_words = " ".join([*second, "help", "--help", "--version"])
    return _SCRIPT.format(first=first_words, pairs="\n".join(pairs), singles="\n".join(singles))


def _options(name: str) -> str:
    """All options of the command `name`, from its help."""
    told = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", newline="")
    with contextlib.redirect_stdout(told), contextlib.suppress(SystemExit):
        parse(name, [HELP_ALL])
    told.seek(0)
    return " ".join([*dict.fromkeys(_OPTION.findall(told.read())), HELP_ALL])
