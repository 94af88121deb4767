"""Which code a manifest names: the commit that ran, not that of the day of installation."""

import subprocess
from pathlib import Path

import pytest

from ddgrasp import versions


def git(folder: Path, *arguments: str) -> str:
    named = ("-c", "user.name=test", "-c", "user.email=test@example.org")
    command = ["git", "-C", str(folder), *named, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def clone(tmp_path):
    """A clone with one commit; the cache knows nothing of it."""
    git(tmp_path, "init", "--quiet")
    (tmp_path / "code.py").write_text("first\n")
    git(tmp_path, "add", "code.py")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    git(tmp_path, "tag", "v1")
    yield tmp_path
    versions.commit.cache_clear()


def test_a_clone_is_named_by_its_commit_and_whether_it_was_changed(clone):
    first = versions.commit(clone)
    assert git(clone, "rev-parse", "HEAD").startswith(first) and len(first) >= 7
    (clone / "code.py").write_text("second\n")
    versions.commit.cache_clear()
    assert versions.commit(clone) == f"{first}-dirty"
    git(clone, "commit", "--quiet", "--all", "--message", "second")
    versions.commit.cache_clear()
    assert versions.commit(clone) not in ("", first, f"{first}-dirty")


def test_what_is_no_clone_has_no_commit(tmp_path, monkeypatch):
    assert versions.commit(tmp_path) == ""
    (tmp_path / ".git").write_text("gitdir: nowhere\n")
    versions.commit.cache_clear()
    assert versions.commit(tmp_path) == ""
    versions.commit.cache_clear()
    monkeypatch.setattr(versions, "commit", lambda: "")
    assert "commit" not in versions.library_versions() and " at " not in versions.project_version()
    monkeypatch.setattr(versions, "commit", lambda: "0123abc")
    assert versions.library_versions()["commit"] == "0123abc"
    assert versions.project_version().endswith(" at 0123abc")
