"""ddgrasp demos export: episodes for other people's training code."""

import shlex
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ddgrasp.config.checks import Range


@dataclass(frozen=True)
class DemosExport:
    """Turn demonstrations, deployments or recorded trials into a LeRobot dataset."""

    source: tyro.conf.Positional[Path]
    """A run with demonstrations, or its folder demos; a deployment, or the folder of all of them; a
    folder of `ddgrasp deploy trials --record`."""
    out: Path
    """Folder of the dataset; one that exists is never written to."""
    episodes: Annotated[int, Range(0, 1_000_000)] = 0
    """At most so many, from the first on; 0 takes all."""
    objects: tuple[str, ...] = ()
    """Only episodes with these; none takes all."""
    noisy: Path | None = None
    """What `ddgrasp ddg generate` made of these demonstrations: its depth in the place of clean depth."""
    storage: Literal["video", "images"] = "video"
    """video (small; depth without loss up to 4.095 m) or images (a file for each step, all without loss)."""
    task: str = ""
    """Sentence that says what is done; empty names each episode's object."""
    licence: str = "apache-2.0"
    """Identifier of the licence that you give the data, for the dataset's card."""

    def run(self) -> None:
        """Writes the dataset and prints what is in it."""
        from app.lerobot.dataset import check_free, load_lerobot, write
        from app.lerobot.source import open_source
        from ddgrasp.progress import Progress

        check_free(self.out)
        source = open_source(self.source, self.objects, self.noisy, self.episodes)
        load_lerobot()
        progress = Progress(name="demos export")
        for line in source.left_out:
            progress.note(f"left out {line}")
        contents = write(
            source,
            self.out,
            storage=self.storage,
            task=self.task,
            licence=self.licence,
            command=self._command(),
            progress=progress,
        )
        print(f"{self.out}: {contents.episodes} episodes, {contents.steps} steps")

    def _command(self) -> str:
        """The command line that this is, without what is as it is anyway."""
        words = ["ddgrasp", "demos", "export", str(self.source), "--out", str(self.out)]
        for field in fields(self)[2:]:
            value = getattr(self, field.name)
            if value != field.default:
                words += [f"--{field.name}", *(value if isinstance(value, tuple) else [str(value)])]
        return shlex.join(words)
