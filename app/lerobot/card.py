"""The README of a dataset: what a stranger has to know before training on it."""

from dataclasses import dataclass, field

from app.lerobot.episode import Episode, Source
from app.lerobot.steps import ACTION_KEY, BY_POLICY, COLOUR, DEPTH, DONE, POSE, STATE_KEY, SUCCESS, Storage
from ddgrasp import contract

_HEADER = """---
license: {licence}
task_categories:
- robotics
tags:
- LeRobot
- depth
- grasping
- franka
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {name}: grasping from depth, {kind}

{episodes} episodes, {steps} steps at {hz:g} Hz, in LeRobot's format v3: an arm grasps an object on a table
and lifts it. Made with DiffuDepGrasp-JAX.
"""
_ROWS = {
    STATE_KEY: "seven joints (rad), then the opening between the gripper's pads (m)",
    ACTION_KEY: f"seven joint steps in [-1, 1], each times {contract.ACTION_SCALE_RAD:g} rad and added to "
    "its joint; then the gripper: above 0 it closes, else it opens",
    DEPTH: "planar depth (along the camera's axis) in millimetres; 0 where the camera has none",
    COLOUR: "colour of the same moment, and of the same view unless it says otherwise above",
    POSE: "the camera's pose: position in metres, axes as in OpenCV, in the frame of the robot's base",
    BY_POLICY: "true in a step whose `action` is the policy's: not where the loop's rules acted or the loop "
    "held the arm, and not where nobody noted who acted",
    DONE: "true in an episode's last step",
    SUCCESS: "true in the last step of an episode whose object was lifted and held",
}
_STORAGE: dict[Storage, str] = {
    "video": "Depth is in HEVC videos without loss, one of 4096 values for each millimetre. {farther} pixels "
    "were farther than 4095 mm and have that value. Colour is in AV1 videos, with loss.",
    "images": "Depth is in a 16-bit TIFF for each step, colour in a PNG, both without loss.",
}
_READING = """
```python
from lerobot.datasets import LeRobotDataset

dataset = LeRobotDataset("{name}", root="{name}")
depth_mm = dataset[0]["{depth}"]  # (1, H, W) float32, millimetres
succeeded = dataset.meta.filter_episodes(lambda episode: episode["success"])
```
"""


@dataclass
class Contents:
    """What is in a dataset."""

    keys: tuple[str, ...] = ()
    """What a step has."""
    steps: int = 0
    outcomes: list[bool] = field(default_factory=list)
    """Whether each episode succeeded."""
    held: int = 0
    """Steps in which the control loop held the arm."""
    retried: int = 0
    """Steps in which its rules acted instead of the policy."""
    unnoted: int = 0
    """Steps of which nobody noted which of the two acted."""
    missed: int = 0
    """Control periods without a step."""
    farther: int = 0
    """Pixels that were too far for a depth video."""
    unaligned: int = 0
    """Episodes whose colour is not seen from where depth is."""
    objects: dict[str, int] = field(default_factory=dict)
    """Episodes by object, "" where nobody noted it."""

    @property
    def episodes(self) -> int:
        """How many."""
        return len(self.outcomes)

    def count(self, episode: Episode, farther: int) -> None:
        """Adds an episode, `farther` of whose pixels were too far."""
        self.steps += len(episode.state)
        self.outcomes.append(episode.success)
        self.held += int(episode.held.sum())
        if episode.by is not None:
            who = zip(episode.by, episode.held, strict=True)
            self.unnoted += sum(not by and not held for by, held in who)
            self.retried += sum(by == "retry" for by in episode.by)
        self.missed += episode.missed
        self.farther += farther
        self.unaligned += not episode.color_aligned
        self.objects[episode.object_name] = self.objects.get(episode.object_name, 0) + 1


def render(
    source: Source, contents: Contents, *, name: str, storage: Storage, licence: str, command: str
) -> str:
    """The README's text.

    Args:
      source: what the episodes are.
      contents: how many of what.
      name: the dataset's.
      storage: how pictures are kept.
      licence: identifier, for example apache-2.0.
      command: what made the dataset.
    """
    header = _HEADER.format(
        licence=licence, name=name, kind=source.kind, episodes=contents.episodes, steps=contents.steps,
        hz=contract.CONTROL_HZ,
    )  # fmt: skip
    about = [f"* **{title}**: {text}" for title, text in source.about.items()]
    objects = ", ".join(f"{object_name or 'not noted'} {n}" for object_name, n in contents.objects.items())
    about += [
        f"* **Episodes**: {sum(contents.outcomes)} of {contents.episodes} succeeded. By object: {objects}."
    ]
    if contents.retried:
        about += [
            f"* **Trying again**: in {contents.retried} steps the control loop's rules acted; their `action` "
            "is not the policy's."
        ]
    if contents.unnoted:
        about += [
            f"* **Not noted**: {contents.unnoted} steps do not say whether policy or rules acted; they were "
            "made before that was noted."
        ]
    if contents.held:
        about += [
            f"* **Held**: in {contents.held} steps the control loop held the arm; their `action` is no joint "
            "step, and the gripper as before."
        ]
    if contents.missed:
        about += [
            f"* **Time**: {contents.missed} control periods passed without a step; timestamps count steps, "
            "so around them more time lies between two steps than they say."
        ]
    if contents.unaligned:
        about += [
            f"* **Colour**: in {contents.unaligned} of {contents.episodes} episodes it is the colour "
            "camera's own picture, of another lens and view than depth's: its pixels are not those of depth."
        ]
    rows = [f"| `{key}` | {_ROWS[key]} |" for key in contents.keys]
    stored = _STORAGE[storage].format(farther=contents.farther)
    reading = _READING.format(name=name, depth=DEPTH)
    parts = [
        header, *about, "\n## What a step has\n", "| key | what |", "|---|---|", *rows, f"\n{stored}",
        f"\n## Made by\n\n```sh\n{command}\n```", "\n## Reading it", reading,
    ]  # fmt: skip
    return "\n".join(parts)
