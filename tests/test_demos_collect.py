"""Collecting demos: when a teacher is given up, and that the same scene is not tried again and again.

The episodes are made up; the store is real.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ddgrasp.errors import UserError
from ddgrasp.layout import ACTION
from ddgrasp.presets import get_preset
from ddgrasp.progress import Progress
from demos import stage
from demos.rollout import Actor, Scene
from demos.store import EpisodeStore
from ppo import policy

ROOT = Path(__file__).parents[1]
QUIET = Progress(quiet=True)


@pytest.fixture
def actors() -> list[Actor]:
    """What moved the robots, batch by batch."""
    return []


@pytest.fixture
def collect(tmp_path, monkeypatch, actors):
    """Collects `episodes` in batches of `parallel`, of which `succeed(batch number, its key)` do; returns
    (tried, stored)."""

    def run(episodes, parallel, succeed):
        batches = []

        def roll(key, actor):
            batches.append(tuple(np.asarray(key).tolist()))
            actors.append(actor)
            return succeed(len(batches), batches[-1])

        def kept(count):
            for _ in range(count):
                yield {"held": np.zeros(3, bool)}, {"object_index": np.int32(0)}

        monkeypatch.setattr(stage, "Roller", lambda *_, **__: SimpleNamespace(run=roll))
        monkeypatch.setattr(stage, "successful", kept)
        demo = get_preset("demo")
        config = replace(demo, demos=replace(demo.demos, episodes=episodes, parallel=parallel))
        store = EpisodeStore(tmp_path / "episodes.zarr", create=True)
        return stage.collect(config, policy.load(ROOT / "pretrained" / "teacher"), store, QUIET), len(store)

    return run


def test_few_demos_of_a_large_batch_are_enough(collect):
    assert collect(5, 60, lambda *_: 6) == (60, 5)


def test_the_teacher_is_disturbed_as_configured(collect, actors):
    collect(5, 2000, lambda *_: 6)
    (actor,), settings = actors, get_preset("demo").demos
    still, picture = np.zeros((2000, 8)), np.zeros((2000, 0, 0), np.uint16)
    action = actor(Scene(picture, still, still, np.zeros((2000, 40)), np.zeros(2000, bool), 0))
    pushed = action[:, ACTION.arm].any(axis=1)
    assert pushed.mean() == pytest.approx(settings.noise_share, rel=0.3)
    assert action[pushed, ACTION.arm].std() == pytest.approx(settings.action_noise, rel=0.1)


def test_a_scene_that_fails_is_not_tried_for_ever(collect):
    """The key of the fourth batch is of a scene in which a good teacher fails."""
    bad = []

    def succeed(number, key):
        if number == 4:
            bad.append(key)
        return int(key not in bad)

    assert collect(20, 1, succeed) == (21, 20)


@pytest.mark.parametrize("parallel", [1, 60, 100])
def test_a_teacher_that_fails_is_given_up_after_a_fair_trial(collect, parallel):
    tried = max(60, parallel)
    with pytest.raises(UserError, match=f"succeeded in 0 of {tried} episodes: train it longer"):
        collect(20, parallel, lambda *_: 0)


def test_a_poor_teacher_is_given_up_and_a_fair_one_is_not(collect):
    assert collect(100, 60, lambda *_: 15)[1] == 100
    with pytest.raises(UserError, match="succeeded in 119 of 480"):  # 7 batches before, and one now
        collect(200, 60, lambda *_: 14)


def test_an_interrupted_collection_goes_on_as_if_it_had_not_been(tmp_path, monkeypatch):
    """An episode is told apart by its batch's key, and its place in it; some batches add nothing."""
    demo = get_preset("demo")
    config = replace(demo, demos=replace(demo.demos, episodes=30, parallel=8))
    teacher, append = policy.load(ROOT / "pretrained" / "teacher"), EpisodeStore.append
    sizes, left = [], []

    def roll(key, actor):
        rng = np.random.default_rng(np.asarray(key))
        sizes.append(int(rng.choice([0, 4, 6])))
        return rng.integers(1, 2**31 - 1, size=sizes[-1]).astype(np.int32)

    def kept(numbers):
        for number in numbers:
            yield {"held": np.zeros(3, bool)}, {"object_index": number}

    def append_while_it_lasts(store, steps, episode):
        if not left:
            raise KeyboardInterrupt
        left.pop()
        append(store, steps, episode)

    monkeypatch.setattr(stage, "Roller", lambda *_, **__: SimpleNamespace(run=roll))
    monkeypatch.setattr(stage, "successful", kept)
    monkeypatch.setattr(EpisodeStore, "append", append_while_it_lasts)

    def collected(name: str, at_once: int) -> tuple[int, list[int], int]:
        """(tried, episodes, interruptions)"""
        store = EpisodeStore(tmp_path / name / "episodes.zarr", create=True)
        for interruptions in range(100):
            left[:] = [None] * at_once
            try:
                tried = stage.collect(config, teacher, store, QUIET)
            except KeyboardInterrupt:
                continue
            return tried, store.episodes("object_index").tolist(), interruptions
        raise AssertionError("it never ends")

    tried, episodes, _ = collected("whole", 1000)
    assert 0 in sizes[:-1] and len(set(episodes)) == 30 and tried == 8 * len(sizes)
    assert collected("one at a time", 1) == (tried, episodes, 29)
    assert collected("three", 3) == (tried, episodes, 9)


def test_what_is_there_of_an_older_collection_stays_and_is_gone_on_from(collect, tmp_path):
    collect(20, 60, lambda *_: 20)
    (tmp_path / stage.BATCHES).unlink()
    assert collect(25, 60, lambda *_: 20) == (60, 25)
    (tmp_path / stage.BATCHES).write_text('{"stored": 999}')
    assert collect(30, 60, lambda *_: 20) == (60, 30)
