"""How a benchmark's command line ends where it was given something wrong."""

import sys
from collections.abc import Callable
from functools import wraps

from ddgrasp.errors import UserError


def one_line(main: Callable[[], None]) -> Callable[[], None]:
    """`main`, which ends with status 2 and the message alone, without a traceback, after a UserError."""

    @wraps(main)
    def run() -> None:
        try:
            main()
        except UserError as error:
            print(" ".join(str(error).split()), file=sys.stderr)
            sys.exit(2)

    return run
