"""What a person turns while a policy runs: rig, object and the depth it sees, by key or by typed line."""

import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, get_args

from ddgrasp.errors import UserError, unknown_name

Noise = Literal["camera", "none", "generator"]
NOISES: tuple[Noise, ...] = get_args(Noise)
QUIT = "q"
UP, DOWN, ENTER = 265, 264, 257
"""GLFW's key codes; MuJoCo's viewer has no use for these keys of its own."""
KEYS = "Up and Down: another object; Enter: other noise"
_POLL_S = 0.1


class Controls:
    """One for a viewer; keys and lines may come from any thread."""

    def __init__(self, objects: Mapping[str, Sequence[str]], rig: str, noise: Noise = "camera"):
        """`objects` are those that may be asked for, by rig; the first of `rig` is where the keys start."""
        self._known = {name: tuple(known) for name, known in objects.items()}
        self.rig = rig
        self.noise: Noise = noise
        self.object_name = self._objects[0]
        self._asked: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.ended = False

    @property
    def help(self) -> str:
        """What may be typed, one line."""
        rigs = f", a rig ({', '.join(self._known)})" if len(self._known) > 1 else ""
        return f"Type an object's name, a noise ({', '.join(NOISES)}){rigs}, or {QUIT} to end."

    @property
    def _objects(self) -> tuple[str, ...]:
        return self._known[self.rig]

    @property
    def interrupts(self) -> bool:
        """Whether the trial that runs is to end now."""
        return self.ended or not self._asked.empty()

    def begin(self, object_name: str) -> None:
        """A trial with that object begins; the keys go on from there."""
        self.object_name = object_name

    def next_object(self) -> str | None:
        """The object last asked for since the last call; None if none was."""
        name = None
        while not self._asked.empty():
            name = self._asked.get()
        return name

    def wait(self, watched: Callable[[], bool]) -> None:
        """Returns when an object is asked for, when a person ends it, or when nobody is `watched` by."""
        pause = threading.Event()
        while watched() and not self.interrupts:
            pause.wait(_POLL_S)

    def key(self, code: int) -> None:
        """What MuJoCo's viewer calls with GLFW's code of a key."""
        if code in (UP, DOWN):
            at = self._objects.index(self.object_name) + (1 if code == DOWN else -1)
            self.object_name = self._objects[at % len(self._objects)]
            self._asked.put(self.object_name)
        elif code == ENTER:
            self.noise = NOISES[(NOISES.index(self.noise) + 1) % len(NOISES)]

    def line(self, text: str) -> str:
        """Obeys one typed line and answers it. UserError for a word that is none of `help`."""
        word = text.strip().lower()
        if word in NOISES:
            self.noise = word
            return f"noise: {word}"
        if word == QUIT:
            self.ended = True
            return "ending"
        if word in self._known:
            return self._change_rig(word)
        if word not in self._objects:
            words = (*self._objects, *NOISES, *self._known, QUIT)
            raise unknown_name("object, noise or rig", word, words)
        self._asked.put(word)
        return f"next: {word}"

    def _change_rig(self, rig: str) -> str:
        """Goes on there with the object that is before the arm now, if that rig has it."""
        name = self.object_name if self.object_name in self._known[rig] else self._known[rig][0]
        self.rig, self.object_name = rig, name
        self._asked.put(name)
        return f"rig: {rig}, next: {name}"

    def listen(self, lines: Iterable[str], say: Callable[[str], None]) -> None:
        """Obeys every line of `lines`, in a thread that goes with the process."""
        threading.Thread(target=self._obey, args=(lines, say), daemon=True).start()

    def _obey(self, lines: Iterable[str], say: Callable[[str], None]) -> None:
        for text in lines:
            if not text.strip():
                continue
            try:
                say(self.line(text))
            except UserError as error:
                say(str(error))
