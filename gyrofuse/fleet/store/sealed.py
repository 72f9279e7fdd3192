"""Small files named after a digest of what is in them: whatever a power loss or a bad disk does to one is seen."""

from __future__ import annotations

import hashlib
import secrets
from pathlib import Path

from gyrofuse._base.files import sync_file, sync_folder

_DIGITS = 32  # hexadecimal digits of a SHA-256 in a name, 128 bits: none is met twice by chance
DRAFTS = "*.draft"  # files that were being written


def write_sealed(folder: Path, suffix: str, content: bytes | memoryview) -> Path:
    """Write a file that is there whole or not at all, also after a power loss; the same content is one file."""
    path = folder / f"{hashlib.sha256(content).hexdigest()[:_DIGITS]}{suffix}"
    draft = draft_in(folder)
    try:
        draft.write_bytes(content)
        sync_file(draft)
        draft.replace(path)
        sync_folder(folder)
    finally:
        draft.unlink(missing_ok=True)
    return path


def read_sealed(path: Path) -> bytes | None:
    """What a file was written with, None where that is no longer what it holds, or where it cannot be read."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    return content if hashlib.sha256(content).hexdigest()[:_DIGITS] == path.stem else None


def draft_in(folder: Path) -> Path:
    """A name for a file that is being written."""
    return folder / f"{secrets.token_hex(8)}{DRAFTS[1:]}"
