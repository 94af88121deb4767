"""Entry point `ddgrasp`: finds the command, runs it, turns what went wrong into one line.

Imports nothing heavy: `--help` and typing errors answer at once, and Ctrl-C is handled from the first moment.
"""

import atexit
import contextlib
import errno
import io
import os
import sys
from collections.abc import Sequence

_INTERRUPTED = 130
"""The exit status after Ctrl-C."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_OPEN_GL = ("glGetError", "eglQueryString")
"""What PyOpenGL looks for in a library that it has not found."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit status: 0 fine, 1 trouble, 2 wrong input, 130 interrupted."""
    _mend_streams()
    interrupted: list[bool] = []
    if argv is None:
        atexit.register(_leave, interrupted)
    # JAX's GPU build takes most of the device's memory at its start unless told otherwise.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    try:
        _keep_programs()
        return _printed(list(sys.argv[1:] if argv is None else argv))
    except KeyboardInterrupt as interrupt:
        interrupted.append(True)
        return _fail(str(interrupt) or "Interrupted.", _INTERRUPTED)
    except BrokenPipeError:
        _give_up_output()
        return 1
    except Exception as error:
        if (message := _one_line(error)) is None:
            raise
        _give_up_output()
        return _fail(message, 2 if type(error).__name__ == "UserError" else 1)


def _keep_programs() -> None:
    """Compiled programs are kept: the second run of a stage starts in seconds."""
    from ddgrasp.files import user_cache

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(user_cache("jax"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


def _leave(interrupted: Sequence[bool]) -> None:
    """Ends an interrupted program where it stands, once all others that wait for its end have had their turn:
    a thread of JAX may be in the C engine, and comes back to a Python that is no more."""
    if interrupted:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):  # whoever read it may have gone
                stream.flush()
        os._exit(_INTERRUPTED)


def _printed(argv: list[str]) -> int:
    """`_dispatch`, and what it printed written as well: what fails at that can be told now, not later."""
    try:
        status = _dispatch(argv)
    except SystemExit:  # after help, too
        sys.stdout.flush()
        raise
    sys.stdout.flush()
    return status


def _give_up_output() -> None:
    """What standard output does not take is not tried again, and told again, as Python ends."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _mend_streams() -> None:
    """Streams that were closed (`>&-`) lead nowhere; what a terminal cannot show is escaped."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _dispatch(argv: list[str]) -> int:
    from app import extras
    from app.commands import COMMANDS, describe_commands, parse
    from app.commands.parsing import HELP_ALL
    from ddgrasp.errors import UserError, unknown_name

    if argv and argv[0] == "help":
        argv = [*argv[1:], "--help"]
    words = argv[: next((i for i, word in enumerate(argv) if word.startswith("-")), len(argv))]
    if argv and argv[0] == "--version":
        from ddgrasp.versions import library_versions

        print("  ".join(f"{name} {version}" for name, version in library_versions().items()))
        return 0
    if argv and argv[0] == "completion":
        from app.completion import USAGE, script

        asked = not {"--help", "-h", HELP_ALL}.isdisjoint(argv)
        print(USAGE if asked else script(" ".join(argv[1:])))
        return 0
    for length in (2, 1):
        name = " ".join(words[:length])
        if len(words) >= length and name in COMMANDS:
            command = parse(name, argv[length:])
            extras.check(name)
            command.run()
            return 0
    group = words[0] if words else ""
    if words and not any(name.split()[0] == group for name in COMMANDS):
        raise unknown_name("command", group, {name.split()[0] for name in COMMANDS})
    if len(words) > 1:
        raise unknown_name("command", " ".join(words[:2]), [n for n in COMMANDS if n.startswith(f"{group} ")])
    helped = not argv or not {"--help", "-h", HELP_ALL}.isdisjoint(argv)
    if not words and not helped:
        raise UserError(f"{argv[0]} is no option of ddgrasp by itself: give a command, see ddgrasp --help.")
    if len(argv) > 1 and not helped:
        raise UserError(f"`ddgrasp {group}` is half a command: put {_seconds(group)} before {argv[1]}.")
    print(describe_commands(group))
    return 0 if helped else 2


def _seconds(group: str) -> str:
    """The words that make a command with `group`."""
    from app.commands import COMMANDS

    *most, last = (name.split()[1] for name in COMMANDS if name.startswith(f"{group} "))
    return f"{', '.join(most)} or {last}" if most else last


def _one_line(error: BaseException) -> str | None:
    """The message for errors that a person can act on; None for those that need a traceback."""
    from ddgrasp.errors import UserError

    if isinstance(error, UserError):
        return " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError):
        from app import extras

        return extras.remedy(error.name)
    cause: BaseException | None = error
    while cause is not None:
        full = isinstance(cause, OSError) and cause.errno in _DISK_FULL
        if full or any(os.strerror(number) in str(cause) for number in _DISK_FULL):
            where = f" at {cause.filename}" if isinstance(cause, OSError) and cause.filename else ""
            return (
                f"No space left on the disk{where}: free some and give the same command again, with --resume "
                "if it has that. What was finished before is intact."
            )
        cause = cause.__cause__ or cause.__context__
    if not isinstance(error, OSError):
        return _open_gl(error) or _platforms(error)
    place = error.filename2 or error.filename  # of a renaming the second is what was asked for
    if place is None:
        gone = error.errno == errno.ENOENT and not _is_somewhere()
        return "The working directory is not there any more: go to another one." if gone else None
    if isinstance(error, PermissionError):
        return f"No permission for {place}: change its owner, or have it written elsewhere."
    if isinstance(error, (FileExistsError, NotADirectoryError, IsADirectoryError)):
        return f"{place} cannot be written ({error.strerror}): have it written elsewhere."
    return f"{place} cannot be read or written ({error.strerror}): mend that, or give another path."


def _is_somewhere() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


def _open_gl(error: BaseException) -> str | None:
    """One line if MuJoCo, as it is imported, cannot draw by what the environment names."""
    asked = os.environ.get("MUJOCO_GL")
    if asked and "invalid value for environment variable MUJOCO_GL" in str(error):
        others = ", or set it to egl or osmesa" if sys.platform == "linux" else ""
        return f"MUJOCO_GL is {asked!r}, which MuJoCo does not know here: unset it{others}."
    if asked and isinstance(error, AttributeError) and getattr(error, "name", "") in _OPEN_GL:
        return f"MUJOCO_GL is {asked!r}, whose library is not here (Debian: libegl1, libosmesa6): unset it."
    return None


def _platforms(error: BaseException) -> str | None:
    """One line if JAX has no such devices here as the environment asks for; it fails by an assertion, too."""
    asked = os.environ.get("JAX_PLATFORMS")
    if not asked or "jax" not in sys.modules:
        return None
    if "Unable to initialize backend" not in str(error):
        if not isinstance(error, AssertionError):
            return None
        import jax

        with contextlib.suppress(AssertionError, RuntimeError):
            jax.devices()
            return None
    return f"JAX_PLATFORMS is {asked!r}, which JAX has no device for here: unset it, or set it to cpu."


def _fail(message: str, status: int) -> int:
    print(f"ddgrasp: {message}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
