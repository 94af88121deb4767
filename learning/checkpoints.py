"""Whole-state checkpoints: what an interrupted training goes on from, exactly, on any number of devices."""

from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import jax
import orbax.checkpoint as ocp

from ddgrasp.errors import UserError

KEPT = 2
"""Checkpoints in a folder: should the newest be lost with the disk's last write, there is one before."""
UNREADABLE = (ValueError, KeyError, TypeError, FileNotFoundError)
"""What Orbax raises of a checkpoint that is damaged or of another structure."""

State = TypeVar("State")


class Checkpoints:
    """The newest states of one training, in a folder of its own; a context manager.

    Every process of a training opens the same folder and makes the same calls.
    """

    def __init__(self, directory: Path):
        self.directory = directory
        options = ocp.CheckpointManagerOptions(max_to_keep=KEPT, enable_async_checkpointing=False)
        # Named, or Orbax guesses from the newest one what all hold, which a damaged one does not say.
        handler = ocp.StandardCheckpointHandler()
        self._manager = ocp.CheckpointManager(directory.absolute(), options=options, item_handlers=handler)

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._manager.close()

    @property
    def latest(self) -> int | None:
        """Step of the newest checkpoint, None if there is none."""
        return self._manager.latest_step()

    def restore(self, target: State) -> State:
        """The newest checkpoint that can be read; newer ones, which are damaged then, are deleted.

        Args:
          target: a state of the same structure, of arrays or of jax.ShapeDtypeStruct with the shardings that
            the result shall have; they need not be those it was saved from.

        Raises UserError if there is none, or none fits `target`; they are all kept then.
        """
        if self.latest is None:
            raise UserError(f"{self.directory} holds no checkpoint: start without resuming.")
        unread: dict[int, Exception] = {}
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                restored: Any = self._manager.restore(step, args=ocp.args.StandardRestore(target))
            except Exception as error:
                if not isinstance(error, UNREADABLE) and type(error) is not Exception:
                    raise  # a bare one is Orbax's, of a file of array data that is torn
                unread[step] = error
                continue
            for damaged in unread:  # one of another configuration would have others beside it
                self._manager.delete(damaged)
            return restored
        newest = str(unread[self.latest]).partition("\n")[0].partition(" [tensorstore")[0]
        reason = newest.partition(". ")[0].rstrip(":.")
        path = self.directory / str(self.latest)
        raise UserError(
            f"The checkpoint {path} does not fit this training ({reason}): it is of another "
            "configuration or version, or damaged; delete the folder to start afresh."
        )

    def restore_or(self, first: State) -> State:
        """The newest checkpoint, shaped like `first`; `first` itself if there is none."""
        return first if self.latest is None else self.restore(first)

    def save(self, step: int, state: Any) -> None:
        """Keeps `state`, the one after `step` steps, unless it is there already. Returns once written."""
        if self.latest != step:
            self._manager.save(step, args=ocp.args.StandardSave(state), force=True)
            self._manager.wait_until_finished()


def intact(state: Any) -> bool:
    """Whether `state` can still be saved: an interrupted step has taken the buffers that it was donated."""
    return not any(leaf.is_deleted() for leaf in jax.tree.leaves(state) if isinstance(leaf, jax.Array))
