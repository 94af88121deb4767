"""Tables on the terminal, all of one form."""

from collections.abc import Container, Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # imported late: most commands print no table
    from rich.console import Console
    from rich.table import Table


def console(width: int | None = None) -> "Console":
    """Standard output, `width` characters wide where that is no terminal. Names of folders are no markup."""
    from rich.console import Console

    shown = Console(markup=False, emoji=False)
    return shown if shown.is_terminal else Console(markup=False, emoji=False, width=width)


def table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", numbers: Container[str] = ()
) -> "Table":
    """A table under `title`; `columns` among `numbers` are flush right, long cells are folded."""
    from rich import box
    from rich.table import Table

    made = Table(
        title=title or None, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False
    )
    for name in columns:
        made.add_column(name, overflow="fold", justify="right" if name in numbers else "left")
    for row in rows:
        made.add_row(*row)
    return made
