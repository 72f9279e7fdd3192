"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gyrofuse._base.files import Outputs, output_folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_outputs_appear_together_or_not_at_all(tmp_path: Path):
    first, second = tmp_path / "1.txt", tmp_path / "2.txt"
    with Outputs([first, second]) as drafts:
        for path, draft in drafts.items():
            draft.write_text(path.name)
        assert not first.exists()
        assert not second.exists()
    assert (first.read_text(), second.read_text()) == ("1.txt", "2.txt")

    def stop_halfway() -> None:
        with Outputs([first, second], force=True) as drafts:
            drafts[first].write_text("new")
            raise RuntimeError("halfway")

    with pytest.raises(RuntimeError, match="halfway"):
        stop_halfway()
    assert contents(tmp_path) == {"1.txt": b"1.txt", "2.txt": b"2.txt"}


def test_outputs_follow_links_and_refuse_what_is_used_twice(tmp_path: Path):
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    target.write_text("old")
    link.symlink_to(target)
    with Outputs([link], force=True) as drafts:
        drafts[link].write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    with pytest.raises(ValueError, match="in use by the same command"):
        Outputs([link, target], force=True)
    with pytest.raises(ValueError, match="in use by the same command"):
        Outputs([link], force=True, inputs=[target])
    with pytest.raises(FileExistsError, match="exists already"):
        Outputs([tmp_path / "new.txt", target])
    with pytest.raises(FileNotFoundError, match="does not exist; create it first"):
        Outputs([tmp_path / "new.txt", tmp_path / "nowhere" / "file.txt"])
    if Path("/proc/self").is_dir():
        with pytest.raises(OSError, match="the folder /proc takes no new files; choose another place"):
            Outputs([Path("/proc/file.txt")])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.txt", "target.txt"]


@pytest.mark.parametrize("links", [True, False])
def test_a_name_that_was_taken_meanwhile_stays_taken(tmp_path: Path, monkeypatch, links: bool):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")  # as of FAT

    if not links:
        monkeypatch.setattr(os, "link", refuse)
    free, taken = tmp_path / "free.txt", tmp_path / "taken.txt"

    def write(text: str, force: bool = False) -> None:
        with Outputs([free, taken], force=force) as drafts:
            for draft in drafts.values():
                draft.write_text(text)
            taken.write_text("of another run")

    with pytest.raises(FileExistsError, match=r"taken.txt: exists already; choose another name"):
        write("mine")
    assert contents(tmp_path) == {"taken.txt": b"of another run"}
    write("mine", force=True)
    assert contents(tmp_path) == {"free.txt": b"mine", "taken.txt": b"mine"}
    for path in (free, taken):
        path.unlink()
    with Outputs([free]) as drafts:
        drafts[free].write_text("mine")
    assert contents(tmp_path) == {"free.txt": b"mine"}

    def write_folder() -> None:
        with output_folder(tmp_path / "out", own=("a.txt",)) as draft:
            (draft / "a.txt").write_text("mine")
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "a.txt").write_text("of another run")

    with pytest.raises(FileExistsError, match="out: exists already"):
        write_folder()
    assert contents(tmp_path / "out") == {"a.txt": b"of another run"}


def test_what_is_wrong_with_a_place_is_said_even_where_nothing_can_be_cleaned_up(tmp_path: Path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(30, "Read-only file system", "/its/draft")

    with monkeypatch.context() as patched:
        for name in ("touch", "unlink"):
            patched.setattr(Path, name, refuse)
        with pytest.raises(OSError, match=r"o.txt: cannot be written there \(Read-only file system\); choose another"):
            Outputs([tmp_path / "o.txt"])
    (tmp_path / "round.txt").symlink_to("round.txt")
    with pytest.raises(ValueError, match=r"round\.txt: is a link that leads to itself; choose another name"):
        Outputs([tmp_path / "round.txt"])


def test_output_folder_is_replaced_only_when_it_holds_nothing_else(tmp_path: Path):
    folder = tmp_path / "out"

    def write(force: bool, text: str = "new") -> None:
        with output_folder(folder, own=("a.txt",), force=force) as draft:
            (draft / "a.txt").write_text(text)
            if text == "half":
                raise RuntimeError("halfway")

    write(force=False)
    with pytest.raises(FileExistsError, match="exists already"):
        write(force=False)
    (folder / "a.txt").write_text("old")
    write(force=True)
    assert contents(tmp_path) == {"out/a.txt": b"new"}
    with pytest.raises(RuntimeError, match="halfway"):
        write(force=True, text="half")
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="holds something else"):
        write(force=True)
    assert contents(tmp_path) == {"out/a.txt": b"new", "out/thesis.tex": b"years of work"}
