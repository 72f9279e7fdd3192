"""Files and folders that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from gyrofuse._output import Outputs, output_folder


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
