"""Episodes on disk survive interruption; what is whole stays readable."""

import errno
import json
import os
import shutil
from unittest.mock import Mock

import numpy as np
import pytest

from ddgrasp.errors import UserError
from demos.store import EpisodeStore


def episode(length, value):
    return {
        "depth_mm": np.full((length, 6, 8), value, np.uint16),
        "action": np.full((length, 8), value, np.float32),
    }, {"object_index": np.int32(value)}


def test_round_trip_in_replay_buffer_layout(tmp_path):
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    store.append(*episode(3, 7))
    store.append(*episode(5, 9))
    again = EpisodeStore(tmp_path / "s.zarr")
    np.testing.assert_array_equal(again.ends, [3, 8])
    assert (tmp_path / "s.zarr" / "data" / "action").is_dir()
    assert (tmp_path / "s.zarr" / "meta" / "episode_ends").is_dir()
    assert again.steps("depth_mm").shape == (8, 6, 8) and again.steps("depth_mm").dtype == np.uint16
    np.testing.assert_array_equal(again.steps("action")[:, 0], [7, 7, 7, 9, 9, 9, 9, 9])
    np.testing.assert_array_equal(again.episodes("object_index"), [7, 9])


def test_an_end_that_was_not_written_any_more_does_not_count(tmp_path):
    """Killed between the growth of the index and its row."""
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    store.append(*episode(3, 7))
    ends = store._meta["episode_ends"]
    ends.resize((2,))
    again = EpisodeStore(tmp_path / "s.zarr", create=True)
    np.testing.assert_array_equal(again.ends, [3])
    again.append(*episode(2, 9))
    np.testing.assert_array_equal(again.ends, [3, 5])
    np.testing.assert_array_equal(again.steps("action")[:, 0], [7, 7, 7, 9, 9])


def test_a_half_written_episode_is_not_seen_and_is_overwritten(tmp_path, monkeypatch):
    import demos.store as module

    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    store.append(*episode(3, 1))
    put = module._put

    def fail_at_the_end(group, name, start, rows):
        if name == "episode_ends":
            raise KeyboardInterrupt
        put(group, name, start, rows)

    monkeypatch.setattr(module, "_put", fail_at_the_end)
    with pytest.raises(KeyboardInterrupt):
        store.append(*episode(4, 2))
    monkeypatch.undo()
    again = EpisodeStore(tmp_path / "s.zarr", create=True)
    assert len(again) == 1 and len(again.steps("action")) == 3
    again.append(*episode(2, 5))
    np.testing.assert_array_equal(again.steps("action")[:, 0], [1, 1, 1, 5, 5])


def test_a_damaged_chunk_names_the_store_and_spares_other_episodes(tmp_path):
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    for i in range(3):
        store.append(*episode(16, i + 1))
    chunks = sorted((tmp_path / "s.zarr" / "data" / "depth_mm" / "c").rglob("*"))
    last = [c for c in chunks if c.is_file()][-1]
    last.write_bytes(last.read_bytes()[:10])
    again = EpisodeStore(tmp_path / "s.zarr")
    np.testing.assert_array_equal(np.unique(again.steps("depth_mm", 0, 32)), [1, 2])
    with pytest.raises(UserError, match="depth_mm"):
        again.steps("depth_mm", 32, 48)


@pytest.mark.parametrize("field", ["data/depth_mm/c/1/0/0", "data/action/c/0/0", "meta/object_index/c/0"])
def test_a_lost_chunk_is_refused_not_read_as_zeros(tmp_path, field):
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    for i in range(3):
        store.append(*episode(16, i))  # the first episode's values are all zero: stored nevertheless
    (tmp_path / "s.zarr" / field).unlink()
    again = EpisodeStore(tmp_path / "s.zarr")
    np.testing.assert_array_equal(np.unique(again.steps("depth_mm", 32, 48)), [2])
    group, name = field.split("/")[:2]
    with pytest.raises(UserError, match=f"{group}/{name} cannot be read .*is missing.* make it again"):
        again.steps(name) if group == "data" else again.episodes(name)


@pytest.mark.parametrize("damage", ["c/0", "zarr.json", "."])
def test_lost_ends_are_refused_and_nothing_is_written_over(tmp_path, damage):
    """Read as no episode they would have the next append cut off all that is there."""
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    for i in range(3):
        store.append(*episode(16, i))
    lost = tmp_path / "s.zarr" / "meta" / "episode_ends" / damage
    shutil.rmtree(lost) if lost.is_dir() else lost.unlink()
    again = EpisodeStore(tmp_path / "s.zarr", create=True)
    with pytest.raises(UserError, match=r"meta/episode_ends cannot be read .* make it again"):
        again.append(*episode(16, 4))
    assert again._data["action"].shape[0] == 48


@pytest.mark.parametrize(
    "name", ["meta/episode_ends/zarr.json", "meta/episode_ends/c/0", "data/action/zarr.json"]
)
def test_cut_files_of_a_store_are_one_line(tmp_path, name):
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    for i in range(3):
        store.append(*episode(16, i))
    file = tmp_path / "s.zarr" / name
    file.write_bytes(file.read_bytes()[:10])
    again = EpisodeStore(tmp_path / "s.zarr")
    with pytest.raises(UserError, match="/".join(name.split("/")[:2])):
        again.ends, again.reader("action")


def test_no_store_there(tmp_path):
    with pytest.raises(UserError, match="no episode store"):
        EpisodeStore(tmp_path / "nothing.zarr")


def test_zeros_are_kept_over_several_appends(tmp_path):
    for length in (3, 4):
        store = EpisodeStore(tmp_path / "e", create=True)
        store.append({"held": np.zeros(length, bool)}, {"object_index": np.int32(0)})
    assert store.steps("held").tolist() == [False] * 7 and store.episodes("object_index").tolist() == [0, 0]


def test_steps_of_another_kind_are_refused_and_spoil_nothing(tmp_path):
    store = EpisodeStore(tmp_path / "e", create=True)
    depth_mm, state = np.full((3, 8, 10), 700, np.uint16), np.ones((3, 8), np.float32)
    store.append({"depth_mm": depth_mm, "state": state}, {"object_index": np.int32(0)})
    for steps, problem in (
        ({"depth_mm": depth_mm[:, :4, :5], "state": state}, r"depth_mm is uint16 \(8, 10\) per step, not"),
        ({"depth_mm": depth_mm / 1000, "state": state}, "not float64"),
        ({"depth_mm": depth_mm}, "has depth_mm, state, not depth_mm"),
        ({"depth_mm": depth_mm, "state": state, "rgb": depth_mm}, "not depth_mm, rgb, state"),
    ):
        with pytest.raises(UserError, match=problem):
            store.append(steps, {"object_index": np.int32(0)})
    assert len(store) == 1
    np.testing.assert_array_equal(store.steps("depth_mm"), depth_mm)


@pytest.mark.parametrize("damage", ["lost", "cut", "emptied"])
def test_what_is_damaged_is_not_added_to(tmp_path, damage):
    """A lost file would be made anew, with zeros where a finished episode was."""
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    store.append(*episode(20, 7))
    file = tmp_path / "s.zarr" / "data" / "depth_mm" / "c" / "1" / "0" / "0"
    if damage == "lost":
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:10] if damage == "cut" else b"")
    again = EpisodeStore(tmp_path / "s.zarr", create=True)
    with pytest.raises(UserError, match="data/depth_mm cannot be read .* make it again"):
        again.append(*episode(5, 8))
    assert len(EpisodeStore(tmp_path / "s.zarr")) == 1


def test_a_damaged_description_of_a_field_is_one_line(tmp_path):
    EpisodeStore(tmp_path / "s.zarr", create=True).append(*episode(3, 7))
    (tmp_path / "s.zarr" / "data" / "action" / "zarr.json").write_text("")
    with pytest.raises(UserError, match="data cannot be read"):
        _ = EpisodeStore(tmp_path / "s.zarr").fields


def _describe(path, **fields):
    """Changes what Zarr knows of an array or a group."""
    file = path / "zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | fields))


def _in_chunks(*shape):
    return {"name": "regular", "configuration": {"chunk_shape": shape}}


@pytest.mark.parametrize(
    ("name", "fields", "said"),
    [
        ("data/action", {"shape": [5, 8]}, r"data/action cannot be read \(it has 5 rows of 8\)"),
        ("data/action", {"chunk_grid": _in_chunks(0, 8)}, "action has chunks of 0 rows"),
        ("data/action", {"shape": [], "chunk_grid": _in_chunks()}, "data/action cannot be read"),
        ("meta/object_index", {"shape": [1]}, r"meta/object_index cannot be read \(it has 1 rows of 2\)"),
        ("meta/episode_ends", {"data_type": "float64"}, "meta/episode_ends cannot be read .* no list of"),
        ("meta/episode_ends", {"chunk_grid": _in_chunks(0)}, "episode_ends has chunks of 0 rows"),
        ("data", {"attributes": 5}, "is damaged .* delete it and collect again"),
        ("", {"attributes": [5]}, "is damaged .* delete it and collect again"),
    ],
)
def test_descriptions_that_say_what_none_can_are_one_line(tmp_path, name, fields, said):
    """Arrays shorter than episode_ends says were read short."""
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    for length in (3, 5):
        store.append(*episode(length, 7))
    _describe(tmp_path / "s.zarr" / name, **fields)
    for read in (EpisodeStore.steps, EpisodeStore.reader) if name == "data/action" else (EpisodeStore.steps,):
        with pytest.raises(UserError, match=said) as refused:
            again = EpisodeStore(tmp_path / "s.zarr")
            again.episodes("object_index")
            read(again, "action")
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EIO])
def test_a_full_disk_and_a_lack_of_rights_are_not_called_damage(tmp_path, monkeypatch, number):
    """Whoever is told to delete a store and make it again does."""
    EpisodeStore(tmp_path / "s.zarr", create=True).append(*episode(3, 7))
    failing = Mock(side_effect=OSError(number, os.strerror(number)))
    store = EpisodeStore(tmp_path / "s.zarr")
    monkeypatch.setattr("demos.store._check_chunks", failing)
    with pytest.raises(OSError, match=os.strerror(number)):
        store.steps("action")
    monkeypatch.setattr("demos.store.zarr.open_group", failing)
    with pytest.raises(OSError, match=os.strerror(number)):
        EpisodeStore(tmp_path / "s.zarr")


def test_arrays_of_several_lengths_are_refused_and_spoil_nothing(tmp_path):
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    steps, about = episode(3, 7)
    with pytest.raises(UserError, match=r"of one length, these are of \{'depth_mm': 3, 'action': 2\}"):
        store.append(steps | {"action": steps["action"][:2]}, about)
    store.append(steps, about)
    assert store.steps("action").shape == (3, 8)


def test_a_mistyped_field_is_named_and_nothing_of_the_user_s_is_to_be_deleted(tmp_path):
    store = EpisodeStore(tmp_path / "s.zarr", create=True)
    store.append(*episode(3, 7))
    for read in (store.steps, store.reader):
        with pytest.raises(
            UserError, match=r"has no depth: it has action, depth_mm\. .*delete \S+/s\.zarr and"
        ):
            read("depth")
    with pytest.raises(UserError, match=r"has no object: it has episode_ends, object_index"):
        store.episodes("object")
    (tmp_path / "manifest.json").touch()  # a stage, which is made again as a whole
    with pytest.raises(UserError, match=rf"delete {tmp_path} and make it again"):
        store.steps("depth")


def test_rows_that_there_are_none_of_are_refused(tmp_path):
    for compressed in (True, False):
        path = tmp_path / f"{compressed}.zarr"
        store = EpisodeStore(path, create=True, compressed=compressed)
        store.append(*episode(3, 7))
        reader = store.reader("depth_mm")
        assert len(reader) == 3 and reader.read(np.array([2, 0])).shape == (2, 6, 8)
        for rows in ([3], [2, 3], [-1]):
            with pytest.raises(IndexError, match="of 3"):
                reader.read(np.array(rows))
    with pytest.raises(UserError, match="no rows -5 to the end; expected 0 to 3"):
        store.steps("action", -5)


def test_a_store_that_is_read_is_not_added_to(tmp_path):
    EpisodeStore(tmp_path / "s.zarr", create=True).append(*episode(3, 7))
    with pytest.raises(UserError, match="create=True"):
        EpisodeStore(tmp_path / "s.zarr").append(*episode(3, 7))


def test_the_folder_of_a_stage_or_a_run_says_where_its_store_is(tmp_path):
    EpisodeStore(tmp_path / "demos" / "episodes.zarr", create=True)
    for folder in (tmp_path, tmp_path / "demos"):
        with pytest.raises(
            UserError, match=f"{folder} is no episode store: open {tmp_path}/demos/episodes.zarr"
        ):
            EpisodeStore(folder)
